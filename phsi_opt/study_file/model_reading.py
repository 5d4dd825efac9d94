"""The sections [model] and [parameters]: formulas and numbers become a model.

Formulas are text that the package's own parser reads through its whitelist; nothing of
a study file is ever run as code. A formula's names are states, inputs, the time,
efforts, or parameters of the section [parameters]. Tables of terms and guesses have the
names of the package's records, as in saved fits.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.estimation.model_content import GUESSES, KINDS
from phsi_opt.model.checks import checked_names
from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary, Term, polynomials, trigonometric
from phsi_opt.model.variables import Variables
from phsi_opt.study_file.complaints import Complaints, Part, shown, texts
from phsi_opt.study_file.keys import is_number
from phsi_opt.study_file.sections import Channel, DataSection

WITH_ENERGY, WITHOUT_ENERGY = KINDS  # the types of models
OF_ENERGY = ("H", "pairs", "S")


def read_parameter(section: Part, name: str) -> Parameter | None:
    """The parameter under a name; None, and what is wrong noted, where it is none."""
    content = section.content[name]
    part = section.part(name)
    settings: dict[str, Any] = {"value": content, "fixed": True}
    if not is_number(content):
        settings = {**content, "guess": _guess(part)}
        if "start" in content and "value" in content:
            said = "there is a start too; keep value where it is known, start where not"
            part.complain("value", f"{said}.")
        start = settings.pop("start", None)
        if "value" in content:
            settings["fixed"] = True
        settings.setdefault("value", start)
    try:
        return Parameter(**settings)
    except ModelError as error:
        section.complain(name, error)
        return None


def _guess(parameter: Part) -> Scan | Share | Tried | None:
    part = parameter.part("guess")
    kind = part.get("kind")
    if kind is None:
        if "guess" in parameter.content:
            part.need("kind", f"expected {', '.join(GUESSES)}.")
        return None
    settings = {}
    for one in fields(GUESSES[kind]):
        if one.name in part.content:
            settings[one.name] = part.content[one.name]
        elif one.default is MISSING:
            part.need(one.name, f"a guess of kind {kind!r} needs it.")
            return None
    return GUESSES[kind](**settings)


@dataclass(frozen=True)
class ModelReader:
    """Reads formulas; ``used`` are the parameters that they asked for."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: Mapping[str, Parameter | None]
    used: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, file: Part) -> "ModelReader":
        """With the names of the model and its parameters, before formulas are read."""
        model = file.part("model")
        if not model.content:
            file.need("model", "there is no section [model]; it tells the energy.")
        else:
            said = 'expected the names of the states, such as ["q", "p"].'
            model.need("states", said)
        section = file.part("parameters")
        parameters = {name: read_parameter(section, name) for name in section.content}
        return cls(_names(model, "states"), _names(model, "inputs"), parameters)

    def with_states(self, names: Iterable[str]) -> "ModelReader":
        """The same for further states."""
        return replace(self, states=(*self.states, *names))

    def model(self, file: Part) -> Model | None:
        """The base model; None, and what is wrong noted, where it cannot be made."""
        part = file.part("model")
        if not part.content:
            return None
        kind = part.get("type", WITH_ENERGY)
        parts: dict[str, Any] = {
            "states": self.states,
            "inputs": self.inputs,
            "memory": _names(part, "memory"),
            "kind": part.get("kind", {}),
        }
        for slot in BY_EQUATION:
            parts[slot] = self._slot(part, slot)
        if kind == WITH_ENERGY:
            parts["S"] = self._structure(part)
            said = 'expected the energy as a formula, such as "k*q**2/2 + p**2/(2*m)".'
            part.need("H", said)
            parts["H"] = self.terms(part, "H", "H") if part.get("H") else Dictionary()
        for name in OF_ENERGY:
            if kind == WITHOUT_ENERGY and name in part.content:
                said = f"a model of type {shown(kind)} has none; put the terms into F."
                part.complain(name, said)
        self._check_parameters_are_used(file)
        if file.complaints.about("model", "parameters"):
            return None
        try:
            return KINDS[kind](**parts)
        except ModelError as error:
            file.complaints.add("model", error)
            return None

    def _slot(self, model: Part, slot: str) -> dict[str, Dictionary]:
        section = model.part(slot)
        listed = ", ".join(self.states) or "none"
        for state in section.content:
            if state not in self.states:
                section.complain(
                    state,
                    f"{state!r} is not a state of the model; its states are {listed}."
                    f"{did_you_mean(state, self.states)}",
                )
        known = [state for state in section.content if state in self.states]
        return {state: self.terms(section, state, slot) for state in known}

    def _structure(self, model: Part) -> Any:
        if model.exactly_one("pairs", "S") == "S":
            return model.get("S")
        S = np.zeros((len(self.states), len(self.states)))
        for pair in model.get("pairs", []):
            unknown = [name for name in pair if name not in self.states]
            for name in unknown:
                hint = did_you_mean(name, self.states)
                model.complain("pairs", f"{name!r} is not a state of the model.{hint}")
            if not unknown:
                row, column = map(self.states.index, pair)
                S[row, column] = 1.0
                S[column, row] = -1.0
        return S

    def _check_parameters_are_used(self, file: Part) -> None:
        if file.complaints.about("model", "effects"):
            return  # a name that is wrong in a formula is told there
        for name in self.parameters:
            if name not in self.used:
                file.part("parameters").complain(
                    name, "no formula has this name; correct it, or leave it out."
                )

    def terms(self, part: Part, name: str, slot: str) -> Dictionary:
        """The terms under a key; what is wrong is noted, and left out.

        Args:
            part: the table in which they stand.
            name: the key.
            slot: where they act; it decides which names they may have.
        """
        content = part.get(name, [])
        terms: list[Term] = []
        is_list = isinstance(content, list)
        for number, one in enumerate(content if is_list else [content]):
            try:
                if isinstance(one, dict):
                    key = f"{part.path(name)}[{number}]" if is_list else part.path(name)
                    terms += self._table(Part(key, one, part.complaints))
                else:
                    terms += self._formula(part.path(name), str(one), slot, part)
            except ModelError as error:
                part.complaints.add(part.path(name), error, one)
        try:
            return Dictionary(tuple(terms))
        except ModelError as error:
            part.complain(name, error)
            return Dictionary()

    def _formula(self, key: str, text: str, slot: str, part: Part) -> Dictionary:
        variables = Variables(self.states, self.inputs)
        allowed = variables.of_slot(slot)
        own = names_of(text) - allowed
        self.used.update(own)
        for one in sorted(own - set(self.parameters)):
            known = sorted({*allowed, *self.parameters})
            said = (
                f"{one!r} is not known here; known are {', '.join(known)}."
                f"{did_you_mean(one, known)} A parameter stands in the section "
                f"[parameters]: {one} = {{ start = 1.0 }}."
            )
            if slot == "H" and one in variables.of_slot("R"):
                said = (
                    f"{one!r} may not stand in H: an energy depends on the states "
                    "alone; put the term into F."
                )
            part.complaints.add(key, said, text)
        inner = {}
        for one, parameter in self.parameters.items():  # in the order of the file
            if one in own and parameter is not None:  # else it is noted what is wrong
                inner[one] = parameter
        return Dictionary((Term(text, None, inner),))

    def _table(self, part: Part) -> Dictionary:
        """Polynomials, waves, or one term, whose inner parameters are its own."""
        way = part.exactly_one("body", "polynomials", "trigonometric")
        if way not in part.content:
            return Dictionary()  # what is wrong is noted
        names = texts(part.content[way])
        if way == "polynomials":
            constant = part.get("constant", False)
            return polynomials(names, part.get("degree", 2), constant)
        if way == "trigonometric":
            return trigonometric(names, part.get("n", 1), part.get("frequency"))
        told = replace(part, content={"coefficient": {}, **part.content})
        coefficient = read_parameter(told, "coefficient") or Parameter()
        section = part.part("inner")
        inner = {}
        for name in section.content:
            parameter = read_parameter(section, name)
            if parameter is not None:
                inner[name] = parameter
        return Dictionary((Term(names[0], coefficient, inner, part.get("name", "")),))


def _names(model: Part, what: str) -> tuple[str, ...]:
    found: list[str] = []
    for name in texts(model.get(what, ())):
        try:
            checked_names([name], what)
        except ModelError as error:
            model.complain(what, error)
            continue
        if name in found:
            model.complain(what, f"{name!r} stands there twice.")
        found.append(name)
    return tuple(dict.fromkeys(found))


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
