"""The names that formulas of a model may use: states, inputs, time, efforts, slopes.

Which of them a term may use depends on its slot: an energy depends on the states alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from phsi_opt.data.checks import RESERVED_PREFIXES
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.expressions import names_of
from phsi_opt.model.slots import PlacedTerm


@dataclass(frozen=True)
class Variables:
    """Names of what changes along a motion; parameters are not among them."""

    states: Sequence[str]
    inputs: Sequence[str]

    @property
    def efforts(self) -> tuple[str, ...]:
        """Names of the efforts dH/dx_i."""
        return tuple(f"dH_d{name}" for name in self.states)

    @property
    def slopes(self) -> tuple[str, ...]:
        """Names of the slopes dF/du_i of an equation's force in the inputs."""
        return tuple(f"dF_d{name}" for name in self.inputs)

    def of_slot(self, slot: str) -> set[str]:
        """Names that a term of the slot may use beside its parameters."""
        names = set(self.states)
        if slot != "H":
            names |= {"t", *self.inputs, *self.efforts}
        if slot == "F":
            names |= set(self.slopes)
        return names

    def check_parameters(self, names: Iterable[str]) -> None:
        """Check that no parameter has the name of a variable or of a derivative.

        Raises:
            ModelError: one has.
        """
        taken = self.of_slot("F")
        clash = [n for n in names if n in taken or n.startswith(RESERVED_PREFIXES)]
        if clash:
            raise ModelError(
                f"parameter name {min(clash)!r} is also a state, an input "
                "or a derivative such as dH_dq; rename it."
            )

    def check_term(self, placed: PlacedTerm) -> None:
        """Check that a term uses only its parameters and the variables of its slot.

        Raises:
            ModelError: it uses another name.
        """
        allowed = self.of_slot(placed.slot) | set(placed.term.inner)
        unknown = names_of(placed.term.body) - allowed
        if not unknown:
            return
        name = min(unknown)
        body = placed.term.body
        if placed.slot == "H" and name in self.of_slot("R"):
            raise ModelError(
                f"{body!r} in H uses {name!r}, but an energy depends on the states "
                "alone; put the term into F."
            )
        hint = did_you_mean(name, allowed)
        if not hint:
            hint = (
                f" If it is a parameter, give it: formula(..., {name}=Parameter(1.0))."
            )
        raise ModelError(
            f"name {name!r} in {body!r} ({placed.slot}) is unknown; "
            f"known are {', '.join(sorted(allowed))}.{hint}"
        )
