"""The four experiments of thesis Chapter 6 with every method beside the solver: Tables
6.1-6.4 and Figures 6.1-6.8.

Every method gets the same data: those of the thesis where they are present, else newly
drawn ones. A page per system, results/thesis/<system>.md, and its figures beside it.

    python -m problems.thesis.experiments [--quick] [system ...]
"""

import os

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # before NumPy is loaded: equal terms for all
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import figures, methods
from problems.thesis.scores import common_name, free_run, leak_of, score, without_leak
from problems.thesis.systems import (
    FLOWS,
    LEVELS,
    SYSTEMS,
    System,
    closed_tanks,
    leak,
    thesis_data_present,
)
from problems.tools.command_line import chosen, flag
from problems.tools.provenance import write

Results = dict[str, Any]  # by method
SOLVER, LIKELIHOOD, THRESHOLD, DESCENT = (
    "PHSI, solver",
    "PHSI, likelihood",
    "PHSI, threshold alone",
    "PHSI, descent",
)
PUBLISHED = {  # by the thesis: Tables 6.1 (noisy), 6.2 (clean), 6.3 (noisy)
    "henon_heiles": {
        "PHSI": {
            "H[q1**2]": 0.509,
            "H[q2**2]": 0.495,
            "H[q1**2*q2]": 1.009,
            "H[q2**3]": -0.338,
            "H[p1**2]": 0.501,
            "H[p2**2]": 0.477,
            "H[q2*p1**2]": 0.124,
        },
        "SSINN": {
            "H[q1**2]": 0.421,
            "H[q2**2]": 0.378,
            "H[q1**2*q2]": 0.569,
            "H[q2**3]": -0.195,
            "H[p1**2]": 0.484,
            "H[p2**2]": 0.443,
            "H[q2]": 0.004,
            "H[q1*q2]": 0.002,
            "H[p2]": -0.006,
            "H[p1*p2]": -0.006,
        },
    },
    "mass_spring": {
        "PHSI": {
            "H[q**2]": 0.473,
            "H[p**2]": 0.484,
            "R_p": 0.3,
            "F_p[sin(omega_t*t)]": 1.984,
            "F_p.omega_t": 0.505,
        }
    },
    "tanks": {
        "PHSI": dict(
            zip(
                [f"H[{s}**2]" for s in (*FLOWS, *LEVELS)] + [f"R_{s}" for s in FLOWS],
                (
                    24.94,
                    24.98,
                    24.98,
                    24.95,
                    24.97,
                    4.93,
                    4.96,
                    4.89,
                    4.93,
                    0.031,
                    0.029,
                    0.086,
                    0.051,
                    0.041,
                ),
                strict=True,
            )
        )
    },
}
PUBLISHED_BSI = {
    "F_q[p]": 0.991,
    "F_p[q]": -0.98,
    "F_p[p]": -0.278,
    "F_p[sin(omega_t*t)]": 1.999,
    "F_p.omega_t": 0.506,
}
UNENDED = (
    "not run: on exact data the program of this size did not end within seven minutes"
)
QUICK = (
    "SINDy, STLSQ",
    "SINDy, SR3",
)  # of the larger systems; Henon-Heiles has all methods
TABLE_DATA = {
    "mass_spring": ("clean", "noisy")
}  # of the coefficient tables; the others: noisy


# --- the runs


def training_data(system: System, kind: str, quick: bool) -> ph.Measurements:
    """Data of the thesis, or newly drawn; few of them in quick mode."""
    noise = 0.0 if kind == "clean" else None
    if quick:
        return system.data(1, noise, n=150 if system.name == "henon_heiles" else 8)
    if thesis_data_present():
        return system.thesis_data(kind)
    return system.data(1 if kind == "clean" else 2, noise)


def methods_of(system: System, kind: str, quick: bool) -> dict[str, methods.Method]:
    """The methods of one system in the order of the table; the likelihood, which starts
    from the solver, is apart.
    """
    found: dict[str, methods.Method] = {SOLVER: methods.solver}
    if kind == "noisy":
        found[THRESHOLD] = methods.solver_threshold
    found |= {
        DESCENT: methods.descent,
        "BSI, solver": methods.bsi_solver,
        "BSI, descent": methods.bsi_descent,
    }
    found |= {
        "SINDy, STLSQ": methods.stlsq,
        "SINDy, SR3": methods.sr3,
        "LASSO": methods.lasso,
    }
    if system.name == "henon_heiles":
        found["SSINN"] = methods.ssinn
    found["PHNN"] = partial(methods.phnn, epochs=2) if quick else methods.phnn
    if quick and system.name != "henon_heiles":
        return {label: found[label] for label in QUICK}
    return found


def identified(
    system: System, data: ph.Measurements, kind: str, quick: bool
) -> Results:
    """Result of every method, or the error it raised."""
    if quick:
        fast = replace(system.descent, epochs=2)
        system = replace(system, descent=fast, descent_noisy=fast)
    results: Results = {}
    for label, method in methods_of(system, kind, quick).items():
        results[label] = _tried(lambda method=method: method(system, data, kind, 0))
        if label == SOLVER:
            results[LIKELIHOOD] = likelihood(system, data, kind, results[SOLVER])
        print(f"... {system.name}, {kind}, {label}", flush=True)
    return results


