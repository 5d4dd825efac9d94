"""The sections [model] and [parameters]: formulas and numbers become a model.

Formulas are text that the package's own parser reads through its whitelist; nothing of
a study file is ever run as code.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.checks import checked_names
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary
from phsi_opt.model.variables import Variables
from phsi_opt.study_file.parameter_reading import read_parameter
from phsi_opt.study_file.part import Complaints, Part, shown
from phsi_opt.study_file.sections import Channel, DataSection
from phsi_opt.study_file.term_reading import TermReader

TYPES = ("PseudoHamiltonian", "FirstOrder")
STRUCTURE = ("pairs", "S")


@dataclass
class ModelReading:
    """A model as it is read; ``used`` are the parameters that formulas asked for."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: Mapping[str, Parameter | None]
    used: set[str] = field(default_factory=set)

    @property
    def terms(self) -> TermReader:
        """Reads the formulas of this model."""
        variables = Variables(self.states, self.inputs)
        return TermReader(variables, self.parameters, self.used)


def read_names(file: Part) -> ModelReading:
    """The names of the model and its parameters, before any formula is read."""
    model = file.part("model")
    if not model.content:
        said = "there is no section [model]; it tells the states and the energy."
        file.complaints.add("model", said)
    states = _names(model, "states")
    if model.content and not states and not file.complaints.about("model.states"):
        said = 'expected the names of the states, such as ["q", "p"].'
        file.complaints.add("model.states", said)
    parameters = {}
    section = file.part("parameters")
    for name in section.content:
        parameters[name] = read_parameter(section, name)
    return ModelReading(states, _names(model, "inputs"), parameters)


def _names(model: Part, what: str) -> tuple[str, ...]:
    found: list[str] = []
    for name in model.texts(what):
        try:
            checked_names([name], what)
        except ModelError as error:
            model.complain(what, str(error))
            continue
        if name in found:
            model.complain(what, f"{name!r} stands there twice.")
        found.append(name)
    return tuple(dict.fromkeys(found))


def read_model(file: Part, reading: ModelReading) -> Model | None:
    """The base model; None, and what is wrong noted, where it cannot be made."""
    model = file.part("model")
    has_energy = model.one_of("type", TYPES, TYPES[0]) == TYPES[0]
    parts: dict[str, Any] = {
        "states": reading.states,
        "inputs": reading.inputs,
        "memory": _names(model, "memory"),
        "kind": _kind(model),
    }
    if not model.content:
        return None
    for slot in BY_EQUATION:
        parts[slot] = _slot(model, slot, reading)
    if has_energy:
        parts["S"] = _structure(model, reading.states)
        parts["H"] = _energy(model, reading)
    else:
        _refuse_energy(model)
    _check_parameters_are_used(file, reading)
    if file.complaints.about("model", "parameters"):
        return None
    try:
        return PseudoHamiltonian(**parts) if has_energy else FirstOrder(**parts)
    except ModelError as error:
        file.complaints.add("model", str(error))
        return None


def _energy(model: Part, reading: ModelReading) -> Dictionary:
    if model.content.get("H", "") in ("", []):
        said = 'expected the energy as a formula, such as "k*q**2/2 + p**2/(2*m)".'
        model.complaints.add("model.H", said)
        return Dictionary()
    return reading.terms.read(model, "H", "H")


def _refuse_energy(model: Part) -> None:
    for name in ("H", *STRUCTURE):
        if name in model.content:
            model.complain(
                name, 'a model of type "FirstOrder" has none; put the terms into F.'
            )


def _kind(model: Part) -> Any:
    told = model.content.get("kind", {})
    return told if isinstance(told, str) else dict(model.part("kind").content)


def _slot(model: Part, slot: str, reading: ModelReading) -> dict[str, Dictionary]:
    by_equation = {}
    section = model.part(slot)
    for state in section.content:
        if state in reading.states:
            by_equation[state] = reading.terms.read(section, state, slot)
            continue
        listed = ", ".join(reading.states) or "none"
        section.complain(
            state,
            f"{state!r} is not a state of the model; its states are {listed}."
            f"{did_you_mean(state, reading.states)}",
        )
    return by_equation


def _structure(model: Part, states: tuple[str, ...]) -> Any:
    way = model.exactly_one(STRUCTURE) if model.content else ""
    if way == "S":
        return model.content["S"]
    S = np.zeros((len(states), len(states)))
    pairs = model.content.get("pairs", [])
    if way and not isinstance(pairs, list):
        model.complain("pairs", 'expected a list of pairs, such as [["q", "p"]].')
        return S
    for pair in pairs:
        if _is_pair(model, pair, states):
            row = states.index(pair[0])
            column = states.index(pair[1])
            S[row, column] = 1.0
            S[column, row] = -1.0
    return S


def _is_pair(model: Part, pair: Any, states: tuple[str, ...]) -> bool:
    if not isinstance(pair, list) or len(pair) != 2 or pair[0] == pair[1]:
        model.complain("pairs", f'{pair!r} is no pair of states such as ["q", "p"].')
        return False
    for name in pair:
        if name not in states:
            model.complain(
                "pairs",
                f"{name!r} is not a state of the model.{did_you_mean(name, states)}",
            )
            return False
    return True


def _check_parameters_are_used(file: Part, reading: ModelReading) -> None:
    if file.complaints.about("model", "effects"):
        return  # a name that is wrong in a formula is told there
    for name in reading.parameters:
        if name not in reading.used:
            file.part("parameters").complain(
                name, "no formula has this name; correct it, or leave it out."
            )


def check_channels(model: Model, data: DataSection, complaints: Complaints) -> None:
    """Note where the sections [model] and [data] name different states or inputs."""
    measurable = [name for name in model.states if name not in model.memory]
    otherwise = ", or { measured = false }"
    _check_told("states", measurable, data.states, otherwise, complaints)
    _check_told("inputs", model.inputs, data.inputs, "", complaints)


def _check_told(
    what: str,
    wanted: Sequence[str],
    told: Mapping[str, Channel],
    otherwise: str,
    complaints: Complaints,
) -> None:
    missing = [name for name in wanted if name not in told]
    further = [name for name in told if name not in wanted]
    for name in missing:
        complaints.add(
            f"data.{what}.{name}",
            f'the model has it: give {{ column = "..." }}{otherwise}.'
            f"{did_you_mean(name, further)}",
        )
    for name in further:
        complaints.add(
            f"data.{what}.{name}",
            f"it is not among model.{what}, {shown(list(wanted))}; name it there too, "
            f"or leave it out here.{did_you_mean(name, missing)}",
        )
