"""What a fit costs beside what users would write themselves, and beside its own floor.

    python -m problems.benchmarks.peers [--quick]

Seeds 0 to 999 are for development (``--quick``: one of them, nothing is written).
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.errors import SolveError
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.identify import estimate_by
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.model_error.joint_estimate import JointProblem
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import MarginalLikelihood
from phsi_opt.transcription.grid import AlignedData
from problems.benchmarks.peer_cases import PROBLEMS, Drawn, Problem, drawn
from problems.benchmarks.peer_methods import (
    DIFFERENCE,
    MOST_SHOTS,
    full_discretisation,
    single_shooting,
)
from problems.tools.command_line import flag
from problems.tools.pages import render
from problems.tools.provenance import write

FIRST_SEED = 5000
N_STARTS = 5
# Root mean square residual over the noise's standard deviation, up to which a fit has
# found the motion.
FOUND = 1.1
OURS = "identify"
CASADI = "CasADi"
SCIPY = "SciPy"
JAX = "JAX"
PEERS = (CASADI, SCIPY, JAX)
N_TIMED = 5  # evaluations of which the floor takes the median
# Added to a seed: other data for the second fit, far from the seeds of the table.
OTHER_DATA = 100_000


def row(problem: Problem, seed: int) -> dict[str, object]:
    """One problem from one start, by everything that is installed."""
    case = drawn(problem, seed)
    other = drawn(problem, seed + OTHER_DATA)
    guess = dict(zip(problem.truth, case.guess.tolist(), strict=True))
    model = problem.model().with_values(guess)
    found: dict[str, object] = {"problem": problem.name, "seed": seed}
    found |= _timed(OURS, case, lambda: _identified(problem, model, case))
    began = time.process_time()
    _identified(problem, model, other)
    found["second fit s"] = time.process_time() - began
    began = time.process_time()
    _identified(problem, model, case, with_errors=True)
    found["with errors s"] = time.process_time() - began
    found |= _timed(CASADI, case, lambda: full_discretisation(problem, case))
    if problem.has_shooting:
        found |= _timed(SCIPY, case, lambda: single_shooting(problem, case))
    if find_spec("jax") is not None:
        from problems.benchmarks.peer_jax import shooting_with_jax

        shooting_with_jax(problem, other)  # compiles
        found |= _timed(JAX, case, lambda: shooting_with_jax(problem, case))
    return found | {"floor s": floor(problem, model, case)}


def _timed(
    name: str, case: Drawn, solve: Callable[[], np.ndarray]
) -> dict[str, object]:
    """Processor seconds, and whether the motion was found."""
    began = time.process_time()
    x = solve()
    seconds = time.process_time() - began
    residual = (x - case.y) / case.sigma
    ratio = float(np.sqrt(np.nanmean(residual**2))) if np.isfinite(x).all() else np.inf
    return {f"{name} s": seconds, f"{name} found": ratio < FOUND}


def _data(problem: Problem, case: Drawn) -> ph.Measurements:
    times = [problem.t] * problem.n_runs
    return ph.Measurements.from_arrays(
        times, list(case.y), states=problem.model().states
    )


def _identified(
    problem: Problem, model: ph.Model, case: Drawn, with_errors: bool = False
) -> np.ndarray:
    """As users call it; NaN where it fails."""
    try:
        fit = ph.identify(model, _data(problem, case))
        if with_errors and not fit.std_errors:
            raise TypeError("a fit without parameters has no standard errors")
    except SolveError:
        return np.full_like(case.y, np.nan)
    return np.array(fit.states)


def floor(problem: Problem, model: ph.Model, case: Drawn) -> float:
    """Seconds that the final solve needs at least.

    For each of its iterations the defects and their slopes, and a banded factorisation
    with a solve per parameter; the median of a few at the optimum.
    """
    aligned = AlignedData.of(model, _data(problem, case))
    task = Task(model, aligned, l1={}, pruning=None, settings=ph.SolverSettings())
    estimate = estimate_by(ph.MaximumLikelihood(), task, None)
    if not isinstance(estimate, LikelihoodEstimate):
        raise TypeError(f"{type(estimate).__name__} is no likelihood's estimate")
    return estimate.solution.outcome.iterations * _iteration(estimate)


def _iteration(estimate: LikelihoodEstimate) -> float:
    """Processor seconds of one iteration, at least."""
    values = estimate.likelihood
    linearizer = Linearizer(values)
    problem = JointProblem.white(linearizer, estimate.sigma)
    z = estimate.solution.z
    linear = linearizer.at(z, values.at(z))
    noise = problem.disturbances
    kernel = MarginalLikelihood(linear, noise, problem.moving)

    def work() -> None:
        there = linearizer.at(z, values.at(z))
        moved = kernel.relinearized(there)
        moved.at(noise).smoothed(room=problem.room(z))

    seconds = []
    for _ in range(N_TIMED):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return float(np.median(seconds))


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A line per problem: medians, ratios and successes."""
    lines = []
    for name, group in rows.groupby("problem", sort=False):
        ours = group[f"{OURS} s"]
        line: dict[str, object] = {
            "problem": name,
            "identify, CPU s": f"{ours.median():.3f}",
            "found": f"{int(group[f'{OURS} found'].sum())} of {len(group)}",
            "over floor": f"{(ours / group['floor s']).median():.1f}",
            "second fit, CPU s": f"{group['second fit s'].median():.3f}",
            "with standard errors, CPU s": f"{group['with errors s'].median():.3f}",
        }
        for peer in PEERS:
            ratio = found = "not run"
            if f"{peer} s" in group and group[f"{peer} s"].notna().any():
                ratio = f"{(group[f'{peer} s'] / ours).median():.2f}"
                found = f"{int(group[f'{peer} found'].sum())} of {len(group)}"
            line |= {f"{peer} / identify": ratio, f"{peer} found": found}
        lines.append(line)
    return pd.DataFrame(lines)


def page(rows: pd.DataFrame) -> str:
    """The result as Markdown."""
    return render(
        "benchmarks/pages/peers.md",
        seeds=(rows["seed"].min(), rows["seed"].max()),
        found=FOUND,
        has_jax=find_spec("jax") is not None,
        most_shots=MOST_SHOTS,
        difference=DIFFERENCE,
        summary=summary(rows),
    )


def main(first: int, n_starts: int) -> pd.DataFrame:
    """All problems from all starts."""
    rows = []
    for problem in PROBLEMS:
        for seed in range(first, first + n_starts):
            rows.append(row(problem, seed))
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


if __name__ == "__main__":
    if flag("quick"):
        print(page(main(0, 1)))
    else:
        text = page(main(FIRST_SEED, N_STARTS))
        print(text)
        write("peers.md", text)
