"""Exported models beside `Fit.simulate`, on every kind of model of the project.

    python -m problems.benchmarks.exports [name ...]

A name is the beginning of one of the problems; then no page is written.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.data.checks import hold_of_each
from phsi_opt.simulation.simulate import SampledInputs
from problems.battery.draw import KINDS, ROWS, Row, draw
from problems.judges.fit_cases import PROBLEMS, Problem
from problems.tools.command_line import chosen
from problems.tools.exported import (
    Compiled,
    has_octave,
    rates_of_matlab,
    rates_of_modelica,
    run_fmu,
)
from problems.tools.pages import publish, render

SEED = 1  # of the machines of the battery
N_SAMPLES = 200  # of the first run
N_POINTS = 5  # at which right-hand sides are compared
N_PARTS = 100  # steps of C between two samples
AGREED = 1e-6  # of the largest value of each state
CLOSEST = "FMU beside C"
LANGUAGES = ["FMU", "C, RK4", CLOSEST, "C", "MATLAB", "Modelica"]

Result = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Motion:
    """The first samples of the first run of a fit, to be simulated."""

    fit: ph.Fit
    t: np.ndarray
    x0: np.ndarray
    u: np.ndarray

    @classmethod
    def of(cls, fit: ph.Fit, data: ph.Measurements) -> "Motion":
        """From the states of the fit, or where it has none from the samples."""
        run = next(iter(data))
        measured = [
            data.states.index(n) if n in data.states else -1 for n in fit.model.states
        ]
        first = np.append(np.nan_to_num(run.x[0]), 0.0)[measured]
        x0 = fit.states[0][0] if fit.states else first
        inputs = [data.inputs.index(name) for name in fit.model.inputs]
        return cls(fit, run.t[:N_SAMPLES], x0, run.u[:N_SAMPLES, inputs])

    @property
    def is_held(self) -> np.ndarray:
        """Whether each input is held between samples, (n_inputs,)."""
        return np.array(hold_of_each(self.fit.hold, self.fit.model.inputs)) == "zero"

    def simulated(self) -> np.ndarray:
        """The states (n_samples, n_states) of `Fit.simulate`."""
        return self.fit.simulate(self.t, self.x0, self.u)

    def with_delayed(self) -> np.ndarray:
        """All inputs of dx/dt at the samples, those that are delayed at the end."""
        hold = np.array(hold_of_each(self.fit.hold, self.fit.model.inputs))
        known = SampledInputs.of(self.fit.model, self.t, self.u, hold)
        n = self.u.shape[1] + len(self.fit.model.delays)
        return np.ascontiguousarray(known.u[known.samples][:, :n])


def compared(motion: Motion, folder: Path) -> Result:
    """Largest differences of each language: motions in the largest value of each state,
    dx/dt in its largest value.
    """
    fit, t, x0, u, held = motion.fit, motion.t, motion.x0, motion.u, motion.is_held
    paths = {s: fit.export(folder / f"model{s}") for s in (".c", ".fmu", ".m", ".mo")}
    expected = motion.simulated()
    by_fmu = run_fmu(paths[".fmu"], t, x0, u, held)
    compiled = Compiled(paths[".c"])
    found = {"FMU": _apart(by_fmu, expected), "C, RK4": np.nan, CLOSEST: np.nan}
    if not fit.model.delays:
        by_steps = compiled.run(t, x0, u, held, N_PARTS)
        found["C, RK4"] = _apart(by_steps, expected)
        found[CLOSEST] = _apart(by_fmu, by_steps)
    places = np.linspace(0, len(t) - 1, N_POINTS).astype(int)
    points = (t[places], expected[places], motion.with_delayed()[places])
    function = fit.casadi()
    rates = []
    in_c = []
    for at, x, given in zip(*points, strict=True):
        rates.append(np.array(function(x, given, at)).ravel())
        in_c.append(compiled.rates(at, x, given))
    found["C"] = _apart(np.array(in_c), np.array(rates))
    found["MATLAB"] = np.nan
    if has_octave():
        found["MATLAB"] = _apart(rates_of_matlab(paths[".m"], *points), np.array(rates))
    by_text = rates_of_modelica(paths[".mo"], *points)
    found["Modelica"] = _apart(by_text, np.array(rates))
    return found


def _apart(found: np.ndarray, expected: np.ndarray) -> float:
    size = np.max(np.abs(expected), axis=0)
    return float(np.max(np.abs(found - expected) / np.where(size > 0, size, 1.0)))


def of_battery(row: Row) -> Problem:
    """A machine with the hidden effects that the catalogue has in its model."""
    case = draw(row, SEED)
    model = case.model
    for truth in case.truths or ():
        for effect in ph.catalogue(model):
            if str(effect) in truth.places:
                model = model.add(effect)
                break
    return Problem(model, case.train)


def problems() -> dict[str, Callable[[], Problem]]:
    """Every kind of model by name."""
    found = dict(PROBLEMS)
    rows: list[Row] = [*ROWS.values(), *KINDS.values()]
    for row in rows:
        if row.kind not in ("one", "tanks") or row.name.endswith("_0.03"):
            found[f"battery, {row.name}"] = partial(of_battery, row)
    return found


def row_of(name: str, make: Callable[[], Problem]) -> Result:
    """Of a problem that is fitted."""
    problem = make()
    fit = ph.identify(
        problem.model, problem.data, raise_on_failure=False, **problem.options
    )
    model = fit.model
    with tempfile.TemporaryDirectory() as folder:
        row = compared(Motion.of(fit, problem.data), Path(folder))
    counts = {"states": model.n_states, "inputs": len(model.inputs)}
    return {"problem": name, **counts, **row}


def main(names: tuple[str, ...]) -> None:
    """All problems, or those of some names; the page is written if they are all."""
    rows: list[Result] = []
    for name, make in problems().items():
        if not names or name.startswith(names):
            rows.append(row_of(name, make))
            print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    off = table[LANGUAGES]
    text = render(
        "benchmarks/pages/exports.md",
        table=table.assign(**off.map("{:.0e}".format).replace("nan", "")),
        n=len(table),
        n_agreed=(off["FMU"] < AGREED).sum(),
        beyond=table["problem"][off["FMU"] >= AGREED].tolist(),
        apart=off[CLOSEST][off["FMU"] >= AGREED].max(),
        largest=off[["C", "MATLAB", "Modelica"]].max().max(),
        agreed=AGREED,
        n_samples=N_SAMPLES,
        n_parts=N_PARTS,
        n_points=N_POINTS,
        has_octave=has_octave(),
    )
    publish("exports.md", text, not names)


if __name__ == "__main__":
    main(tuple(chosen()))
