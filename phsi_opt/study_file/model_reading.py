"""The sections [model], [parameters] and [[effects]] become a model and effects.

Formulas are text that the package's own parser reads through its whitelist; nothing of
a study file is ever run as code. A formula's names are states, inputs, the time,
efforts, or parameters of the section [parameters].
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from itertools import count
from typing import Any

import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.data.checks import checked_names
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.estimation.fit_file import GUESSES, KINDS
from phsi_opt.model.directions import direction_parts, factors_of
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import RESERVED_IN_FORMULAS, names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import BY_EQUATION, Variables
from phsi_opt.model.terms import Dictionary, Term, polynomials, trigonometric
from phsi_opt.presentation.units import computed_unit, scale_of
from phsi_opt.study_file.keys import Complaints, Place, is_number, listed, shown
from phsi_opt.study_file.sections import DataSection
from phsi_opt.study_file.toml_text import toml_value

WITH_ENERGY, WITHOUT_ENERGY = KINDS  # the types of models
OF_ENERGY = ("H", "pairs", "S")
Content = Mapping[str, Any]
TERM_WAYS = ("body", "polynomials", "trigonometric")


@dataclass(frozen=True)
class ModelReader:
    """Makes models and effects of what a file says; what is wrong is noted."""

    file: Content  # what is usable of the file
    faults: Complaints  # where what is wrong is noted
    states: tuple[str, ...] = ()  # that formulas can name
    # by name; None where it is noted what is wrong
    parameters: dict[str, Parameter | None] = field(default_factory=dict)
    # the parameters that formulas asked for
    used: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, file: Content, faults: Complaints) -> "ModelReader":
        """With the names of the model and its parameters, before formulas are read."""
        reader = cls(file, faults)
        for name, content in file.get("parameters", {}).items():
            reader.parameters[name] = reader._parameter(content, "parameters", name)
        return replace(reader, states=reader._names("states"))

    @property
    def section(self) -> Content:
        return self.file.get("model", {})

    def _names(self, what: str) -> tuple[str, ...]:
        names: list[str] = []
        for name in self.section.get(what, ()):
            if name in names:
                self.faults.add(f"{name!r} is in the list twice.", "model", what)
                continue
            with self.faults.noting("model", what):
                checked_names([name], what, RESERVED_IN_FORMULAS, ModelError)
                names.append(name)
        return tuple(names)

    def _parameter(self, content: Any, *place: str | int) -> Parameter | None:
        """The parameter; None, and what is wrong noted, where it is none."""
        given = {"value": content} if is_number(content) else content
        settings = {**given, "guess": self._guess(given, *place, "guess")}
        start = settings.pop("start", None)
        if "value" in settings:
            settings["fixed"] = True
            if start is not None:
                said = (
                    "start is given, too; keep value if the parameter is known, "
                    "otherwise keep start."
                )
                self.faults.add(said, *place, "value")
        settings.setdefault("value", start)
        settings["unit"] = computed_unit(settings.get("unit", ""))
        scale = scale_of(settings["unit"])
        for key in ("value", "lower", "upper"):
            if settings.get(key) is not None:
                settings[key] = scale.read(settings[key])
        if settings.get("prior") is not None:
            mean, deviation = settings["prior"]
            settings["prior"] = (scale.read(mean), deviation * scale.size)
        with self.faults.noting(*place):
            return Parameter(**settings)
        return None

    def _guess(self, parameter: Content, *place: str | int) -> Any:
        given = parameter.get("guess", {})
        if "kind" not in given:
            if "guess" in parameter:
                self.faults.need(
                    f"expected {', '.join(GUESSES)}.", None, *place, "kind"
                )
            return None
        kind = GUESSES[given["kind"]]
        settings = {one.name: given.get(one.name, one.default) for one in fields(kind)}
        for name, value in settings.items():
            if value is MISSING:
                said = f"a guess of kind {given['kind']!r} needs this key."
                self.faults.need(said, None, *place, name)
                return None
        return kind(**settings)

    def model(self) -> Model | None:
        """The base model; None, and what is wrong noted, where it cannot be made."""
        section = self.section
        if not section or self.faults.about("model", "states"):
            return None
        kind = section.get("type", WITH_ENERGY)
        parts: dict[str, Any] = {"states": self.states, "kind": section.get("kind", {})}
        for what in ("inputs", "memory"):
            parts[what] = self._names(what)
        for slot in BY_EQUATION:
            parts[slot] = {
                equation: self._terms(
                    terms, slot, "model", slot, equation, along=equation
                )
                for equation, terms in section.get(slot, {}).items()
                if self._is_equation(equation, slot, "model", slot, equation)
            }
        if kind == WITH_ENERGY:
            parts["S"] = self._structure()
            said = 'expected the energy as a formula, such as "k*q**2/2 + p**2/(2*m)".'
            self.faults.need(said, section.get("H"), "model", "H")
            parts["H"] = self._terms(section.get("H") or (), "H", "model", "H")
        for name in OF_ENERGY:
            if kind == WITHOUT_ENERGY and section.get(name):
                said = f"a model of type {shown(kind)} has none; put the terms into F."
                self.faults.add(said, "model", name)
        if not self.faults.about("model") and not self.faults.about("effects"):
            for name in self.parameters:  # else a wrong name is noted at its formula
                if name not in self.used:
                    said = "no formula contains this name; correct it, or remove it."
                    self.faults.add(said, "parameters", name)
        if self.faults.about("model") or self.faults.about("parameters"):
            return None
        with self.faults.noting("model", value=""):
            return KINDS[kind](**parts)
        return None

    def _is_state(self, name: str, *place: str | int) -> bool:
        """Whether the model has a state of this name; else it is noted."""
        with self.faults.noting(*place):
            said = f"{name!r} is not a state of the model"
            require_known(name, self.states, said)
        return name in self.states

    def _is_equation(self, equation: str, slot: str, *place: str | int) -> bool:
        """Whether a slot can have terms there; else it is noted."""
        if equation.isidentifier() or slot == "sensor":
            return self._is_state(equation, *place)
        with self.faults.noting(*place):
            direction_parts(equation, tuple(self.states))
            return True
        return False

    def _structure(self) -> Any:
        pair = toml_value([list(self.states[:2])])
        body = f"A body has pairs = {pair}, the position first; a tank has pairs = []."
        ways = ("pairs", "S")
        if self.faults.exactly_one(self.section, ways, "model", proposal=body) == "S":
            return self.section.get("S")
        S = np.zeros((len(self.states), len(self.states)))
        for pair in self.section.get("pairs", ()):
            are_states = [self._is_state(name, "model", "pairs") for name in pair]
            if all(are_states):
                row, column = map(self.states.index, pair)
                S[row, column] = 1.0
                S[column, row] = -1.0
        return S

    def _terms(
        self, content: Any, slot: str, *place: str | int, along: str = ""
    ) -> Dictionary:
        """The terms at a place; ``slot`` decides which names they may have.

        And so does the direction ``along`` which they stand.
        """
        terms: list[Term] = []
        for number, one in enumerate(listed(content)):
            with self.faults.noting(*place, value=one):
                if isinstance(one, dict):
                    terms += self._table(one, *place, number)
                else:
                    terms += self._formula(str(one), slot, place, along)
        with self.faults.noting(*place):
            return Dictionary(tuple(terms))
        return Dictionary()

    def _formula(self, text: str, slot: str, place: Place, along: str) -> Dictionary:
        variables = Variables(self.states, self._names("inputs"))
        allowed = variables.of_slot(slot)
        own = names_of(text) - allowed
        if along:
            own |= factors_of(along, self.states) - allowed
        self.used.update(own)
        for one in sorted(own - set(self.parameters)):
            known = sorted({*allowed, *self.parameters})
            said = (
                f"{one!r} is not known here; known are "
                f"{', '.join(known)}.{did_you_mean(one, known)} Define parameters in "
                f"the section [parameters]: {one} = {{ start = 1.0 }}."
            )
            if slot == "H" and one in variables.of_slot("R"):
                said = (
                    f"{one!r} is not allowed in H: an energy depends only on the "
                    "states; put the term into F."
                )
            self.faults.add(said, *place, value=text)
        # In the order of the file; None where it is noted what is wrong.
        known_ones = {k: p for k, p in self.parameters.items() if k in own and p}
        return Dictionary((Term(text, None, known_ones),))

    def _table(self, content: Content, *place: str | int) -> Dictionary:
        """Polynomials, waves, or one term, whose inner parameters are its own."""
        way = self.faults.exactly_one(content, TERM_WAYS, *place)
        if way not in content:
            return Dictionary()  # what is wrong is noted
        names = content[way]
        if way == "polynomials":
            constant = content.get("constant", False)
            return polynomials(names, content.get("degree", 2), constant)
        if way == "trigonometric":
            return trigonometric(names, content.get("n", 1), content.get("frequency"))
        given = content.get("coefficient", {})
        coefficient = self._parameter(given, *place, "coefficient") or Parameter()
        inner = {}
        for name, own in content.get("inner", {}).items():
            inner[name] = self._parameter(own, *place, "inner", name) or Parameter()
        return Dictionary((Term(names, coefficient, inner, content.get("name", "")),))

    def effects(self) -> tuple[Effect, ...]:
        made = map(self._effect, self.file.get("effects", ()), count())
        return tuple(filter(None, made))

    def _effect(self, content: Content, number: int) -> Effect | None:
        place = ("effects", number)
        for name in ("name", "slot", "equation", "term"):
            self.faults.need(
                "an effect needs this key.", content.get(name), *place, name
            )
        equation = content.get("equation", "")
        if equation:
            self._is_equation(equation, content["slot"], *place, "equation")
        if self.faults.about(*place):
            return None
        rates = content.get("memory", {})
        larger = replace(self, states=(*self.states, *rates))
        memory = {}
        for state, rate in rates.items():
            memory[state] = larger._terms(rate, "F", *place, "memory", state)
        along = "" if content["slot"] == "sensor" else equation
        term = larger._terms(
            content["term"], content["slot"], *place, "term", along=along
        )
        with self.faults.noting(*place, value=""):
            return Effect(**{**content, "term": term, "memory": memory})
        return None


def check_channels(model: Model, data: DataSection, faults: Complaints) -> None:
    """Note where the sections [model] and [data] name different states or inputs."""
    measurable = [name for name in model.states if name not in model.memory]
    for what, wanted, otherwise in (
        ("states", measurable, ", or { measured = false }"),
        ("inputs", model.inputs, ""),
    ):
        told = getattr(data, what)
        missing = [name for name in wanted if name not in told]
        further = [name for name in told if name not in wanted]
        for name in missing:
            said = f'the model has this name: give {{ column = "..." }}{otherwise}.'
            faults.add(said + did_you_mean(name, further), "data", what, name)
        for name in further:
            said = (
                f"it is not in model.{what}, {shown(list(wanted))}; add it there, or "
                f"remove it here.{did_you_mean(name, missing)}"
            )
            faults.add(said, "data", what, name)
