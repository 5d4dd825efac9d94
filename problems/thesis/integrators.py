"""Which integrator belongs inside the PHSI loss? (thesis Section 5.1 and Appendix A)

Euler, midpoint, RK4 and SRK4 make the defect (x1 - x0)/h - Psi of the loss. Measured
here: the order of the defect of the true right-hand side, the symmetry, and what models
found with each are worth, at three noise levels and over five draws (one for the
tanks)::

    system       | trajectories x steps | step | noise            | free runs
    henon_heiles | 200 x 10             | 0.1  | 1e-5, 1e-3, 0.01 | 20, t = 0 to 1
    tanks        |  60 x 50             | 0.01 | 0, 0.01, 0.05    | 10, t = 0 to 0.5

The leak of the tanks is a neural network, as in the thesis, trained by the hybrid with
the same integrator as the dictionary; beside it, with its known form (its size free).

    python -m problems.thesis.integrators [--quick]
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.learning.hybrid import Hybrid, hybrid
from phsi_opt.learning.hybrid_network import NeuralForce
from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis.figures import EXAMPLES, INSIDE, Example, simulated
from problems.thesis.integrator_orders import orders, symmetry
from problems.thesis.integrator_page import Tables, figure, text
from problems.thesis.integrator_paths import Paths, Truth, draw
from problems.thesis.systems import (
    LEAK_SLOPE,
    SYSTEMS,
    System,
    known_leak,
    tank_model,
)
from problems.tools import markdown
from problems.tools.command_line import flag
from problems.tools.kept_tables import rewrite
from problems.tools.provenance import RESULTS, write

SEEDS = range(5)
TANK_SEEDS = range(1)  # minutes per fit
# The sum of the levels is a Casimir: c (mu1 + .. + mu4)^2 in H moves nothing, so
# without any L1 the data leave c open.
LEAST = {"H": 1e-3}
PRUNING = ph.Pruning(0.05, significance=0.01)
TANK_SETTINGS = ph.SolverSettings(max_iterations=100)
TANK_EXAMPLE = replace(INSIDE, end=1.0)  # twice the training time
N_SAMPLES = 501  # of a trajectory that is drawn
LIMITS = markdown.paragraph(f"""
    Limits. The tanks have fewer draws, and an L1 weight of {LEAST["H"]:g} on H, which
    Henon-Heiles has not, because the square of the sum of the levels moves nothing. A
    hybrid that still moves after its last turn counts as not solved.
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
    force: NeuralForce | None = None
    max_turns: int = 20

    @property
    def title(self) -> str:
        """Name in tables and figures."""
        if self.system.name != "tanks":
            return self.system.title
        return "Tanks, neural leak" if self.force else "Tanks, leak of known form"


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
        oscillator = _oscillator(n_trajectories=15, noise=(1e-5, 0.01), n_tests=3)
        return oscillator, _quick_tanks()
    known = _tanks()
    network = replace(
        known,
        model=tank_model(),
        truth=dict(SYSTEMS["tanks"].truth),
        force=NeuralForce(("mu4",), ("mu4",)),
    )
    return _oscillator(200, (1e-5, 1e-3, 0.01), n_tests=20), network, known


def _tanks() -> Case:
    """The leak with its known form."""
    return Case(
        replace(SYSTEMS["tanks"], n_steps=50, test_time=0.5),
        tank_model(known_leak()),
        {**SYSTEMS["tanks"].truth, "slope": LEAK_SLOPE},
        noise=(0.0, 0.01, 0.05),
        n_tests=10,
        l1=LEAST,
        settings=TANK_SETTINGS,
        seeds=TANK_SEEDS,
    )


def _quick_tanks() -> Case:
    """Few trajectories with a small network, and too few turns to settle."""
    tanks = _tanks()
    return replace(
        tanks,
        system=replace(tanks.system, n_trajectories=4),
        model=tank_model(),
        truth=dict(SYSTEMS["tanks"].truth),
        noise=(0.0,),
        n_tests=1,
        force=NeuralForce(("mu4",), ("mu4",), hidden=(10,), epochs=10),
        max_turns=3,
    )


def _oscillator(n_trajectories: int, noise: tuple[float, ...], n_tests: int) -> Case:
    system = replace(
        SYSTEMS["henon_heiles"],
        n_steps=10,
        n_trajectories=n_trajectories,
        test_time=1.0,
    )
    return Case(system, system.model(), dict(system.truth), noise, n_tests)


# --- models found with each integrator


def fits(case: Case, seeds: range, paths: Paths) -> pd.DataFrame:
    """A row per noise, seed and integrator with what the model is worth; the
    trajectories of the first seed's models are added to ``paths``.
    """
    t, truth = case.system.tests(case.n_tests)
    rows = []
    for noise in case.noise:
        for seed in seeds:
            data = case.system.data(seed, noise)
            for name in INTEGRATORS:
                fit = _fitted(case, data, name)
                worth = _worth(case, fit, t, truth)
                if seed == seeds[0]:
                    paths.found[case.title, noise, name] = _path(case, fit)
                key = {"system": case.title, "noise": noise, "seed": seed}
                rows.append({**key, "integrator": name, **vars(worth)})
                print(
                    f"... {case.title} noise {noise:g} seed {seed} {name}: "
                    f"l2 {worth.l2:.3g}, coefficient {worth.coefficient:.3g}",
                    flush=True,
                )
    return pd.DataFrame(rows)


def _fitted(case: Case, data: ph.Measurements, integrator: str) -> Any:
    if case.force is not None:
        return hybrid(
            case.model,
            data,
            case.force,
            case.l1,
            PRUNING,
            integrator=integrator,
            max_turns=case.max_turns,
        )
    return ph.identify(
        case.model,
        data,
        ph.PHSILoss(integrator=integrator),
        case.l1,
        PRUNING,
        settings=case.settings,
        raise_on_failure=False,
    )


def _path(case: Case, fit: Any) -> np.ndarray | None:
    """The trajectory of the example; None where it diverges."""
    example = example_of(case.system)
    x: np.ndarray | None = simulated(fit, times_of(example), example.start)
    return x


def example_of(system: System) -> Example:
    """The start of the thesis' figures, to beyond the training time."""
    return EXAMPLES.get(system.name, TANK_EXAMPLE)


def times_of(example: Example) -> np.ndarray:
    """Times of the trajectories that are drawn, (n_samples,)."""
    return np.linspace(0.0, example.end, N_SAMPLES)


def _is_solved(fit: Any) -> bool:
    """Whether the program was solved, and in a hybrid, neither part moves any more."""
    if isinstance(fit, Hybrid):
        return fit.fit.outcome.success and fit.converged
    return bool(fit.outcome.success)


def _worth(case: Case, fit: Any, t: np.ndarray, truth: np.ndarray) -> Worth:
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
        solved=_is_solved(fit),
        seconds=fit.seconds,
    )


def _free_run(fit: Any, t: np.ndarray, x0: np.ndarray) -> np.ndarray:
    try:
        return np.asarray(fit.simulate(t, x0))
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
    paths = Paths()
    parts = []
    for case in cases(quick):
        example = example_of(case.system)
        t = times_of(example)
        truth = case.system.solve(np.array(example.start), t)
        paths.truths[case.title] = Truth(case.system, t, truth)
        parts.append(fits(case, range(1) if quick else case.seeds, paths))
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
        draw(paths)
        rewrite(RESULTS / "thesis/integrators.csv", fit_table)
        write("thesis/integrators.md", page)
    return found


if __name__ == "__main__":
    main(quick=flag("quick"))
