"""Which integrator belongs inside the PHSI loss? (thesis Section 5.1 and Appendix A)

Euler, midpoint, RK4 and SRK4 make the defect (x1 - x0)/h - Psi of the loss. Measured
here: the order of the defect of the true right-hand side, the symmetry, and what models
found with each are worth, at three noise levels and over five draws (one for the
tanks)::

    system       | trajectories x steps | step | noise            | free runs
    henon_heiles | 200 x 10             | 0.1  | 1e-5, 1e-3, 0.01 | 20, t = 0 to 1
    tanks        |  60 x 50             | 0.01 | 0, 0.01, 0.05    | 10, t = 0 to 0.5

The leak of the tanks has its known form here (its size free); in the thesis it is a
neural network.

    python -m problems.thesis.integrators [--quick]
"""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis.integrator_page import Tables, figure, text
from problems.thesis.systems import (
    LEAK_SLOPE,
    SYSTEMS,
    System,
    closed_tanks,
    known_leak,
    tank_model,
)
from problems.tools import markdown
from problems.tools.command_line import flag
from problems.tools.provenance import write

SEEDS = range(5)
TANK_SEEDS = range(1)  # minutes per fit
# The sum of the levels is a Casimir: c (mu1 + .. + mu4)^2 in H moves nothing, so
# without any L1 the data leave c open.
LEAST = {"H": 1e-3}
PRUNING = ph.Pruning(0.05, significance=0.01)
TANK_SETTINGS = ph.SolverSettings(max_iterations=100)
HALVINGS = (1, 2, 4, 8)
LENGTHS = {"henon_heiles": 1.0, "tanks": 0.5}  # of the exact records
LIMITS = markdown.paragraph(f"""
    Limits. The tanks have fewer draws; their leak has its known form, where the thesis
    trains a network; and they have an L1 weight of {LEAST["H"]:g} on H, which
    Henon-Heiles has not, because the square of the sum of the levels moves nothing.
    """)


@dataclass(frozen=True)
class Case:
    """A system as Appendix A uses it."""

    system: System
    model: ph.PseudoHamiltonian
    truth: dict[str, float]
    noise: tuple[float, ...]
    n_tests: int
    l1: dict[str, float] = field(default_factory=dict)
    settings: ph.SolverSettings = field(default_factory=ph.SolverSettings)
    seeds: range = SEEDS


@dataclass(frozen=True)
class Worth:
    """What a model is worth: l2 of free runs, largest relative coefficient error, terms
    too many and too few, whether the program was solved, seconds.
    """

    l2: float
    coefficient: float
    spurious: int
    missed: int
    solved: bool
    seconds: float


def cases(quick: bool = False) -> tuple[Case, ...]:
    """Henon-Heiles and the tanks; ``quick``: few trajectories of the first."""
    if quick:
        return (_oscillator(n_trajectories=15, noise=(1e-5, 0.01), n_tests=3),)
    oscillator = _oscillator(200, (1e-5, 1e-3, 0.01), n_tests=20)
    tanks = Case(
        replace(SYSTEMS["tanks"], n_steps=50, test_time=0.5),
        tank_model(known_leak()),
        {**SYSTEMS["tanks"].truth, "slope": LEAK_SLOPE},
        noise=(0.0, 0.01, 0.05),
        n_tests=10,
        l1=LEAST,
        settings=TANK_SETTINGS,
        seeds=TANK_SEEDS,
    )
    return oscillator, tanks


def _oscillator(n_trajectories: int, noise: tuple[float, ...], n_tests: int) -> Case:
    system = replace(
        SYSTEMS["henon_heiles"],
        n_steps=10,
        n_trajectories=n_trajectories,
        test_time=1.0,
    )
    return Case(system, system.model(), dict(system.truth), noise, n_tests)


# --- order and symmetry


def orders(n: int = 10) -> pd.DataFrame:
    """Rms defect of the true right-hand side on exact data at h, h/2, h/4 and h/8.

    The order is the slope over the last halving.
    """
    closed = replace(SYSTEMS["tanks"], title="Tanks, leak shut", rhs=closed_tanks)
    rows = []
    for system in (SYSTEMS["henon_heiles"], SYSTEMS["tanks"], closed):
        n_steps = round(LENGTHS[system.name] / system.step)
        shortened = replace(system, n_steps=n_steps)
        exact = shortened.data(0, noise=0.0, n=n, refine=HALVINGS[-1])
        rows += [_order_row(system, name, exact) for name in INTEGRATORS]
    return pd.DataFrame(rows)


