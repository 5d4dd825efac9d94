"""The tables of the four experiments: errors, free runs, coefficients, steps, and the
claims about the tanks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import figures, methods, published
from problems.thesis.scores import (
    common_name,
    distilled,
    free_run,
    is_frequency,
    leak_of,
    score,
    trained,
    without_leak,
)
from problems.thesis.systems import (
    LEAK_LIMIT,
    LEAK_SLOPE,
    System,
    closed_tanks,
    leak,
)

Results = Mapping[str, Any]  # by method: a result, or the error it raised
SOLVER = "PHSI, solver"
LIKELIHOOD = "PHSI, likelihood"
DESCENT = "PHSI, descent"
N_TESTS = 30  # unseen starts of free runs (thesis Chapter 6)
LEAK_RANGE = 2 * LEAK_SLOPE * LEAK_LIMIT
MOST_EXTRA = 12  # coefficients too many that a method adds to the table


@dataclass(frozen=True)
class Errors:
    """Errors of the coefficients: the largest, the largest relative one of a true term,
    terms too many and too few. NaN for a network.
    """

    largest: float = np.nan
    relative: float = np.nan
    spurious: int = 0
    missed: int = 0


@dataclass(frozen=True, eq=False)
class Scores:
    """A row per method, and the error over time of every method."""

    table: pd.DataFrame
    curves: figures.Curves


def tried(run: Callable[[], Any]) -> Any:
    """A result, or the error that was raised."""
    try:
        return run()
    except ph.PhsiOptError as error:
        return error


def errors(system: System, result: Any) -> Errors:
    """Errors of the coefficients of a result.

    The hinges that stand for the network in the likelihood of the tanks are no
    coefficients.
    """
    if not hasattr(result, "model"):
        return Errors()
    s = score(system, result)
    if system.name != "tanks" or isinstance(result.model, ph.FirstOrder):
        return Errors(s.largest, s.relative, len(s.spurious), len(s.missed))
    hinges = distilled(s.spurious)
    spurious = [name for name in s.spurious if name not in hinges]
    sizes = [abs(result.values[name]) for name in spurious]
    for name, true in system.truth.items():
        sizes.append(abs(result.values.get(name, 0.0) - true))
    return Errors(max(sizes), s.relative, len(spurious), len(s.missed))


def scores(
    system: System, kind: str, results: Results, t: np.ndarray, truth: np.ndarray
) -> Scores:
    """Scores of all methods on one kind of data.

    ``truth``: (n_starts, n_samples, n_states) at the times ``t``.
    """
    rows: list[dict[str, Any]] = []
    curves = {}
    for label, result in results.items():
        row = {"system": system.title, "data": kind, "method": label}
        if isinstance(result, ph.PhsiOptError):
            rows.append(row | {"reason": str(result)})
            continue
        runs = np.array([free_run(result, t, x[None]) for x in truth])
        lost = ~np.isfinite(runs).all(axis=1)
        curves[label] = np.full(len(t), np.nan)
        if not lost.all():
            curves[label] = runs[~lost].mean(axis=0)
        found = errors(system, result)
        rows.append(
            row
            | {
                "largest error": found.largest,
                "relative error": found.relative,
                "spurious": found.spurious,
                "missed": found.missed,
                "l2 inside": np.mean(_inside(system, result, runs, t, truth)),
                "l2 whole": runs.mean(),
                "diverged": int(lost.sum()),
                "l2 example": example_error(system, result),
                "seconds": result.seconds,
                "reason": "",
            }
        )
    table = pd.DataFrame(rows)
    diverged = dict(zip(table["method"], table["diverged"], strict=True))
    return Scores(table, figures.Curves(t, curves, diverged))


def _inside(
    system: System, result: Any, runs: np.ndarray, t: np.ndarray, truth: np.ndarray
) -> list[np.ndarray]:
    """Errors within the training time; a run that is lost later is run again until
    there.
    """
    until = trained(system, t)
    inside = []
    for run, x in zip(runs, truth, strict=True):
        if np.isfinite(run).all():
            inside.append(run[until])
        else:
            inside.append(free_run(result, t[until], x[until][None]))
    return inside


def example_error(system: System, result: Any) -> float:
    """Mean l2 error along the trajectory of Figure 6.1, 6.3 or 6.5 (tanks: 6.7, outside
    the training range).
    """
    example = figures.EXAMPLES.get(system.name, figures.TANK_EXAMPLE)
    t = np.linspace(0.0, example.end, 501)
    truth = system.solve(np.array(example.start), t)
    return float(free_run(result, t, truth[None]).mean())


def coefficients(
    system: System, results: Results, first_order: bool = False
) -> pd.DataFrame:
    """True value beside the value of every method, all true terms and all that a method
    has too many.
    """
    truth = system.truth_first_order if first_order else system.truth
    columns: dict[str, dict[str, str]] = {}
    names = list(truth)
    for label, result in results.items():
        if not hasattr(result, "model"):
            continue
        if isinstance(result.model, ph.FirstOrder) == first_order:
            columns[label] = _column(system, result)
            extra = [
                name
                for name in columns[label]
                if name not in names and not is_frequency(name)
            ]
            names += extra if len(extra) <= MOST_EXTRA else []
    for label, values in _published(system, first_order).items():
        columns[f"thesis, {label}"] = {n: f"{v:g}" for n, v in values.items()}
        names += [name for name in values if name not in names]
    table = pd.DataFrame({"coefficient": names})
    table["true"] = [f"{truth.get(name, 0.0):.4g}" for name in names]
    for label, column in columns.items():
        table[label] = [column.get(name, "0") for name in names]
    return table


def _column(system: System, result: Any) -> dict[str, str]:
    """Coefficients of one method that are not zero, as they are shown."""
    column = {}
    hinges = distilled(result.values) if system.name == "tanks" else []
    for name, value in result.values.items():
        if value != 0 and name not in hinges:
            error = result.std_errors.get(name, np.nan)
            column[common_name(name)] = _value(value, error)
    return column


def _published(system: System, first_order: bool) -> dict[str, dict[str, float]]:
    if not first_order:
        return published.COEFFICIENTS.get(system.name, {})
    if system.name == "mass_spring":
        return {"BSI": published.BSI_MASS_SPRING}
    return {}


def _value(value: float, error: float) -> str:
    return f"{value:.4f} +- {error:.1g}" if np.isfinite(error) else f"{value:.4f}"


def steps(system: System) -> pd.DataFrame:
    """Relative error of the true coefficients on exact data at the step and at half of
    it: the integrator's own.
    """
    rows = []
    for refine in (1, 2):
        fit = methods.solver(system, system.data(0, 0.0, refine=refine))
        found = errors(system, fit)
        rows.append(
            {
                "system": system.title,
                "step": system.step / refine,
                "relative error": found.relative,
                "spurious": found.spurious,
                "missed": found.missed,
                "seconds": fit.seconds,
            }
        )
    return pd.DataFrame(rows)


# --- the tanks: the leak, and the system without it


def tank_checks(
    system: System, label: str, noise: float, data: ph.Measurements, result: Any
) -> dict[str, Any]:
    """What the thesis' claims about the tanks come down to, in numbers; the leak in
    shares of its range.
    """
    levels = np.sort(np.concatenate([run.x[:, 8] for run in data.trajectories]))
    distance = np.abs(leak_of(result, levels) - leak(levels)) / LEAK_RANGE
    first, last = (int(share * len(levels)) for share in figures.CENTRAL)
    central = distance[first:last]
    relative = {}
    for name, true in system.truth.items():
        relative[name] = abs(result.values.get(name, 0.0) / true - 1)
    t, truth = replace(system, rhs=closed_tanks).tests(N_TESTS)
    return {
        "noise": f"{noise:g}",
        "method": label,
        "worst H": max(v for name, v in relative.items() if name.startswith("H")),
        "worst r": max(v for name, v in relative.items() if name.startswith("R")),
        "leak rms": float(np.sqrt(np.mean(distance**2))),
        "leak largest": float(distance.max()),
        "leak central rms": float(np.sqrt(np.mean(central**2))),
        "leak central largest": float(central.max()),
        "l2 closed": float(free_run(without_leak(result), t, truth).mean()),
    }


def tank_table(system: System, data: ph.Measurements, results: Results) -> pd.DataFrame:
    """`tank_checks` at the noise of the thesis' data and at that of its text."""
    rows = []
    for label in (SOLVER, LIKELIHOOD, DESCENT):
        result = results.get(label, ph.SolveError("not run"))
        if not isinstance(result, ph.PhsiOptError):
            rows.append(tank_checks(system, label, system.noise, data, result))
    noise = published.TANK_NOISE
    noisier = system.data(0, noise)
    found = methods.solver(system, noisier)
    rows.append(tank_checks(system, SOLVER, noise, noisier, found))
    refined = tried(lambda: methods.likelihood(system, noisier, found))
    if not isinstance(refined, ph.PhsiOptError):
        rows.append(tank_checks(system, LIKELIHOOD, noise, noisier, refined))
    return pd.DataFrame(rows)