def likelihood(system: System, data: ph.Measurements, kind: str, start: Any) -> Any:
    """Maximum likelihood from the solver's result, or why there is none."""
    if isinstance(start, ph.PhsiOptError):
        return start
    if system.name == "tanks" and kind == "clean":
        return ph.SolveError(UNENDED)
    return _tried(lambda: methods.likelihood(system, data, start))


def _tried(run: Any) -> Any:
    try:
        return run()
    except ph.PhsiOptError as error:
        return error


# --- the tables


def errors(system: System, result: Any) -> tuple[float, float, int, int]:
    """Largest and relative error of the coefficients, number of spurious and missed
    terms; NaN for a network.

    The hinges that stand for the network in the likelihood of the tanks are no
    coefficients.
    """
    if not hasattr(result, "model"):
        return np.nan, np.nan, 0, 0
    s, largest, spurious = score(system, result), None, None
    if system.name == "tanks" and not isinstance(result.model, ph.FirstOrder):
        spurious = [n for n in s.spurious if not n.startswith("F_mu4")]
        largest = max(
            [abs(result.values.get(n, 0.0) - v) for n, v in system.truth.items()]
            + [abs(result.values[n]) for n in spurious]
        )
    found = s.spurious if spurious is None else spurious
    return (
        s.largest if largest is None else largest,
        s.relative,
        len(found),
        len(s.missed),
    )


def scores(
    system: System, kind: str, results: Results, t: np.ndarray, truth: np.ndarray
) -> tuple[pd.DataFrame, Any]:
    """A row per method, and the l2 error over time of every method, mean over the
    starts that do not diverge.
    """
    rows, curves = [], {}
    trained = t <= system.n_steps * system.step + 1e-9
    for label, result in results.items():
        row = {"system": system.title, "data": kind, "method": label}
        if isinstance(result, ph.PhsiOptError):
            rows.append(row | {"reason": str(result)})
            continue
        largest, relative, spurious, missed = errors(system, result)
        runs = np.array([free_run(result, t, x[None]) for x in truth])
        lost = ~np.isfinite(runs).all(axis=1)
        curves[label] = (
            runs[~lost].mean(axis=0) if not lost.all() else np.full(len(t), np.nan)
        )
        inside = [
            free_run(result, t[trained], x[trained][None]) if gone else run[trained]
            for gone, run, x in zip(lost, runs, truth, strict=True)
        ]
        rows.append(
            row
            | {
                "largest error": largest,
                "relative error": relative,
                "spurious": spurious,
                "missed": missed,
                "l2 inside": np.mean(inside),
                "l2 whole": runs.mean(),
                "diverged": int(lost.sum()),
                "l2 example": example_error(system, result),
                "seconds": result.seconds,
                "reason": "",
            }
        )
    return pd.DataFrame(rows), curves


def example_error(system: System, result: Any) -> float:
    """Mean l2 error along the trajectory of Figure 6.1, 6.3 or 6.5 (tanks: 6.7, outside
    the training range).
    """
    x0, end, _ = figures.EXAMPLES.get(system.name, (figures.OUTSIDE, 1.0, (0, 1)))
    t = np.linspace(0.0, end, 501)
    return float(free_run(result, t, system.solve(np.array(x0), t)[None]).mean())


def coefficients(
    system: System, results: Results, first_order: bool = False
) -> pd.DataFrame:
    """True value beside the value of every method, all true terms and all that a method
    has too many.
    """
    truth = dict(system.truth_first_order if first_order else system.truth)
    columns: dict[str, dict[str, str]] = {}
    names = list(truth)
    for label, result in results.items():
        if (
            not hasattr(result, "model")
            or isinstance(result.model, ph.FirstOrder) != first_order
        ):
            continue
        se = result.std_errors
        values = {
            n: v
            for n, v in result.values.items()
            if v != 0 and not (system.name == "tanks" and n[:5] == "F_mu4")
        }
        columns[label] = {
            common_name(n): _value(v, se.get(n, np.nan)) for n, v in values.items()
        }
        extra = [
            n
            for n in columns[label]
            if n not in names and "omega" not in n.split("[")[0]
        ]
        names += extra if len(extra) <= 12 else []
    if first_order and system.name == "mass_spring":
        columns["thesis, BSI"] = {n: f"{v:g}" for n, v in PUBLISHED_BSI.items()}
    for label, published in (
        {} if first_order else PUBLISHED.get(system.name, {}).items()
    ):
        columns[f"thesis, {label}"] = {n: f"{v:g}" for n, v in published.items()}
        names += [n for n in published if n not in names]
    table = pd.DataFrame(
        {"coefficient": names, "true": [f"{truth.get(n, 0.0):.4g}" for n in names]}
    )
    for label, column in columns.items():
        table[label] = [column.get(n, "0") for n in names]
    return table


