"""Units of parameters and hidden states, from those of what is measured.

A unit is a product of powers, so that its logarithm is linear: each part of a formula
has a *form*, the sum of its names' dimensions with their powers. Terms of a sum have
like forms, each term of an equation has the unit of the state over that of the time,
and what stands in an exponential has none. `Equations` collects this while formulas
are evaluated in `_Quantity`, as they are in CasADi's symbols; the powers of each unit
then solve linear equations. Where these leave a unit open (a momentum that nobody
measures) there is none. Where they contradict each other (a formula with numbers in
place of constants of physics, mm and m), units are put into base units, and then each
equation is asked by itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, compress
from typing import Any, NamedTuple

import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.expressions import CONSTANTS, FUNCTIONS, Backend
from phsi_opt.model.parameters import Scan, Tried
from phsi_opt.model.slots import PlacedTerm
from phsi_opt.presentation.units import (
    RADIAN,
    Powers,
    Unit,
    coefficient_unit,
    powers_as_written,
    powers_in_base_units,
    product,
    scale_of,
    unit_of_rate,
    unit_per,
)

WHOLE_ENERGY = "energy H"  # as the equations call it; no parameter has a blank
MOMENTUM = "kg m/s"  # as people write it, not N s
# Rounding errors of powers, which are halves and quarters of whole numbers.
POWER_ROUNDING = 1e-8

# Power of each quantity in a dimension, by the quantity's name.
Form = Mapping[str, float]


def parameter_units(model: BaseModel, units: Mapping[str, str]) -> dict[str, str]:
    """The unit of every parameter, "" where it is not known."""
    stated = stated_units(model, units)
    found = _solved(model, stated)
    time = units.get("t", "")
    told = {}
    for name, entry in model.entries.items():
        parameter = entry.parameter
        guess = parameter.guess
        told[name] = parameter.unit
        if name in stated:
            continue
        if isinstance(guess, Tried) and guess.of in ("t", "dt"):
            told[name] = time or parameter.unit
        if name not in found:
            continue
        if isinstance(guess, Scan) and guess.variable == "t":
            told[name] = f"{RADIAN}/{time}" if time else parameter.unit
        else:
            rows = model.rows(entry.equation) if entry.equation else ()
            of_state = model.states[rows[0]] if rows else ""
            named = named_units(of_state, model, units)
            told[name] = coefficient_unit(found[name], named)
            scale = scale_of(told[name])
            if entry.slot == "sensor" and entry.prunable and scale.zero:
                told[name] = Unit(told[name], replace(scale, zero=0.0))  # an offset
    return told


# In what a state is driven, by the powers of its unit without angles.
DRIVES = {"m/s": "N", "1/s": "N m", "K": "W", "Pa": "m^3/s", "m": "m^3/s"}
DRIVES |= {"A": "V", "V": "A"}
HEATS = ("W", "W/K", "J/K", "W/K^2", "W/K^4")


def drive_of(unit: str) -> str:
    """The unit of what drives a state of a unit, such as N of m/s; "": not known."""
    powers = _without_angles(unit)
    for of, drive in DRIVES.items():
        if _without_angles(of) == powers:
            return drive
    return ""


def _without_angles(unit: str) -> Powers:
    return {**(powers_in_base_units(unit) or {}), RADIAN: 0.0}


def named_units(
    equation: str, model: BaseModel, units: Mapping[str, str]
) -> Sequence[str]:
    """Of states, the time, rates, what drives it, also per unit of inputs, of these."""
    state, time = units.get(equation, ""), units.get("t", "")
    drive = drive_of(state)
    others = [units.get(name, "") for name in model.states]
    rates = [unit_of_rate(one, time) for one in (state, "1", *others)]
    per_input = [unit_per(drive, time, 1)] if drive and time else []
    inputs = list(filter(None, map(units.get, model.inputs)))
    for u in inputs:
        for above in filter(None, (drive, rates[0], state)):
            per_input += [unit_per(above, u, 1), unit_per(above, u, 2)]
    heats = HEATS if drive == "W" else ()
    return (state, time, *rates, *heats, *per_input, *others, *inputs)


def state_units(model: BaseModel, units: Mapping[str, str]) -> dict[str, str]:
    """The unit of every state: as given, or as the equations ask for; "" if unknown."""
    found = _solved(model, stated_units(model, units))
    told = {}
    for state in model.states:
        told[state] = units.get(state, "")
        if not told[state] and found.get(state):
            told[state] = coefficient_unit(found[state], (MOMENTUM,))
    return told


def stated_units(model: BaseModel, units: Mapping[str, str]) -> dict[str, str]:
    """The units given, and those of the parameters of which a person gave the unit."""
    stated = dict(units)
    for name, entry in model.entries.items():
        parameter = entry.parameter
        if parameter.unit and parameter.guess is None:  # else it is of the catalogue
            stated[name] = parameter.unit
    return stated


def _solved(model: BaseModel, stated: Mapping[str, str]) -> dict[str, Powers]:
    """The powers of the units by parameter and state, as far as they are determined."""
    whole = Equations(model)
    for numbers_are_pure in (True, False):
        for split in (powers_as_written, powers_in_base_units, _unambiguous):
            powers = whole.solved(_readable(stated, split), numbers_are_pure)
            if powers is not None:
                return powers
    known = _readable(stated, powers_as_written)
    found: dict[str, Powers] = {}
    for placed in model.placed():
        if placed.slot != "H":
            found = (Equations(model, only=placed).solved(known) or {}) | found
    return found


def _readable(
    units: Mapping[str, str], split: Callable[[str], Powers | None]
) -> dict[str, Powers]:
    found = {}
    for name, unit in units.items():
        powers = split(unit)
        if powers is not None:
            found[name] = powers
    return found


def _unambiguous(unit: str) -> Powers | None:
    """In base units, but for C: it is a coulomb to one and a degree to another."""
    powers = powers_in_base_units(unit)
    return None if powers and "C" in powers else powers


class Likeness(NamedTuple):
    """A form that has no dimension.

    ``is_angle``: it may have the dimension of the radian; ``is_number``: a number
    stands beside it in a sum, as in 1 - q, which may have a unit of its own.
    """

    form: Form
    is_angle: bool = False
    is_number: bool = False


class Equations:
    """What a model's structure and terms say of dimensions.

    Args:
        model: the model.
        only: a term that is asked by itself; None: all terms, and the structure.
        may_hide: whether a term without a parameter may hide constants of physics.

    Attributes:
        said: forms without a dimension.
        numbers: those that may have a unit, by their names, and where they stand.
    """

    def __init__(
        self, model: BaseModel, only: PlacedTerm | None = None, may_hide: bool = False
    ) -> None:
        self._model = model
        self._n_unknown = 0
        self._may_hide = may_hide
        self.said: list[Likeness] = []
        self.numbers: dict[str, tuple[float, PlacedTerm]] = {}
        if only is None:
            self._say_structure()
        for placed in [only] if only else model.placed():
            self._say_term(placed)

    def alike(
        self,
        first: Form,
        second: Form,
        *parts: Form,
        is_angle: bool = False,
        is_number: bool = False,
    ) -> None:
        """Says that two forms have one dimension, but for what the parts may hide."""
        form = product(first, second, -1.0)
        if any(map(self.hides, parts)):
            form = product(form, self.unknown())
        self.said.append(Likeness(form, is_angle, is_number))

    def hides(self, form: Form) -> bool:
        """Whether a part may hide a constant: it has no parameter."""
        return self._may_hide and form.keys().isdisjoint(self._model.entries)

    def unknown(self) -> Form:
        """A dimension of which nothing is known."""
        self._n_unknown += 1
        return {f"number {self._n_unknown}": 1.0}

    def _say_structure(self) -> None:
        """dx_i/dt = dH/dx_j; without an energy efforts are the states."""
        if not self._model.has_energy:
            return
        states = self._model.states
        for state, couplings in zip(states, self._model.S, strict=True):
            self.alike(self._effort(state), {WHOLE_ENERGY: 1.0, state: -1.0})
            for other, coupling in zip(states, couplings, strict=True):
                if abs(coupling) == 1.0:
                    self.alike(self._effort(other), {state: 1.0, "t": -1.0})

    def _say_term(self, placed: PlacedTerm) -> None:
        """A term has the unit of its slot."""
        slot, equation, _ = placed
        rows = self._model.rows(equation) if equation else ()
        first = self._model.states[rows[0]] if rows else equation
        names = self._names({first: 1.0, "t": -1.0})
        quantities = {name: _Quantity(self, form) for name, form in names.items()}
        functions = {name: partial(self._called, name) for name in FUNCTIONS}
        constants = dict.fromkeys(CONSTANTS, _Quantity(self, {}))
        backend = Backend(functions, partial(self._number, placed), constants)
        own = placed.value(quantities, backend).form
        if slot in "H sensor":
            of_slot = {WHOLE_ENERGY: 1.0} if slot == "H" else {equation: 1.0}
            self.alike(own, of_slot, own)
            return
        factors = placed.factors(self._model.states, quantities, backend)
        for state, factor in factors.items():
            # What is along a direction in each of its states, of R times b b'.
            along = product(own, factor.form)
            rate: Form = {state: 1.0, "t": -1.0}
            if slot == "R":
                along = product(along, factor.form)
                rate = product(rate, self._effort(state), -1.0)
            self.alike(along, rate, along)

    def _names(self, rate: Form) -> dict[str, Form]:
        """The forms of all names in an equation of that rate, and of the parameters."""
        model = self._model
        names: dict[str, Form] = {}
        for name in ("t", *model.states, *model.inputs, *model.entries):
            names[name] = {name: 1.0}
        for effort, state in zip(model.efforts, model.states, strict=True):
            names[effort] = self._effort(state)
        for slope, of in zip(model.variables.slopes, model.inputs, strict=True):
            names[slope] = product(rate, {of: 1.0}, -1.0)
        return names

    def _effort(self, state: str) -> Form:
        return {f"effort {state}" if self._model.has_energy else state: 1.0}

    def _number(self, placed: PlacedTerm, number: float) -> "_Quantity":
        # A number beyond 8, or one that is no multiple of a quarter, may be a constant
        # of physics with a unit of its own, such as 9.81.
        is_simple = float(4 * number).is_integer() and 0 < number <= 8
        form: Form = {} if is_simple else self.unknown()
        if form and not self._may_hide:
            # What stands twice in an equation, such as a mass, is the same twice.
            form = {f"number {number} of {placed.equation}": 1.0}
        self.numbers |= dict.fromkeys(form, (number, placed))
        return _Quantity(self, form, number)

    def _called(
        self, name: str, first: "_Quantity", *others: "_Quantity"
    ) -> "_Quantity":
        if name in ("abs", "min", "max"):
            for other in others:
                self.alike(first.form, other.form, first.form)
            return replace(first, value=None)
        if name == "delayed":
            self.alike(others[0].form, {"t": 1.0})
            return replace(first, value=None)
        if name == "sqrt":
            return _Quantity(self, product({}, first.form, 0.5))
        if name in ("sin", "cos", "tan"):
            self.alike(first.form, {}, is_angle=True)
        elif name != "sign":
            self.alike(first.form, {}, first.form)
        return _Quantity(self, {})

    def solved(
        self, known: Mapping[str, Powers], numbers_are_pure: bool = True
    ) -> dict[str, Powers] | None:
        """The powers of the units in each quantity that the likenesses determine.

        Radians come and go in physics (a torque is N m, an arc is a length): likenesses
        of known quantities may lose them, and where others contradict each other or
        leave them open, there are none. None where the likenesses contradict each
        other.
        """
        said = [one for one in self.said if numbers_are_pure or not one.is_number]
        names = dict.fromkeys(chain.from_iterable(one.form for one in said))
        unknown = [name for name in names if name not in known]
        rows = _rows(said, unknown)
        known_rows = _rows(said, list(known))
        whole = _inverse(rows)
        found: dict[str, Any] = {name: {} for name in compress(unknown, whole[1])}
        for unit in sorted(set().union(*known.values())):
            given = np.array([powers.get(unit, 0.0) for powers in known.values()])
            right = -(known_rows @ given)
            kept = np.full(len(said), fill_value=True)
            if unit == RADIAN:
                loses_it = ~np.any(rows, axis=1) & (np.abs(right) > POWER_ROUNDING)
                without_angles = np.array([not one.is_angle for one in said], bool)
                kept = without_angles & ~loses_it
            inverse, determined = whole if kept.all() else _inverse(rows[kept])
            powers = inverse @ right[kept]
            if np.any(np.abs(rows[kept] @ powers - right[kept]) > POWER_ROUNDING):
                if unit == RADIAN:
                    continue
                return None
            for name, power, is_told in zip(unknown, powers, determined, strict=True):
                power = round(float(power), 6)
                if name in found and is_told and power:
                    found[name][unit] = power
        return found


@dataclass(frozen=True)
class _Quantity:
    """A part of a formula by its dimension; what is added to it must be alike."""

    equations: Equations
    form: Form
    value: float | None = None

    def __add__(self, other: "_Quantity") -> "_Quantity":
        is_number = self.value is not None or other.value is not None
        parts = (self.form, other.form)
        self.equations.alike(*parts, *parts, is_number=is_number)
        is_other = self.value is not None or self.equations.hides(self.form)
        return replace(other if is_other else self, value=None)

    __sub__ = __add__

    def __rmul__(self, sign: int) -> "_Quantity":
        return self if sign > 0 else -self

    def __neg__(self) -> "_Quantity":
        return replace(self, value=None if self.value is None else -self.value)

    def __mul__(self, other: "_Quantity") -> "_Quantity":
        return _Quantity(self.equations, product(self.form, other.form))

    def __truediv__(self, other: "_Quantity") -> "_Quantity":
        value = None
        if self.value is not None and other.value:
            value = self.value / other.value
        return _Quantity(self.equations, product(self.form, other.form, -1.0), value)

    def __pow__(self, other: "_Quantity") -> "_Quantity":
        if other.value is not None:
            return _Quantity(self.equations, product({}, self.form, other.value))
        self.equations.alike(other.form, {}, other.form)
        return _Quantity(self.equations, self.equations.unknown() if self.form else {})


def _rows(said: Sequence[Likeness], names: Sequence[str]) -> np.ndarray:
    """The power of each name in each likeness, (n_likenesses, n_names)."""
    rows = np.zeros((len(said), len(names)))
    for row, likeness in zip(rows, said, strict=True):
        row[:] = [likeness.form.get(name, 0.0) for name in names]
    return rows


def _inverse(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What solves by least squares, and whether the rows determine each unknown."""
    inverse = np.linalg.pinv(rows, rcond=POWER_ROUNDING)
    return inverse, np.abs(np.diag(inverse @ rows) - 1.0) < POWER_ROUNDING
