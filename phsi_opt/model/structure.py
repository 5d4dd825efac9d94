"""Which state is what: positions and momenta of canonical pairs, and what is in none.

The physics is read from the structure matrix S and from the kinds that the model tells.
A row of S with one entry, dq/dt = dH/dp, makes q the position of the momentum p, if the
two are of one kind: a gyrator, such as that of a motor, looks nearly the same in S, and
so does a pair without inertia. A momentum that is coupled to more than its position, as
that of a piston is to a pressure, must be told to be mechanical; else it could be the
flow between two tanks. Without an energy an equation dx/dt = v makes x the position of
the velocity v, and du/dt = i/C the voltage u that of the current i. What lies outside
such pairs is a storage (a tank, a capacitor) or a flow (a pipe, a coil); where neither
the model nor a unit tells which, a state counts as both. Where the model loses energy
already says nothing about that.
"""

from collections.abc import Mapping
from dataclasses import replace
from enum import Enum
from typing import TypeVar

import numpy as np

from phsi_opt.arguments import is_count, require
from phsi_opt.model.base import BaseModel
from phsi_opt.model.expressions import NUMPY, evaluate, names_of
from phsi_opt.model.kinds import (
    ELECTRICAL,
    HYDRAULIC,
    MECHANICAL,
    THERMAL,
    kind_of_unit,
)
from phsi_opt.presentation.units import are_alike

AnyModel = TypeVar("AnyModel", bound=BaseModel)


def canonical(n: int) -> np.ndarray:
    """The canonical structure matrix [[0, I], [-I, 0]] (thesis Eq. 2.25).

    Args:
        n: number of positions, and of momenta; the states are positions, then momenta.

    Returns:
        The skew-symmetric matrix, (2 n, 2 n).

    Raises:
        ModelError: n is not a whole number from 1 to 1000.

    Examples:
        >>> ph.canonical(1)
        array([[ 0.,  1.],
               [-1.,  0.]])
    """
    expected = "the number of positions, a whole number from 1 to 1000"
    require(is_count(n) and n <= 1000, "canonical: n", n, expected)
    zero = np.zeros((n, n))
    one = np.eye(n)
    return np.block([[zero, one], [-one, zero]])


def position_rows(model: BaseModel) -> tuple[int, ...]:
    """Indices of the states that are positions of a canonical pair.

    The charge of a circuit and the volume of a chamber count as positions too.
    """
    positions = position_of_momentum(model).values()
    return tuple(i for i, name in enumerate(model.states) if name in positions)


def position_of_momentum(model: BaseModel) -> dict[str, str]:
    """Name of the position q of each momentum p of a canonical pair.

    Of a model without an energy, of each velocity. Of several positions that one
    momentum moves it is the first.
    """
    pairs: dict[str, str] = {}
    # Once: with many states S is large.
    exchange = np.array(model.S) if model.has_energy else None
    for position in model.states:
        if exchange is not None:
            momentum = _momentum(model, exchange, position)
        else:
            momentum = _velocity(model, position)
        told = {model.kind[x] for x in (position, momentum) if x in model.kind}
        if momentum and len(told) <= 1 and THERMAL not in told:  # heat has no pairs
            pairs.setdefault(momentum, position)
    return pairs


def _momentum(model: BaseModel, S: np.ndarray, position: str) -> str:
    """The p of an equation dq/dt = dH/dp; "" where that is not what it says."""
    row = model.states.index(position)
    (partners,) = np.nonzero(S[row])
    if len(partners) != 1 or not S[row, partners[0]] > 0:
        return ""
    momentum = model.states[partners[0]]
    told = set(map(model.kind.get, (position, momentum)))
    if np.count_nonzero(S[partners[0]]) > 1:
        return momentum if told == {MECHANICAL} else ""
    is_canonical = S[row, partners[0]] == 1
    return momentum if is_canonical or None not in told else ""


def _velocity(model: BaseModel, position: str) -> str:
    """The v of an equation dx/dt = c v with c > 0; "" for any other."""
    terms = model.terms_at("F", position).terms
    if len(terms) != 1 or model.terms_at("R", position):
        return ""
    (term,) = terms
    names = names_of(term.body) - set(term.inner)
    if len(names) != 1 or not names <= set(model.states) - {position}:
        return ""
    (velocity,) = names
    are_told = {position, velocity} <= set(model.kind)
    known = {"": 1.0}
    for name, one in term.parameters.items():
        known[name] = one.start if one.fixed else 1.0  # only its sign is asked for
        if not one.fixed and not (are_told and one.lower >= 0):
            return ""
    at = np.array([1.0, -2.0, 0.25])  # multiples of powers of two are exact
    with np.errstate(all="ignore"):  # not every law has a value at all of them
        rate = known.pop("") * evaluate(term.body, {**known, velocity: at}, NUMPY)
        is_proportional = bool(np.all(rate / at == rate[0] / at[0]))
    return velocity if is_proportional and rate[0] > 0 else ""