def _value(value: float, error: float) -> str:
    return f"{value:.4f} +- {error:.1g}" if np.isfinite(error) else f"{value:.4f}"


def steps(system: System) -> pd.DataFrame:
    """Relative error of the true coefficients on exact data at the step and at half of
    it: the integrator's own.
    """
    rows = []
    for refine in (1, 2):
        fit = methods.solver(system, system.data(0, 0.0, refine=refine))
        _, relative, spurious, missed = errors(system, fit)
        rows.append(
            {
                "system": system.title,
                "step": system.step / refine,
                "relative error": relative,
                "spurious": spurious,
                "missed": missed,
                "seconds": fit.seconds,
            }
        )
    return pd.DataFrame(rows)


# --- the tanks: the leak, and the system without it


def tank_checks(
    system: System, label: str, noise: str, data: ph.Measurements, result: Any
) -> dict[str, Any]:
    """What the thesis' claims about the tanks come down to, in numbers; the leak in
    shares of its range, 6.
    """
    levels = np.sort(np.concatenate([run.x[:, 8] for run in data.trajectories]))
    d = np.abs(leak_of(result, levels) - leak(levels)) / 6
    n = len(levels)
    central = d[int(0.025 * n) : int(0.975 * n)]
    relative = {
        k: abs(result.values.get(k, 0.0) / v - 1) for k, v in system.truth.items()
    }
    shut = replace(system, rhs=closed_tanks)
    t, truth = shut.tests(30)
    return {
        "noise": noise,
        "method": label,
        "worst H": max(v for k, v in relative.items() if k[0] == "H"),
        "worst r": max(v for k, v in relative.items() if k[0] == "R"),
        "leak rms": float(np.sqrt(np.mean(d**2))),
        "leak largest": float(d.max()),
        "leak central rms": float(np.sqrt(np.mean(central**2))),
        "leak central largest": float(central.max()),
        "l2 closed": float(free_run(without_leak(result), t, truth).mean()),
    }


def tank_table(system: System, data: ph.Measurements, results: Results) -> pd.DataFrame:
    """`tank_checks` at the noise of the thesis' data and at 0.03, which its text names."""
    rows = [
        tank_checks(system, k, f"{system.noise:g}", data, results[k])
        for k in (SOLVER, LIKELIHOOD, DESCENT)
        if k in results and not isinstance(results[k], ph.PhsiOptError)
    ]
    more = system.data(0, 0.03)
    found = methods.solver(system, more)
    for label, result in (
        (SOLVER, found),
        (LIKELIHOOD, _tried(lambda: methods.likelihood(system, more, found))),
    ):
        if not isinstance(result, ph.PhsiOptError):
            rows.append(tank_checks(system, label, "0.03", more, result))
    return pd.DataFrame(rows)


# --- everything of one system


def study(
    system: System, quick: bool
) -> tuple[dict[str, pd.DataFrame], dict[str, Any]]:
    """The tables of one system, and what its figures show: results, curves, data by
    kind, times of the tests.
    """
    t, truth = system.tests(2 if quick else 30)
    tables: dict[str, pd.DataFrame] = {}
    shown: dict[str, Any] = {
        "t": t,
        "results": {},
        "curves": {},
        "data": {},
        "diverged": {},
    }
    parts = []
    for kind in ("clean", "noisy"):
        data = shown["data"][kind] = training_data(system, kind, quick)
        results = shown["results"][kind] = identified(system, data, kind, quick)
        part, shown["curves"][kind] = scores(system, kind, results, t, truth)
        shown["diverged"][kind] = part.set_index("method")["diverged"].to_dict()
        parts.append(part)
        if kind in TABLE_DATA.get(system.name, ("noisy",)):
            tables[f"{system.name}, coefficients, {kind}"] = coefficients(
                system, results
            )
            if system.name == "mass_spring":
                tables[f"{system.name}, first order, {kind}"] = coefficients(
                    system, results, first_order=True
                )
    tables[f"{system.name}, scores"] = pd.concat(parts, ignore_index=True)
    if not quick:
        tables[f"{system.name}, steps"] = steps(system)
        if system.name == "tanks":
            tables["tanks, checks"] = tank_table(
                system, shown["data"]["noisy"], shown["results"]["noisy"]
            )
    return tables, shown


def main(
    quick: bool = False, names: list[str] | None = None
) -> dict[str, pd.DataFrame]:
    """The tables of all systems by name; pages and figures are written under
    results/thesis unless ``quick``.
    """
    from problems.thesis.experiment_pages import page

    found: dict[str, pd.DataFrame] = {}
    for system in (SYSTEMS[name] for name in names or SYSTEMS):
        tables, shown = study(system, quick)
        found |= tables
        if quick:
            print(
                tables[f"{system.name}, scores"]
                .drop(columns="reason")
                .to_string(index=False)
            )
        else:
            write(
                f"thesis/{system.name}.md",
                page(system, tables, figures.draw(system, shown)),
            )
    return found


if __name__ == "__main__":
    main(flag("quick"), chosen() or None)
