"""Slots: where a term may act in a model, and what its parameters are called there.

H is the energy of the whole model; R, F and the sensor have a sum of terms per
equation. A *place* is a slot of an equation, and its name (``H``, ``R_p``, ``F_p``)
stands in the names of the parameters.
"""

from dataclasses import dataclass
from typing import NamedTuple

from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term

SLOTS = ("H", "R", "F", "sensor")
BY_EQUATION = SLOTS[1:]  # the slots that have terms per equation


def place_of(slot: str, equation: str) -> str:
    """Name of a slot of an equation: ``H``, ``R_p``, ``F_p``."""
    return f"{slot}_{equation}" if equation else slot


@dataclass(frozen=True)
class Entry:
    """A parameter in its place: the row of the parameter table."""

    name: str
    parameter: Parameter
    slot: str
    equation: str
    prunable: bool


class PlacedTerm(NamedTuple):
    """A term with its slot and its equation ('' for H)."""

    slot: str
    equation: str
    term: Term

    def entries(self) -> list[Entry]:
        """The term's parameters, by their names in the model; its coefficient first."""
        place = place_of(self.slot, self.equation)
        found = []
        coefficient = self.term.coefficient
        if coefficient is not None:
            name = self.term.coefficient_name(place)
            found.append(self._entry(name, coefficient, prunable=True))
        for inner, parameter in self.term.inner.items():
            name = self.term.inner_name(inner, place)
            found.append(self._entry(name, parameter, prunable=False))
        return found

    def _entry(self, name: str, parameter: Parameter, prunable: bool) -> Entry:
        return Entry(name, parameter, self.slot, self.equation, prunable)
