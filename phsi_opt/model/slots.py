"""Slots: where a term may act in a model, and what its parameters are called there.

H is the energy of the whole model; R, F and the sensor have a sum of terms per
equation. A *place* is a slot of an equation, and its name (``H``, ``R_p``, ``F_p``)
stands in the names of the parameters.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from phsi_opt.errors import ModelError
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term

SLOTS = ("H", "R", "F", "sensor")
BY_EQUATION = SLOTS[1:]  # the slots that have terms per equation


def place_of(slot: str, equation: str) -> str:
    """Name of a slot of an equation: ``H``, ``R_p``, ``F_p``."""
    return f"{slot}_{equation}" if equation else slot


@dataclass(frozen=True)
class Entry:
    """A parameter in its place: the row of the parameter table.

    ``prunable`` says that it is the coefficient of a term, without which the term goes.
    """

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
        at = (self.slot, self.equation)
        place = place_of(*at)
        found = []
        coefficient = self.term.coefficient
        if coefficient is not None:
            name = self.term.coefficient_name(place)
            found.append(Entry(name, coefficient, *at, prunable=True))
        for inner, parameter in self.term.inner.items():
            name = self.term.inner_name(inner, place)
            found.append(Entry(name, parameter, *at, prunable=False))
        return found


def parameter_table(terms: Iterable[PlacedTerm]) -> Mapping[str, Entry]:
    """Every parameter by name, in the order of the terms.

    A formula's parameter may stand in several terms.

    Raises:
        ModelError: one name for two different parameters, or a term that stands twice.
    """
    table: dict[str, Entry] = {}
    for placed in terms:
        for entry in placed.entries():
            known = table.setdefault(entry.name, entry)
            if known is entry:
                continue
            if known.parameter != entry.parameter:
                raise ModelError(
                    f"parameter {entry.name!r} is defined twice and differently "
                    f"({known.slot} and {entry.slot}): "
                    f"{known.parameter} and {entry.parameter}. "
                    "Use one Parameter for both, or two names."
                )
            if entry.prunable:
                raise ModelError(f"the term of {entry.name!r} is in the model already.")
    return MappingProxyType(table)