def kind_of(model: BaseModel, state: str) -> str:
    """What a state is, see ``kinds``; "" where that is unknown.

    A state of a canonical pair is of the kind of the other one, and mechanical where
    the model tells neither.
    """
    if state in model.kind:
        return str(model.kind[state])
    for pair in position_of_momentum(model).items():
        if state in pair:
            told = [model.kind[name] for name in pair if name in model.kind]
            return str(told[0]) if told else MECHANICAL
    return ""


def with_kinds_of_units(model: AnyModel, units: Mapping[str, str]) -> AnyModel:
    """The model with kinds by the units of the states of which it tells none.

    A length is a tank's level where all that lies outside of pairs has the unit of a
    length, a volume, a flow or a pressure. Volts are electrical only beside a state or
    an input in amperes, coulombs or webers. Both states of a pair are asked: where
    their units are of two kinds, they are none.
    """
    unpaired = unpaired_states(model)
    is_circuit = ELECTRICAL in map(kind_of_unit, units.values())
    of_unpaired = [units.get(name, "") for name in unpaired]
    others = {kind_of_unit(one) for one in of_unpaired if not are_alike(one, "m")}
    of_length = MECHANICAL if MECHANICAL in others else ""
    found = {}
    for name in model.states:
        unit = units.get(name, "")
        kind = kind_of_unit(unit)
        if name in unpaired and are_alike(unit, "m"):
            kind = HYDRAULIC if others <= {HYDRAULIC} else of_length
        elif name in unpaired and are_alike(unit, "V") and is_circuit:
            kind = ELECTRICAL
        if kind:
            found[name] = kind
    if found.keys() <= model.kind.keys():
        return model
    return replace(model, kind={**found, **model.kind})


def forced_rows(model: BaseModel) -> tuple[int, ...]:
    """Indices of the equations in which a force may be missing.

    These are all but those of an effect's memory and of a body's positions, for which
    dq/dt = dH/dp is kinematics. A capacitor may leak, and so may a chamber.
    """
    positions = position_of_momentum(model).values()
    kinematic = {name for name in positions if kind_of(model, name) == MECHANICAL}
    kinematic |= set(model.memory)
    return tuple(k for k, name in enumerate(model.states) if name not in kinematic)


def exchange_partners(model: BaseModel, equation: str) -> tuple[str, ...]:
    """States that an equation exchanges energy with.

    For a momentum these are all positions, otherwise the states in its row of S.
    """
    if equation in position_of_momentum(model):
        return tuple(model.states[row] for row in position_rows(model))
    coupling = np.array(model.S)[model.states.index(equation)]
    return tuple(model.states[column] for column in np.flatnonzero(coupling).tolist())


def effort_of(model: BaseModel, state: str) -> str:
    """Name of a state's effort in formulas: dH/dx, or the state without an energy."""
    return f"dH_d{state}" if model.has_energy else state


def storage_states(model: BaseModel) -> tuple[str, ...]:
    """States outside the canonical pairs that may be storages, such as tanks.

    They are hydraulic, or of a kind that is unknown.
    """
    unpaired = unpaired_states(model)
    return tuple(s for s in unpaired if kind_of(model, s) in ("", HYDRAULIC))


def unpaired_states(model: BaseModel) -> tuple[str, ...]:
    """States that are neither position nor momentum nor an effect's memory."""
    pairs = position_of_momentum(model)
    paired = {*pairs.keys(), *pairs.values(), *model.memory}
    return tuple(name for name in model.states if name not in paired)


class Role(Enum):
    """What a state is, in words.

    What comes from outside; what a loss grows with; the place of a momentum; what
    resists all of them; and what the equation may be short of ("": that depends).
    """

    BODY = ("force", "speed", "position", "inertia", "force")  # a momentum or speed
    PIPE = ("pressure", "the flow", "volume", "inertia", "pressure")  # with inertia
    TANK = ("inflow", "the level", "", "capacity", "flow")
    COIL = ("voltage", "the current", "charge", "inductance", "voltage")
    CAPACITOR = ("current", "the voltage", "", "capacitance", "current")
    # A charge, flux, current or voltage; it is not known which.
    CIRCUIT = ("source", "the current or voltage", "", "inductance or capacitance", "")
    HEAT = ("heat input", "the temperature", "", "heat capacity", "heat flow")
    UNKNOWN = ("force", "the speed or level", "", "inertia or capacity", "")


OF_MOMENTA = {MECHANICAL: Role.BODY, HYDRAULIC: Role.PIPE, ELECTRICAL: Role.COIL}
OF_OTHERS = {
    MECHANICAL: Role.BODY,
    HYDRAULIC: Role.TANK,
    ELECTRICAL: Role.CIRCUIT,
    THERMAL: Role.HEAT,
    "": Role.UNKNOWN,
}


def role_of(model: BaseModel, state: str) -> Role:
    """The role of a state in whose equation a force may be missing."""
    kind = kind_of(model, state)
    pairs = position_of_momentum(model)
    if state in pairs:
        return OF_MOMENTA[kind]
    if kind == ELECTRICAL and state in pairs.values():
        return Role.CAPACITOR
    return OF_OTHERS[kind]
