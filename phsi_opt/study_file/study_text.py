"""A study as text: the study file, TOML with comments, and the same as a Python script.

The counterpart of the modules that read: records become texts, numbers, lists and
tables, and what a study file has no form for is refused by name. The script is written
from the same records, in the names that users import, and looks for the data beside
itself.
"""

import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from phsi_opt import __all__ as public
from phsi_opt.errors import ModelError
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.presentation.numbers import LINE_WIDTH
from phsi_opt.presentation.units import scale_of
from phsi_opt.study_file.keys import key_at
from phsi_opt.study_file.sections import Sections, told, without
from phsi_opt.study_file.toml_text import key_text, text_template, toml_value

Content = dict[str, Any]
HEAD = """\
# Study file of phsi_opt: the data, the model and the added effects.
# `phsi-opt check` reads it; docs/command_line.md lists every key.
"""
# The tables with a header of their own, in their order.
WITH_HEADERS = (
    *("data", "data.states", "data.inputs", "held_out", "final"),
    *("model", "model.R", "model.F", "model.sensor", "parameters"),
    *("effects", "study", "loss"),
)
ABOUT_ENERGY = (
    "dx/dt = (S - R) grad H + F; names in formulas are states, inputs, t,\n"
    "# efforts such as dH_dp, and the parameters below."
)
ABOUT_FIRST_ORDER = (
    "dx/dt = F - R x; names in formulas are states, inputs, t and the\n"
    "# parameters below."
)


def study_text(study: Sections) -> str:
    """The whole file."""
    about = ABOUT_ENERGY if study.base.has_energy else ABOUT_FIRST_ORDER
    return f"{HEAD}\n{text_of(_content(study), about)}"


def text_of(content: Mapping[str, Any], about_model: str = "") -> str:
    """The text of the tables that are not empty.

    With a comment about the model every table says what it is for, too.
    """
    sections = []
    for path in WITH_HEADERS:
        name, _, below = path.partition(".")
        found = content.get(name) or {}
        for table in found if isinstance(found, list) else [found]:
            header = f"[[{path}]]" if isinstance(found, list) else f"[{path}]"
            entries = table.get(below) if below else table
            lines = list(_entries(path, entries)) if isinstance(entries, dict) else []
            if lines:
                said = about_model if path == "model" else key_at(path).sentence
                comment = [f"# {said}"] if about_model else []
                sections.append("\n".join([*comment, header, *lines]) + "\n")
    return "\n".join(sections)


def _entries(path: str, table: Mapping[str, Any]) -> Iterator[str]:
    """The lines of a table; a list that is too long for one has lines of its own."""
    for key, value in table.items():
        if f"{path}.{key}" in WITH_HEADERS and isinstance(value, dict):
            continue
        line = f"{key_text(key)} = {toml_value(value)}"
        if len(line) > LINE_WIDTH and isinstance(value, list):
            items = [f"    {toml_value(one)},\n" for one in value]
            line = f"{key_text(key)} = [\n{''.join(items)}]"
        yield line


# ---- records as tables ---------------------------------------------------------------


def _content(study: Sections) -> Content:
    if study.loss.noise is not None:
        raise ModelError(
            f"loss: noise={dict(study.loss.noise)!r} belongs to the columns of a "
            "study file; give it to the channels (Channel(noise=...)), and not to "
            "the loss."
        )
    parameters = shared_parameters(study.base, study.own_effects)
    data = replace(study.data, places={})
    return {
        "data": {"time": {}, **_plain(data)},
        "held_out": _plain(study.held_out),
        "final": _plain(study.final),
        "model": _model(study.base),
        "parameters": _plain(parameters),
        "effects": _plain(study.own_effects),
        "study": {"added": [], **_plain(study.steps)},
        "loss": told(study.loss),
    }


def _plain(value: Any) -> Any:
    """A value as tables, lists, texts and numbers; of records, what they tell."""
    if isinstance(value, Dictionary):
        terms = list(map(_plain, value))
        return terms[0] if len(terms) == 1 else terms
    if isinstance(value, Term) and value.coefficient is None:
        return value.body
    if isinstance(value, Parameter):
        return _parameter(value)
    if is_dataclass(value):
        return without(_plain(told(value)), {})
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    return list(map(_plain, value)) if isinstance(value, tuple) else value


def _parameter(parameter: Parameter) -> Content | float:
    """A parameter: a plain number where it is known and nothing else is told of it."""
    scale = scale_of(parameter.unit)
    content = told(parameter)
    for key in ("value", "lower", "upper"):
        if key in content and scale.unit != parameter.unit:
            content[key] = float(f"{scale.shown(content[key]):.15g}")
    if parameter.prior is not None:
        mean, deviation = parameter.prior
        both = (scale.shown(mean), deviation / scale.size)
        content["prior"] = [float(f"{one:.15g}") for one in both]
    content |= {"unit": scale.unit} if parameter.unit else {}
    guess = content.get("guess")
    if guess is not None:
        content["guess"] = {"kind": type(guess).__name__, **_plain(guess)}
    if "value" in content and not content.pop("fixed", False):
        content = {"start": content.pop("value"), **content}
    return content["value"] if list(content) == ["value"] else content


