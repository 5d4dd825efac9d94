"""The Python script that does what a study file says, step by step.

It is written from the records, in the names that users import, and looks for the data
beside itself.
"""

import json
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import Any

import numpy as np

from phsi_opt import __all__ as public
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.presentation.numbers import LINE_WIDTH
from phsi_opt.study_file.sections import Sections, own_effect, told
from phsi_opt.study_file.study_text import model_parts, shared_parameters
from phsi_opt.study_file.toml_text import text_template

IN_SCRIPT = "parameters"  # the variable in which the script keeps them
INDENT = "    "
SCRIPT_BEGIN = '''\
"""A study of phsi_opt, as a script."""

from pathlib import Path

import phsi_opt as ph'''


class Code(str):
    """Source that is written as it is."""


@dataclass(frozen=True)
class Source:
    """Writes values as source; ``imports`` are the lines that it needs."""

    imports: set[str] = field(default_factory=set)

    def of(self, value: Any) -> str:
        """The source of a record, text, number, list, tuple or mapping."""
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
        arguments = [self.of(value) for value in positional]
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
    model = study.base
    steps = study.steps
    parts = model_parts(model)
    if model.has_energy:
        parts["S"] = np.array(model.S).tolist()
    else:
        parts.setdefault("F", {})
    for name, value in parts.items():
        parts[name] = list(value) if isinstance(value, tuple) else value

    def named(name: str) -> str:
        """An effect: one of the user's own, or a name of the catalogue."""
        effect = own_effect(name, study.own_effects)
        return Code(f"own[{source.of(str(effect))}]") if effect else name

    effects: Any = Code("[*catalogue, *own.values()]") if study.own_effects else None
    choices = {
        "held_out": Code("held_out"),
        "effects": effects if steps.effects is None else [*map(named, steps.effects)],
        "without": list(steps.without) or None,
        "loss": study.loss if told(study.loss) else None,
        "progress": Code("print"),
    }
    shared = shared_parameters(model, study.own_effects)
    files: Any = [Code(f"FOLDER / {source.of(one)}") for one in study.data.files]
    body = text_template("study_script.py.jinja").render(
        data=study.data,
        files=files[0] if len(files) == 1 else files,
        held_out=study.held_out,
        parameters={name: _short(one) for name, one in shared.items()},
        kind=type(model).__name__,
        parts=parts,
        own={str(effect): effect for effect in study.own_effects},
        steps=steps,
        choices={name: one for name, one in choices.items() if one is not None},
        **{"call": source.call, "source": source.of, "code": Code, "named": named},
    )
    return "\n".join([SCRIPT_BEGIN, *sorted(source.imports), "", body])


def _short(parameter: Parameter) -> Any:
    """A plain number where it is known and nothing else is told."""
    return parameter.value if set(told(parameter)) == {"value", "fixed"} else parameter
