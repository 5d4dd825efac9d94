"""What is established to be missing: an effect by its name, or a class of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import HYSTERESIS

# Families of effects, at most, that a class may join.
MOST_FAMILIES = 2

LOSS = "a loss of energy whose law the data do not tell"
LOSS_SOMEWHERE = "a loss of energy whose place and law the data do not tell"


@dataclass(frozen=True, eq=False)
class Finding:
    """An effect that is established, or a class whose members do as well.

    Attributes:
        effects: one is a name; several are those that the data cannot tell apart, the
            one that was re-fitted first.
        family: the class in words, such as "a loss that grows with speed".
        coefficient: of the first one, in ``unit``.
        std_error: of the coefficient, under what acts beside the model.
        share: of the squared error above the noise floor that is gone with all that is
            found.
        unit: of the coefficient; "" where it is not known.
    """

    effects: tuple[Effect, ...]
    family: str
    coefficient: float
    std_error: float
    share: float
    unit: str = ""

    @property
    def is_name(self) -> bool:
        """Whether it is one effect, and no class."""
        return len(self.effects) == 1

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        size = f"{self.coefficient:.4g}"
        if isfinite(self.std_error):
            size += f" +- {self.std_error:.2g}"
        size += unit
        first = self.effects[0]
        if self.is_name:
            return f"{first} ({size})"
        others = ", ".join(str(effect) for effect in self.effects[1:])
        where = f" in the equation of {first.equation}"
        if any(effect.equation != first.equation for effect in self.effects):
            where = ""
        return (
            f"{self.family}{where}: {first.name if where else first} ({size}), which "
            f"the data do not tell from {others}"
        )


def families(effects: Sequence[Effect]) -> list[str]:
    """The families of effects, each once, in their order."""
    return list(dict.fromkeys(effect.family for effect in effects))


def class_of(effects: Sequence[Effect]) -> str:
    """What a class is called; of many laws of loss that they take energy."""
    joined = families(effects)
    if len(joined) > MOST_FAMILIES and are_losses(effects):
        places = {effect.equation for effect in effects}
        return LOSS if len(places) == 1 else LOSS_SOMEWHERE
    return " or ".join(joined)


def are_losses(effects: Sequence[Effect]) -> bool:
    """Whether all take energy from the motion: then they are alike in that."""
    return all(one.slot == "R" or one.name == HYSTERESIS for one in effects)
