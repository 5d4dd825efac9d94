"""What a model may lack, what is known of it, and what is established."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import DECISIVE_EVIDENCE, STRONG_EVIDENCE
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import HYSTERESIS
from phsi_opt.presentation.units import spaced
from phsi_opt.screening.effect_size import Size

MOST_FAMILIES = 2  # of effects, that the name of a class joins

LOSS = "a loss of energy whose law the data do not tell"
LOSS_SOMEWHERE = "a loss of energy whose place and law the data do not tell"


class Verdict(StrEnum):
    """Whether something is missing in a model, and whether it is known what."""

    NOTHING_MISSING = "nothing missing"
    NAMED = "missing: named"
    PARTLY_NAMED = "missing: partly named"
    UNEXPLAINED = "missing: unexplained"


class Grade(StrEnum):
    """How clearly an effect is there, by the logarithm of its Bayes factor."""

    DECISIVE = "decisive"
    STRONG = "strong"
    WEAK = "weak"
    NONE = "none"

    @classmethod
    def of(cls, log_bayes: float) -> "Grade":
        """Of a logarithm of a Bayes factor; not a number counts as none."""
        if log_bayes >= DECISIVE_EVIDENCE:
            return cls.DECISIVE
        if log_bayes >= STRONG_EVIDENCE:
            return cls.STRONG
        return cls.WEAK if log_bayes > 0 else cls.NONE


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect: what screening expects of it, its evidence, and its re-fit.

    Attributes:
        effect: what may be missing.
        coefficient: its size in ``unit``: of the fit where it is named, else beside a
            force, else expected.
        std_error: of the coefficient.
        values: of the model's parameters, from which a re-fit starts.
        states: (n_nodes, n_states) along the training record, likewise.
        log_bayes: logarithm of the Bayes factor of the model with it over the model
            without, both beside a force, by the training data; expected where it was
            not weighed.
        log_predictive: what it adds to the log predictive density of the data held out;
            NaN where there are none, or it was not weighed.
        was_weighed: whether it was weighed, and not only expected to gain nothing.
        probability: of it among all effects that were weighed and no effect, equally
            likely before.
        force_left: root mean square of the force beside it over that without it.
        confusable_with: names of the effects that the data cannot tell from it.
        train_rmse: free-run error on the training data; NaN without a re-fit.
        held_out_rmse: the same on the data held out; NaN where there are none.
        share: of the squared error above the noise floor that it explains, on the data
            that judge.
        lost: why it is not named; empty for what is.
        unit: of the coefficient; "" where it is not known.
        fit: the re-fit; ``trained`` and ``comparison``: its free runs on the training
            record and on the one that judges. None where it was not re-fitted.
    """

    effect: Effect
    coefficient: float
    std_error: float
    values: dict[str, float] = field(default_factory=dict, repr=False)
    states: np.ndarray | None = field(default=None, repr=False)
    log_bayes: float = np.nan
    log_predictive: float = np.nan
    was_weighed: bool = False
    probability: float = np.nan
    force_left: float = np.nan
    confusable_with: tuple[str, ...] = ()
    train_rmse: float = np.nan
    held_out_rmse: float = np.nan
    share: float = np.nan
    lost: str = ""
    unit: str = ""
    fit: Fit | None = field(default=None, repr=False)
    trained: Comparison | None = field(default=None, repr=False)
    comparison: Comparison | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, lost={self.lost!r})"

    @property
    def name(self) -> str:
        """The effect in words."""
        return str(self.effect)

    @property
    def size(self) -> Size:
        """The coefficient with its standard error and unit."""
        return Size(self.coefficient, self.std_error, self.unit)

    @property
    def log_evidence(self) -> float:
        """Gain of the log evidence by all data, those held out included."""
        held_out = 0.0 if np.isnan(self.log_predictive) else self.log_predictive
        return self.log_bayes + held_out

    @property
    def grade(self) -> Grade:
        """How clearly it is there."""
        return Grade.of(self.log_evidence) if self.was_weighed else Grade.NONE


@dataclass(frozen=True, eq=False)
class Finding:
    """An effect that is established, or a class whose members do as well.

    Attributes:
        effects: one is a name; several are those that the data cannot tell apart, the
            one that was re-fitted first.
        family: the class in words, such as "a loss that grows with speed".
        coefficient: of the first one, in ``unit``.
        std_error: of the coefficient; it accounts for model error.
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
        size = f"{self.coefficient:.4g}"
        if np.isfinite(self.std_error):
            size += f" +- {self.std_error:.2g}"
        size += spaced(self.unit)
        first = self.effects[0]
        if self.is_name:
            return f"{first} ({size})"
        others = ", ".join(map(str, self.effects[1:]))
        name, where = str(first), ""
        if all(effect.equation == first.equation for effect in self.effects):
            name, where = first.name, f" in the equation of {first.equation}"
        return (
            f"{self.family}{where}: {name} ({size}), which the data do not tell from "
            f"{others}"
        )


def class_of(effects: Sequence[Effect]) -> str:
    """The name of a class of effects: their families, or a loss where these are many.

    A loss takes energy from the motion by any law.
    """
    families = list(dict.fromkeys(effect.family for effect in effects))
    are_losses = all(one.slot == "R" or one.name == HYSTERESIS for one in effects)
    if len(families) > MOST_FAMILIES and are_losses:
        places = {effect.equation for effect in effects}
        return LOSS if len(places) == 1 else LOSS_SOMEWHERE
    return " or ".join(families)
