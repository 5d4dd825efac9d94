"""Units of parameters and hidden states, from those of what is measured.

Every term of an equation has the unit of the state over that of the time, terms of a
sum are of like things, and what stands in an exponential has no unit. The powers of the
units solve these linear equations, one system for each unit. Where they leave a unit
open (a momentum that nobody measures) there is none; where they contradict each other
(a formula with numbers in place of constants of physics, mm beside m), units are put
into base units, and then each equation is asked by itself.
"""

from collections.abc import Callable, Mapping

from phsi_opt.model.base import BaseModel
from phsi_opt.model.dimensions import Form, Likenesses, solved_dimensions
from phsi_opt.model.parameters import Parameter, Scan, Tried
from phsi_opt.model.slots import PlacedTerm, place_of
from phsi_opt.presentation.units import (
    RADIAN,
    Powers,
    coefficient_unit,
    powers_as_written,
    powers_in_base_units,
    product,
    rate_unit,
)

MOMENTUM = "kg m/s"  # as people write it, not N s


def parameter_units(model: BaseModel, units: Mapping[str, str]) -> dict[str, str]:
    """The unit of every parameter, "" where it is not known.

    A unit that the model states is kept.

    Args:
        model: the model.
        units: by state, input and time, as `Measurements.units`.
    """
    known = {name: unit for name, unit in units.items() if unit}
    found = _solved(model, known)
    told = {}
    for name, entry in model.entries.items():
        parameter = entry.parameter
        told[name] = parameter.unit
        if _is_stated(parameter):
            continue
        time = known.get("t", "")
        if isinstance(parameter.guess, Tried) and parameter.guess.of in ("t", "dt"):
            told[name] = time or parameter.unit
        if name in found:
            if isinstance(parameter.guess, Scan) and parameter.guess.variable == "t":
                told[name] = f"{RADIAN}/{time}" if time else parameter.unit
            else:
                equation = known.get(entry.equation, "")
                rate = rate_unit(equation, time)
                told[name] = coefficient_unit(found[name], (equation, rate))
    return told


def state_units(model: BaseModel, units: Mapping[str, str]) -> dict[str, str]:
    """The unit of every state: as given, or as the equations ask for; "" if unknown.

    Args:
        model: the model.
        units: by state, input and time, as `Measurements.units`.
    """
    known = {name: unit for name, unit in units.items() if unit}
    found = _solved(model, known)
    told = {}
    for state in model.states:
        told[state] = known.get(state, "")
        if not told[state] and found.get(state):
            told[state] = coefficient_unit(found[state], (MOMENTUM,))
    return told


def _is_stated(parameter: Parameter) -> bool:
    """Whether a person gave the unit; the catalogue's times are in seconds."""
    return bool(parameter.unit) and parameter.guess is None


def _solved(model: BaseModel, units: Mapping[str, str]) -> dict[str, Powers]:
    whole = _Equations(model)
    whole.say_structure()
    for placed in model.placed():
        whole.say_term(placed)
    for numbers_are_pure in (True, False):
        for split in (powers_as_written, powers_in_base_units):
            powers = whole.solution(units, split, numbers_are_pure)
            if powers is not None:
                return powers
    found: dict[str, Powers] = {}
    for placed in model.placed():
        if placed.slot != "H":
            alone = _Equations(model)
            alone.say_term(placed)
            for name, one in (alone.solution(units, powers_as_written) or {}).items():
                found.setdefault(name, one)
    return found


class _Equations:
    """What a model's structure and terms say of dimensions."""

    def __init__(self, model: BaseModel) -> None:
        self._model = model
        self._said = Likenesses()

    def say_structure(self) -> None:
        """dx_i/dt = dH/dx_j; without an energy efforts are the states."""
        if not self._model.has_energy:
            return
        states = self._model.states
        for state, couplings in zip(states, self._model.S, strict=True):
            self._said.alike(self._effort(state), _quotient("H", state))
            for other, coupling in zip(states, couplings, strict=True):
                if abs(coupling) == 1.0:
                    self._said.alike(self._effort(other), _quotient(state, "t"))

    def say_term(self, placed: PlacedTerm) -> None:
        """A term has the unit of its slot."""
        slot, equation, term = placed
        place = place_of(slot, equation)
        names = self._variables(equation)
        for inner in term.inner:
            names[inner] = _one(_parameter(term.inner_name(inner, place)))
        form = self._said.form_of(term.body, names)
        if not term.is_formula:
            name = _parameter(term.coefficient_name(place))
            form = product(form, _one(name))
        self._said.alike(form, self._slot(slot, equation))

    def _slot(self, slot: str, equation: str) -> Form:
        if slot == "H":
            return _one("H")
        if slot == "sensor":
            return _one(equation)
        rate = _quotient(equation, "t")
        return rate if slot == "F" else product(rate, self._effort(equation), -1.0)

    def _variables(self, equation: str) -> dict[str, Form]:
        model = self._model
        names = {name: _one(name) for name in (*model.states, *model.inputs, "t")}
        for effort, state in zip(model.efforts, model.states, strict=True):
            names[effort] = self._effort(state)
        rate = _quotient(equation, "t")
        for slope, of in zip(model.slopes, model.inputs, strict=True):
            names[slope] = product(rate, _one(of), -1.0)
        return names

    def _effort(self, state: str) -> Form:
        return _one(f"effort {state}" if self._model.has_energy else state)

    def solution(
        self,
        units: Mapping[str, str],
        split: Callable[[str], Powers | None],
        numbers_are_pure: bool = True,
    ) -> dict[str, Powers] | None:
        """Powers of the units by parameter and state; None for a contradiction."""
        told = dict(units)
        for name, entry in self._model.entries.items():
            if _is_stated(entry.parameter):
                told[_parameter(name)] = entry.parameter.unit
        known = {}
        for name, unit in told.items():
            powers = split(unit)
            if powers is not None:
                known[name] = powers
        said = self._said.said
        if not numbers_are_pure:
            said = [likeness for likeness in said if not likeness.is_number]
        found = solved_dimensions(said, known)
        if found is None:
            return None
        names = {state: state for state in self._model.states}
        names |= {name: _parameter(name) for name in self._model.entries}
        return {name: found[one] for name, one in names.items() if one in found}


def _one(name: str) -> Form:
    return {name: 1.0}


def _quotient(above: str, below: str) -> Form:
    return product(_one(above), _one(below), -1.0)


def _parameter(name: str) -> str:
    return f"parameter {name}"
