"""Slots: where a term may act in a model, and what its parameters are called there.

H is the energy of the whole model; R, F and the sensor have a sum of terms per
equation, R and F also along directions (``directions``). A *place* is a slot of an
equation, and its name (``H``, ``R_p``, ``F_p``, ``R_p1_p2``) stands in the names of the
parameters.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

from phsi_opt.data.checks import RESERVED_PREFIXES
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.directions import direction_parts, factors_of
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
EXCHANGE = re.compile(r"dH_d(\w+)\*(\w+) - dH_d\2\*\1")
BY_EQUATION = SLOTS[1:]  # the slots that have terms per equation


def place_of(slot: str, equation: str) -> str:
    """Name of a slot of an equation: ``H``, ``R_p``, ``F_p``, ``R_p1_p2``.

    An exchange without loss, along "dH_dp2*p1 - dH_dp1*p2", is the entry ``S_p1_p2``.
    """
    exchange = EXCHANGE.fullmatch(equation)
    if slot == "F" and exchange:
        return f"S_{exchange[2]}_{exchange[1]}"
    named = re.sub(r"\W+", "_", equation.replace("+", "plus")).strip("_")
    return f"{slot}_{named}" if equation else slot


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
        body = evaluate(self.term.body, self._known(names), backend)
        return body if self.term.is_formula else names[self.parameter_name()] * body

    def factors(
        self, states: Sequence[str], names: Mapping[str, Any], backend: Backend = CASADI
    ) -> dict[str, Any]:
        """Each state in whose equation it acts, with its factor; of R and F."""
        known = self._known(names)
        found = {}
        for state, sign, factor in direction_parts(self.equation, tuple(states)):
            found[state] = sign * evaluate(factor, known, backend)
        return found

    def _known(self, names: Mapping[str, Any]) -> dict[str, Any]:
        """The names of the model, and those of its own parameters inside."""
        own = {inner: names[self.parameter_name(inner)] for inner in self.term.inner}
        return {**names, **own}

    def entries(self) -> list[Entry]:
        """The term's parameters, by their names in the model; its coefficient first."""
        found = []
        for inner, one in self.term.parameters.items():
            name = self.parameter_name(inner)
            found.append(Entry(name, one, self.slot, self.equation, not inner))
        return found


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

    def formula(
        self, text: str, slot: str, equation: str, known: dict[str, Parameter]
    ) -> Dictionary:
        """A formula of the slot; names without a meaning become ``known`` parameters.

        A free parameter begins at a value from the data where the formula is linear in
        it, else at 1, as those in the direction do. A loss that is nothing but a
        parameter is not negative.
        """
        variables = self.of_slot("F")
        own: dict[str, Parameter] = {}
        linear: list[str] = []
        for name in sorted(factors_of(equation, self.states) - variables):
            own[name] = known.setdefault(name, Parameter(1.0))
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
        parameters = {*placed.term.inner, *shared}
        factors = factors_of(placed.equation, self.states)
        for name in sorted(factors - parameters - self.of_slot(placed.slot)):
            raise ModelError(
                f"name {name!r} in direction {placed.equation!r} is neither a "
                "variable nor a parameter of the terms along it; give it: "
                f"formula(..., {name}=Parameter(1.0))."
            )
        for name in placed.term.inner:
            if name not in names_of(placed.term.body) | factors:
                raise ModelError(
                    f"parameter {name!r} does not occur in {placed.term.body!r}; "
                    "remove it or correct its name."
                )
        allowed = self.of_slot(placed.slot) | parameters
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
