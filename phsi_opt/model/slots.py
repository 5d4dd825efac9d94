"""Slots: where a term may act in a model, and what its parameters are called there.

H is the energy of the whole model; R, F and the sensor have a sum of terms per
equation. A *place* is a slot of an equation, and its name (``H``, ``R_p``, ``F_p``)
stands in the names of the parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Any, NamedTuple

from phsi_opt.data.checks import RESERVED_PREFIXES
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.expressions import (
    CASADI,
    Backend,
    delays_in,
    evaluate,
    is_linear,
    names_of,
)
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Dictionary, Term

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

    @property
    def place(self) -> str:
        return place_of(self.slot, self.equation)

    def parameter_name(self, inner: str = "") -> str:
        """Name in the model of its coefficient, or of an inner parameter."""
        return self.term.parameter_name(self.place, inner)

    def value(self, names: Mapping[str, Any], backend: Backend = CASADI) -> Any:
        """Its value, where the variables and the model's parameters are by name."""
        known = dict(names)
        for inner in self.term.inner:
            known[inner] = names[self.parameter_name(inner)]
        body = evaluate(self.term.body, known, backend)
        return body if self.term.is_formula else names[self.parameter_name()] * body

    def entries(self) -> list[Entry]:
        """The term's parameters, by their names in the model; its coefficient first."""
        found = []
        for inner, one in self.term.parameters.items():
            name = self.parameter_name(inner)
            found.append(Entry(name, one, self.slot, self.equation, not inner))
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


@dataclass(frozen=True)
class Variables:
    """Names of what changes along a motion; parameters are not among them."""

    states: Sequence[str]
    inputs: Sequence[str]

    @property
    def efforts(self) -> tuple[str, ...]:
        return tuple(f"dH_d{name}" for name in self.states)

    @property
    def slopes(self) -> tuple[str, ...]:
        """Names of the slopes dF/du_i in formulas of F.

        They are those of the equation's other force terms, in each input.
        """
        return tuple(f"dF_d{name}" for name in self.inputs)

    def of_slot(self, slot: str) -> set[str]:
        """Names that a term of the slot may use beside its parameters."""
        names = set(self.states)
        if slot != "H":
            names |= {"t", *self.inputs, *self.efforts}
        if slot == "F":
            names |= set(self.slopes)
        return names

    def formula(self, text: str, slot: str, known: dict[str, Parameter]) -> Dictionary:
        """A formula of the slot; names without a meaning become ``known`` parameters.

        A free parameter begins at a value from the data where the formula is linear in
        it, else at 1. A loss that is nothing but a parameter is not negative.
        """
        variables = self.of_slot("F")
        own: dict[str, Parameter] = {}
        linear: list[str] = []
        for name in sorted(names_of(text)):
            if name in variables or name.startswith(RESERVED_PREFIXES):
                continue  # what is wrong in this slot is refused with the term
            if name not in known:
                value = None if is_linear(text, [*linear, name]) else 1.0
                lower = 0.0 if slot == "R" and text.strip() == name else -inf
                known[name] = Parameter(value, lower=lower)
            own[name] = known[name]
            linear += [name] if own[name].value is None else []
        return Dictionary((Term(text, None, own),))

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

    def check_term(self, placed: PlacedTerm, shared: Sequence[str]) -> None:
        """Check that a term uses only parameters and the variables of its slot.

        Raises:
            ModelError: it uses another name.
        """
        for one in delays_in(placed.term.body):
            if one[0] not in self.inputs or one[1] not in shared:
                raise ModelError(
                    f"delayed({', '.join(one)}) in {placed.term.body!r}: only an input "
                    f"({', '.join(self.inputs)}) can be delayed, by a parameter of a "
                    "formula."
                )
        allowed = self.of_slot(placed.slot).union(placed.term.inner, shared)
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
        give = f" If it is a parameter, give it: formula(..., {name}=Parameter(1.0))."
        raise ModelError(
            f"name {name!r} in {body!r} ({placed.slot}) is unknown; known are "
            f"{', '.join(sorted(allowed))}.{did_you_mean(name, allowed) or give}"
        )
