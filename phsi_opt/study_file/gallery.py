"""The gallery: base models to begin with, for the page and for ``phsi-opt init``.

``gallery.toml`` has them, ``pictures/`` their drawings. The names of their states and
inputs are given to the columns of a table by name, unit and order.
"""

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.resources import files
from typing import Any

from phsi_opt.arguments import require_known
from phsi_opt.errors import DataError
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.presentation.units import are_alike, measure_of
from phsi_opt.study_file.columns import INPUT, STATE, UNUSED, Column

OR_ANY = " or any"  # behind the unit of an input whose coefficient takes up its unit


@dataclass(frozen=True)
class BaseModel:
    """One entry of the gallery (see ``gallery.toml``)."""

    name: str  # such as "mass"
    title: str
    about: str  # what it is, in a sentence
    equation: str  # as an engineer writes it
    states: Mapping[str, str]  # the units of those that can be measured, by name
    model: Mapping[str, Any]  # sections of a study file, as are the ``parameters``
    parameters: Mapping[str, Any]
    # By name: the unit, the terms by slot and state, and parameters.
    inputs: Mapping[str, Mapping[str, Any]]
    hidden: Mapping[str, str] = field(default_factory=dict)  # of states without sensor
    seldom: Sequence[str] = ()  # the states that are measured only beside the inputs
    # States, model and terms of the inputs that replace these if one of the states has
    # a column, such as a velocity.
    velocity: Mapping[str, Any] = field(default_factory=dict)
    is_named: bool = False  # whether columns become states by their names alone

    @property
    def picture(self) -> str:
        """The drawing, as SVG in the colour of the text around it."""
        return _text(f"pictures/{self.name}.svg")

    @property
    def units(self) -> dict[str, str]:
        return {**self.states, **self.hidden}

    @property
    def input_units(self) -> dict[str, str]:
        return {name: one["unit"] for name, one in self.inputs.items()}

    @property
    def places(self) -> tuple[tuple[str, dict[str, str]], ...]:
        """What columns may be, in the order in which it is tried."""
        usual = dict(self.states)
        seldom = dict(zip(self.seldom, map(usual.pop, self.seldom), strict=True))
        return (STATE, usual), (INPUT, self.input_units), (STATE, seldom)

    @property
    def names(self) -> str:
        states, inputs = map(with_units, (self.units, self.input_units))
        return f"states {states}; inputs {inputs}"

    def seen_by(self, columns: Sequence[Column]) -> "BaseModel":
        """The model in position and velocity if one of the columns is a velocity."""
        states = self.velocity.get("states", {})
        further = {name: states[name] for name in states if name not in self.states}
        if not matched(columns, further, lambda column: False):
            return self
        inputs = dict(self.inputs)
        for name, terms in self.velocity["terms"].items():
            inputs[name] = {**inputs[name], **terms}
        model = self.velocity["model"]
        return replace(self, states=states, hidden={}, model=model, inputs=inputs)

    def sections(self, inputs: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
        """The sections [model] and [parameters], with the inputs that were measured."""
        inputs = list(self.inputs) if self.is_named else list(inputs)
        model: dict[str, Any] = {"states": list(self.units), "inputs": inputs}
        model |= deepcopy(dict(self.model))
        parameters = dict(self.parameters)
        for name, one in self.inputs.items():
            if name not in inputs:
                parameters |= {name: one["otherwise"]} if "otherwise" in one else {}
                continue
            parameters |= one.get("parameters", {})
            for slot in BY_EQUATION:
                for state, term in one.get(slot, {}).items():
                    terms = model.setdefault(slot, {})
                    known = f"{terms[state]} + " if state in terms else ""
                    terms[state] = (known + term).replace("+ -", "- ")
        return model, parameters


def with_units(units: Mapping[str, str]) -> str:
    """Names with their units: "q in m, p in kg m/s"."""
    return ", ".join(f"{n} in {unit}" if unit else n for n, unit in units.items())


def base_model(name: str) -> BaseModel:
    """The base model of a name."""
    require_known(name, GALLERY, f"--model {name!r} is not in the gallery", DataError)
    return GALLERY[name]


def _text(name: str) -> str:
    return (files("phsi_opt.study_file") / name).read_text(encoding="utf-8")


GALLERY = {
    name: BaseModel(name, **one)
    for name, one in tomllib.loads(_text("gallery.toml")).items()
}


# ---- columns for its states and inputs -----------------------------------------------


def give_parts(
    columns: Sequence[Column], base: BaseModel
) -> tuple[BaseModel, dict[str, str]]:
    """Let columns be states and inputs of a base model; others are left out as lost.

    Returns:
        The model, in position and velocity if that was measured, and the units of its
        states that no column has.
    """
    base = base.seen_by(list(filter(lambda one: one.part == STATE, columns)))
    left = [one for one in columns if one.part in (STATE, INPUT)]
    for part, units in base.places:
        is_state = part == STATE
        is_guessed = not (is_state and base.is_named)
        own = [one for one in left if one.part == part and is_guessed]
        left.sort(key=lambda one: (one.part != part, one.may_be_input == is_state))
        for column, name in matched(left, units, own.__contains__):
            left.remove(column)
            column.part = part
            column.name = name
            if _is_speed_of_rotation(column, units[name]):
                column.unit = "rpm"
    for column in left:
        column.lost = column.part
        column.part = UNUSED
    lacking = {}
    known = [column.name for column in columns if column.part == STATE]
    for name, unit in base.units.items():
        if name not in known:
            lacking[name] = unit.removesuffix(OR_ANY)
    return base, lacking


def matched(
    columns: Sequence[Column],
    units: Mapping[str, str],
    may_guess: Callable[[Column], bool] = lambda column: True,
) -> list[tuple[Column, str]]:
    """Columns with their names in a model: by name, by quantity, or by a guess."""
    found = []
    free = dict(units)
    left = list(columns)
    for is_alike in (_is_itself, _is_same, _is_same_quantity, _is_perhaps_same):
        for column in list(left):
            if is_alike is _is_perhaps_same and not may_guess(column):
                continue
            alike = filter(partial(is_alike, column), free.items())
            name, _ = next(alike, ("", ""))
            if name:
                found.append((column, name))
                left.remove(column)
                del free[name]
    return found


def _is_itself(column: Column, wanted: tuple[str, str]) -> bool:
    return column.name == wanted[0] and _is_same(column, wanted)


def _is_same(column: Column, wanted: tuple[str, str]) -> bool:
    called, name = (
        re.sub(r"\W|_", "", one).lower() for one in (column.name, wanted[0])
    )
    is_possible = _is_perhaps_same(column, wanted) or _is_same_quantity(column, wanted)
    return called == name and is_possible


def _is_same_quantity(column: Column, wanted: tuple[str, str]) -> bool:
    """Whether two units are of one quantity: m and mm are."""
    if _is_speed_of_rotation(column, wanted[1]):
        return True
    return are_alike(column.unit, wanted[1].removesuffix(OR_ANY))


def _is_speed_of_rotation(column: Column, wanted: str) -> bool:
    """Whether it is one in turns per minute, as in German: 1/min, U/min."""
    turning = map(measure_of, ("1/min", "U/min"))
    return wanted == "rad/s" and measure_of(column.unit) in turning


def _is_perhaps_same(column: Column, wanted: tuple[str, str]) -> bool:
    return not column.unit or wanted[1].endswith(OR_ANY)