def model_parts(model: Model) -> dict[str, Any]:
    """The parts of a model that say something, by their names, without S."""
    energy = {"H": model.H} if model.has_energy else {}
    names = ("states", "inputs", "memory", "kind", *BY_EQUATION)
    parts = {name: getattr(model, name) for name in names}
    return without(parts, (), {}) | energy


def model_sections(model: Model) -> tuple[Content, Content]:
    """The sections [model] and [parameters]."""
    return _model(model), _plain(shared_parameters(model, ()))


def _model(model: Model) -> Content:
    structure: Content = {}
    if model.has_energy:  # as pairs where it is nothing but pairs, else as a matrix
        S = np.array(model.S)
        structure["S"] = S.tolist()
        if np.all(np.isin(S, (-1.0, 0.0, 1.0))):
            pairs = np.argwhere(S > 0).tolist()
            structure = {"pairs": [[model.states[i] for i in pair] for pair in pairs]}
    return {"type": type(model).__name__, **structure, **_plain(model_parts(model))}


def shared_parameters(
    model: Model, own_effects: Sequence[Effect]
) -> dict[str, Parameter]:
    """The parameters of all formulas, by name, in the order of the model."""
    sums = [model.H]
    for slot in BY_EQUATION:
        sums += getattr(model, slot).values()
    for effect in own_effects:
        sums += [effect.term, *effect.memory.values()]
    found: dict[str, Parameter] = {}
    for term in filter(lambda one: one.is_formula, chain.from_iterable(sums)):
        for name, parameter in term.inner.items():
            if found.setdefault(name, parameter) != parameter:
                raise ModelError(
                    f"parameter {name!r} of an effect differs from the parameter of "
                    "this name in the model; a study file has one parameter per "
                    "name. Rename one."
                )
    return found


# ---- the script ----------------------------------------------------------------------

IN_SCRIPT = "parameters"  # the variable in which the script keeps them
INDENT = "    "


class Code(str):
    """Source that is written as it is."""


@dataclass(frozen=True)
class Source:
    """Writes values as source; ``imports`` are the lines that it needs."""

    imports: set[str] = field(default_factory=set)

    def of(self, value: Any) -> str:
        if isinstance(value, Code):
            return value
        if isinstance(value, str):
            return json.dumps(value, ensure_ascii=False)  # in double quotes
        if isinstance(value, Mapping):
            pairs = [f"{self.of(k)}: {self.of(one)}" for k, one in value.items()]
            return _enclosed("{", pairs, "}")
        if isinstance(value, list):
            return _enclosed("[", map(self.of, value), "]")
        if isinstance(value, tuple):
            items = [f"{self.of(one)}," for one in value]
            return f"({' '.join(items)})"
        if is_dataclass(value):
            return self._record(value)
        is_infinite = value in (float("inf"), float("-inf"))
        return f'float("{value}")' if is_infinite else repr(value)

    def call(self, name: str, /, *positional: Any, **named: Any) -> Code:
        """A call; an argument a line where it is long."""
        arguments = list(map(self.of, positional))
        arguments += [f"{key}={self.of(value)}" for key, value in named.items()]
        return Code(_enclosed(f"{name}(", arguments, ")"))

    def _record(self, record: Any) -> str:
        if isinstance(record, Dictionary):
            parts = []
            for term in record:
                write = self._formula if term.is_formula else self._term
                parts.append(write(term))
            return " + ".join(parts) or 'ph.formula("0")'
        kind = type(record).__name__
        if kind in public:
            return self.call(f"ph.{kind}", **told(record))
        self.imports.add(f"from {type(record).__module__} import {kind}")
        return self.call(kind, **told(record))

    def _formula(self, term: Term) -> str:
        inner = {one: Code(f"{IN_SCRIPT}[{self.of(one)}]") for one in term.inner}
        return self.call("ph.formula", term.body, **inner)

    def _term(self, term: Term) -> str:
        """A term with a coefficient, which a formula has not."""
        self.imports.add(f"from {Dictionary.__module__} import Dictionary, Term")
        one = self.call("Term", **told(term))
        return self.call("Dictionary", Code(f"({one},)"))


def _enclosed(opening: str, parts: Iterable[str], closing: str) -> str:
    """On one line where that fits, else a part a line."""
    listed = list(parts)
    flat = f"{opening}{', '.join(listed)}{closing}"
    if not listed or (len(flat) <= LINE_WIDTH and "\n" not in flat):
        return flat
    lines = [textwrap.indent(f"{part},", INDENT) for part in listed]
    return "\n".join([opening, *lines, closing])


def study_script(study: Sections) -> str:
    """The whole script."""
    source = Source()
    parts = model_parts(study.base)
    if study.base.has_energy:
        parts["S"] = study.base.S
    else:
        parts.setdefault("F", {})
    shared = shared_parameters(study.base, study.own_effects)
    settings = told(study) | {"base": Code("model"), "folder": Code("FOLDER")}
    settings["data"] = replace(study.data, places={})
    settings.pop("unwritten", None)  # its table is among the files
    return text_template("study_script.py.jinja").render(
        parameters={name: _short(one) for name, one in shared.items()},
        kind=type(study.base).__name__,
        parts=parts,
        settings=settings,
        call=source.call,
        imports=source.imports,
    )


def _short(parameter: Parameter) -> Any:
    """A plain number where it is known and nothing else is told."""
    return parameter.value if set(told(parameter)) == {"value", "fixed"} else parameter
