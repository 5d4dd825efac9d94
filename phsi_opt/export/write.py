"""A fitted model as a file for other programs: C, FMI, Modelica or MATLAB.

What is written follows from the formulas and numbers of the model alone, to the bit.
Texts of a user stand in comments and attributes, where they cannot become code.
"""

import io
import platform
import re
import subprocess
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.errors import DataError
from phsi_opt.export.equations import Equations, allowed_name, allowed_names, text_of
from phsi_opt.export.targets import compiler, exported_path
from phsi_opt.model.model import Model
from phsi_opt.presentation.sentences import environment
from phsi_opt.writing import write_whole

# Folder and suffix of a program in an FMU, by the system, and the words for it.
SYSTEMS = {
    "Linux": ("linux64", ".so", "-shared"),
    "Darwin": ("darwin64", ".dylib", "-dynamiclib"),
    "Windows": ("win64", ".dll", "-shared"),
}


@dataclass(frozen=True, eq=False)
class Exported:
    """A model to be exported, and what is told of it.

    Attributes:
        model: with the values of its parameters.
        start: (n_states,) states to begin with.
        units: of states, inputs and parameters, by name.
        estimates: each parameter with its error and unit as text, by name.
        header: what the file says of the model, lines of text.
    """

    model: Model
    start: np.ndarray
    units: Mapping[str, str]
    estimates: Mapping[str, str]
    header: str

    def variables(
        self, names: Mapping[str, str], values: Iterable[float | None], kind: str
    ) -> list["Variable"]:
        """Variables of one kind; ``names`` are those of the file by those of the model.

        A value None: it has none.
        """
        found = []
        for (original, name), value in zip(names.items(), values, strict=True):
            unit = str(self.units.get(original, ""))
            told = f"{original} in {unit}" if unit else original
            if original in self.estimates:
                told += f": {self.estimates[original]}"
            note = " ".join(told.split())
            text = "" if value is None else repr(float(value))
            found.append(Variable(name, original, text, note, unit, kind))
        return found


@dataclass(frozen=True)
class Variable:
    """A number of the model in the file.

    Attributes:
        name: in the file.
        original: in the model.
        value: to begin with, as text; "" where it has none.
        note: what is told of it, one line.
        unit: of its numbers, or "".
        kind: its attributes in FMI.
    """

    name: str
    original: str
    value: str
    note: str
    unit: str
    kind: str


def write_model(given: Exported, path: str | Path) -> Path:
    """Write a model in the language that the suffix of a path names; its path.

    Raises:
        DataError: as of `exported_path`, or the file cannot be written.
        ModelError: a term has no form in the language.
    """
    place = exported_path(path)
    facts = _facts(given, place.stem)
    if place.suffix == ".fmu":
        return write_whole(place, _fmu(facts))
    return write_whole(place, _told(f"model{place.suffix}", facts))


def _facts(given: Exported, stem: str) -> dict[str, Any]:
    """What the templates tell."""
    model = given.model
    equations = Equations.of(model)
    n_given = len(model.inputs)
    nothing = [0.0] * len(equations.inputs)
    taken = (*equations.parameters.values(), *equations.inputs.values())
    originals = [f"{name} shown" for name in equations.shown]
    shown_names = allowed_names(originals, (*taken, *equations.states.values()))
    parameters = given.variables(
        equations.parameters,
        model.values.values(),
        'causality="parameter" variability="tunable"',
    )
    inputs = given.variables(equations.inputs, nothing, 'causality="input"')
    states = given.variables(
        equations.states, given.start, 'causality="output" initial="exact"'
    )
    outputs = given.variables(
        shown_names,
        [None] * len(shown_names),
        'causality="output" initial="calculated"',
    )
    late = []
    for k, (name, delay) in enumerate(model.delays):
        signal = list(model.inputs).index(name)
        late.append((inputs[n_given + k], inputs[signal], equations.parameters[delay]))
    variables = [*parameters, *inputs[:n_given], *states, *outputs]
    return {
        "name": allowed_name(stem),
        "title": f"dx/dt of {', '.join(model.states)}, fitted by phsi_opt",
        "header": given.header,
        "equations": equations,
        "parameters": parameters,
        "inputs": inputs,
        "states": states,
        "outputs": outputs,
        "delays": late,
        "n_given": n_given,
        "variables": variables,
        "units": sorted({one.unit for one in variables} - {""}),
    }


# ---- texts ---------------------------------------------------------------------------


def _told(name: str, facts: Mapping[str, Any]) -> str:
    """The text of a template."""
    templates = environment(
        __package__, "templates", autoescape=name.endswith(".xml"), auto_reload=False
    )
    templates.filters |= {
        "c_comment": _c_comment,
        "indented": _indented,
        "quoted": _quoted,
        "text": text_of,
        "with_time": _with_time,
    }
    return templates.get_template(f"{name}.jinja").render(facts) + "\n"


def _c_comment(text: str) -> str:
    return f"/* {text.replace('*/', '* /')} */"


def _indented(text: str, begin: str) -> str:
    return "\n".join(f"{begin}{line}".rstrip() for line in text.splitlines())


def _quoted(text: str) -> str:
    """Inside the quotes of Modelica."""
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _with_time(text: str) -> str:
    return re.sub(r"\bt\b", "time", text)  # no other name is t


# ---- functional mock-up unit ---------------------------------------------------------


def _fmu(facts: Mapping[str, Any]) -> bytes:
    """An FMU for co-simulation, FMI 2.0, with its sources and a program of them.

    Raises:
        DataError: there is no C compiler, or it failed.
    """
    name = facts["name"]
    # Of a step of the integration, in sizes of the states; far below 1e-6 over a
    # record, and above the rounding.
    further = {"tolerance": 1e-9, "most_steps": 1_000_000}
    model = _told("model.c", facts)
    guid = sha256(model.encode()).hexdigest()[:32]
    all_facts = {**facts, **further, "guid": guid}
    sources = {f"{name}.c": model, "fmi2.c": _told("fmi2.c", all_facts)}
    files: dict[str, str | bytes] = {
        "modelDescription.xml": _told("modelDescription.xml", all_facts)
    }
    files |= {f"sources/{file}": text for file, text in sources.items()}
    folder, suffix, _ = SYSTEMS[platform.system()]
    files[f"binaries/{folder}/{name}{suffix}"] = _compiled(name, sources)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for file, content in files.items():
            # Without the time of day, so that equal models are equal files.
            one = zipfile.ZipInfo(file)
            archive.writestr(one, content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def _compiled(name: str, sources: Mapping[str, str]) -> bytes:
    """A shared library of the sources, for this machine."""
    _, suffix, kind = SYSTEMS[platform.system()]
    words = [compiler(), kind, "-fPIC", "-O2", "-std=c99", "-o", f"{name}{suffix}"]
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            Path(folder, file).write_text(text, encoding="utf-8")
        done = subprocess.run(
            [*words, "fmi2.c", "-lm"], cwd=folder, capture_output=True, text=True
        )
        if done.returncode:
            raise DataError(f"the C compiler failed: {done.stderr.strip()[:400]}")
        return Path(folder, f"{name}{suffix}").read_bytes()
