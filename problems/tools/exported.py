"""What exported models compute, each in its language: by gcc, FMPy, Octave, text."""

import ctypes
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave

from phsi_opt.model.expressions import NUMPY, evaluate

Array = np.ndarray
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
ASSIGNMENT = re.compile(r"(?m)^\s*(?:der\((\w+)\)|(\w+)) = ([^;\n]+);")
PARAMETER = re.compile(r"(?m)^\s*parameter Real (\w+) = (\S+) ")


def run_fmu(path: Path, t: Array, x0: Array, u: Array, is_held: Array) -> Array:
    """The states (n_samples, n_states) of an FMU, a communication step per sample.

    Inputs u (n_samples, n_inputs) are held where ``is_held`` (n_inputs,), or go in
    straight lines to the next sample.
    """
    description = fmpy.read_model_description(str(path))
    names: dict[str, list[int]] = {"input": [], "output": []}
    for one in description.modelVariables:
        if one.causality in names and one.initial != "calculated":
            names[one.causality].append(one.valueReference)
    folder = fmpy.extract(str(path))
    slave = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="one",
    )
    slave.instantiate()
    try:
        slave.setupExperiment(startTime=t[0])
        slave.enterInitializationMode()
        slave.setReal(names["output"], x0)
        slave.exitInitializationMode()
        found = [list(x0)]
        for k, h in enumerate(np.diff(t).tolist()):
            slope = np.where(is_held, 0.0, (u[k + 1] - u[k]) / h)
            slave.setReal(names["input"], u[k])
            slave.setRealInputDerivatives(names["input"], [1] * len(slope), slope)
            slave.doStep(t[k], h)
            found.append(slave.getReal(names["output"]))
    finally:
        slave.freeInstance()
        shutil.rmtree(folder)
    return np.array(found)


class Compiled:
    """A model in C, compiled with every warning as an error."""

    def __init__(self, path: Path) -> None:
        self.name = path.stem
        library = path.with_suffix(".so")
        words = ["cc", "-shared", "-fPIC", "-O2", "-std=c99", *STRICT]
        subprocess.run([*words, "-o", library, path, "-lm"], check=True)
        self._library = ctypes.CDLL(str(library))
        self._values = ctypes.byref(
            ctypes.c_double.in_dll(self._library, self._of("values"))
        )

    def _of(self, function: str) -> str:
        return f"{self.name}_{function}"

    def rates(self, t: float, x: Array, u: Array) -> Array:
        """dx/dt (n_states,)."""
        return self._called("rates", t, x, u)

    def shown(self, t: float, x: Array, u: Array) -> Array:
        """What the sensors show, at the begin of (n_states,)."""
        return self._called("sensors", t, x, u)

    def _called(self, name: str, t: float, x: Array, u: Array) -> Array:
        found = np.zeros(len(x))
        function = getattr(self._library, self._of(name))
        function(self._values, ctypes.c_double(t), *map(_place, (x, u, found)))
        return found

    def run(self, t: Array, x0: Array, u: Array, is_held: Array, parts: int) -> Array:
        """The states (n_samples, n_states), by so many steps between two samples."""
        function = getattr(self._library, self._of("step"))
        x = np.array(x0, dtype=float)
        found = [x.copy()]
        for k, h in enumerate((np.diff(t) / parts).tolist()):
            slope = np.where(is_held, 0.0, (u[k + 1] - u[k]) / (h * parts))
            for part in range(parts):
                now = u[k] + slope * part * h
                times = map(ctypes.c_double, (t[k] + part * h, h))
                function(self._values, *times, *map(_place, (x, now, slope)))
            found.append(x.copy())
        return np.array(found)


def _place(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def has_octave() -> bool:
    """Whether MATLAB's language can be run here."""
    return shutil.which("octave") is not None


def rates_of_matlab(path: Path, t: Array, x: Array, u: Array) -> Array:
    """dx/dt (n_points, n_states) of a function in MATLAB's language, by Octave."""
    calls = []
    for at, state, given in zip(t.tolist(), x.tolist(), u.tolist(), strict=True):
        arguments = f"{at!r}, {state}', {given}'"
        calls.append(f"printf('%.17g ', {path.stem}({arguments})); disp('')")
    words = ["octave", "--no-gui", "--norc", "--quiet", "--eval", "; ".join(calls)]
    done = subprocess.run(words, cwd=path.parent, capture_output=True, text=True)
    rows = done.stdout.splitlines()
    return np.array([list(map(float, row.split())) for row in rows])


def rates_of_modelica(path: Path, t: Array, x: Array, u: Array) -> Array:
    """dx/dt (n_points, n_states) of a model in Modelica, whose equations are read.

    ``u`` are all inputs, with those that are delayed behind the others.
    """
    text = path.read_text(encoding="utf-8")
    head, _, body = text.partition("\nequation\n")
    known: dict[str, Any] = {n: float(v) for n, v in PARAMETER.findall(head)}
    inputs = re.findall(r"(?m)^\s*input Real (\w+) ", head)
    late = re.findall(r"(?m)^\s*(\w+) = delay\(", body)
    known |= zip([*inputs, *late], u.T, strict=True)
    known |= zip(re.findall(r"(?m)^\s*Real (\w+)\(start", head), x.T, strict=True)
    known["time"] = t
    return np.stack(list(_rates(body, known)), axis=1)


def _rates(body: str, known: dict[str, Any]) -> Iterator[Array]:
    for state, name, written in ASSIGNMENT.findall(body):
        if written.startswith("delay("):
            continue
        value = evaluate(written.replace("^", "**"), known, NUMPY)
        known[name] = value
        if state:
            yield np.broadcast_to(value, known["time"].shape)