def _order_row(
    system: System, integrator: str, exact: ph.Measurements
) -> dict[str, object]:
    defects = {
        k: _rms_defect(system, integrator, exact, every=HALVINGS[-1] // k)
        for k in HALVINGS
    }
    row = {"system": system.title, "integrator": integrator, "h": system.step}
    row |= {f"h/{k}": size for k, size in defects.items()}
    order = np.log2(defects[HALVINGS[-2]] / defects[HALVINGS[-1]])
    return row | {"order": order}


def _rms_defect(
    system: System, integrator: str, data: ph.Measurements, every: int
) -> float:
    psi = INTEGRATORS[integrator].psi
    total = 0.0
    count = 0
    for run in data.trajectories:
        t = run.t[::every]
        x = run.x[::every]
        for i in range(len(t) - 1):
            h = t[i + 1] - t[i]
            increment = psi(partial(_at, system, t[i], h), x[i], x[i + 1], h)
            defect = (x[i + 1] - x[i]) / h - increment
            total += float(defect @ defect)
            count += 1
    return float(np.sqrt(total / count))


def _at(system: System, t: float, h: float, x: np.ndarray, c: float) -> np.ndarray:
    return system.rhs(t + c * h, x)


def symmetry(n: int = 20) -> pd.DataFrame:
    """Largest relative change of Psi when the ends are swapped and h -> -h.

    Over the first steps of ``n`` noisy trajectories of all four systems.
    """
    rows = []
    for name, scheme in INTEGRATORS.items():
        changes = [
            _change_when_swapped(system, name, run)
            for system in SYSTEMS.values()
            for run in system.data(0, n=n).trajectories
        ]
        row = {"integrator": name, "symmetric": scheme.symmetric}
        rows.append(row | {"largest change": max(0.0, *changes)})
    return pd.DataFrame(rows)


def _change_when_swapped(system: System, integrator: str, run: ph.Trajectory) -> float:
    psi = INTEGRATORS[integrator].psi
    x0, x1 = run.x[:2]
    t0, t1 = run.t[:2]
    there = psi(partial(_at, system, t0, t1 - t0), x0, x1, t1 - t0)
    back = psi(partial(_at, system, t1, t0 - t1), x1, x0, t0 - t1)
    return float(np.linalg.norm(there - back) / np.linalg.norm(there))


# --- models found with each integrator


def fits(case: Case, seeds: range) -> pd.DataFrame:
    """A row per noise, seed and integrator with what the model is worth."""
    t, truth = case.system.tests(case.n_tests)
    rows = []
    for noise in case.noise:
        for seed in seeds:
            data = case.system.data(seed, noise)
            for name in INTEGRATORS:
                worth = _worth(case, _fitted(case, data, name), t, truth)
                key = {"system": case.system.title, "noise": noise, "seed": seed}
                rows.append({**key, "integrator": name, **vars(worth)})
                print(
                    f"... {case.system.title} noise {noise:g} seed {seed} {name}: "
                    f"l2 {worth.l2:.3g}, coefficient {worth.coefficient:.3g}",
                    flush=True,
                )
    return pd.DataFrame(rows)


def _fitted(case: Case, data: ph.Measurements, integrator: str) -> ph.Fit:
    return ph.identify(
        case.model,
        data,
        ph.PHSILoss(integrator=integrator),
        case.l1,
        PRUNING,
        settings=case.settings,
        raise_on_failure=False,
    )


def _worth(case: Case, fit: ph.Fit, t: np.ndarray, truth: np.ndarray) -> Worth:
    """``truth``: (n_tests, n_samples, n_states) at the times ``t``."""
    found = set(fit.values) - {"limit"}  # of the leak, which is known
    errors = [
        abs(fit.values.get(name, 0.0) - true) / abs(true)
        for name, true in case.truth.items()
    ]
    distances = []
    for x in truth:
        distance = np.linalg.norm(_free_run(fit, t, x[0]) - x, axis=1)
        distances.append(float(np.mean(distance)))
    return Worth(
        l2=float(np.mean(distances)),
        coefficient=max(errors),
        spurious=len(found - set(case.truth)),
        missed=len(set(case.truth) - found),
        solved=fit.outcome.success,
        seconds=fit.seconds,
    )


def _free_run(fit: ph.Fit, t: np.ndarray, x0: np.ndarray) -> np.ndarray:
    try:
        return fit.simulate(t, x0)
    except ph.SolveError:
        return np.full((len(t), len(x0)), np.inf)


def medians(found: pd.DataFrame) -> pd.DataFrame:
    """Median over the seeds, and the range of the l2 error."""
    groups = found.groupby(["system", "noise", "integrator"], sort=False)
    table = groups[["l2", "coefficient", "spurious", "missed", "seconds"]].median()
    table.insert(1, "l2 from", groups["l2"].min())
    table.insert(2, "l2 to", groups["l2"].max())
    table["not solved"] = groups["solved"].agg(lambda flags: int((~flags).sum()))
    return table.reset_index()


def main(quick: bool = False) -> Tables:
    """Tables orders, symmetry, fits, medians; written under results/thesis unless
    ``quick``.
    """
    order_table = orders(1 if quick else 10)
    symmetry_table = symmetry(3 if quick else 20)
    parts = [fits(case, range(1) if quick else case.seeds) for case in cases(quick)]
    fit_table = pd.concat(parts, ignore_index=True)
    found = {
        "orders": order_table,
        "symmetry": symmetry_table,
        "fits": fit_table,
        "medians": medians(fit_table),
    }
    page = text(found, LIMITS)
    print(page)
    if not quick:
        figure(fit_table)
        write("thesis/integrators.md", page)
    return found


if __name__ == "__main__":
    main(quick=flag("quick"))
