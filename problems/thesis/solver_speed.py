"""Processor seconds of the solver and of gradient descent on the same loss.

Noisy data of the thesis, the three systems without a network. First the whole of what a
user calls: the solver with L1, pruning by size and significance, and the schedule of
gradient descent (Algorithm 6). Then the loss alone, all terms and no penalty: the
seconds until each comes within 1 %, 0.1 % and 1e-6 of the best loss that either finds.
The floor is one dense least-squares solve per Gauss-Newton iteration that each support
needs.

    python -m problems.thesis.solver_speed [--quick]
"""

import os

# Before NumPy is loaded: equal terms for both.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import gradient_descent
from phsi_opt.optimization.gauss_newton import DenseLeastSquares, Slopes
from problems.thesis.methods import SIGNIFICANCE, descent_settings
from problems.thesis.systems import SYSTEMS, System, mass_spring_descent_model
from problems.tools import markdown
from problems.tools.command_line import flag
from problems.tools.provenance import write

NAMES = ("henon_heiles", "schrodinger", "mass_spring")
N_RUNS = 3  # of the solver; the median is told
WITHIN = {"1 %": 1e-2, "0.1 %": 1e-3, "1e-6": 1e-6}  # of the best loss
MOST_ITERATIONS = 50  # of Gauss and Newton, for the floor
SETTLED = 1e-8  # relative step at which they have converged
QUICK_EPOCHS = 2


@dataclass
class Trace:
    """Loss over processor seconds, without the seconds that tracing takes."""

    seconds: list[float] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    began: float = field(default_factory=time.process_time)
    spent: float = 0.0

    def note(self, evaluate: Callable[[], float]) -> None:
        """Keep the loss of now."""
        now = time.process_time()
        self.seconds.append(now - self.began - self.spent)
        self.loss.append(evaluate())
        self.spent += time.process_time() - now

    def reached(self, limit: float) -> float:
        """Seconds until the loss was first below a limit; infinite where never."""
        for seconds, loss in zip(self.seconds, self.loss, strict=True):
            if loss <= limit:
                return seconds
        return np.inf


@dataclass(eq=False)
class _Watched:
    """Evaluations of the solver's least squares: of each problem, the first point."""

    trace: Trace
    problems: list[tuple[DenseLeastSquares, np.ndarray]] = field(default_factory=list)


def watched(run: Callable[[], Any]) -> tuple[Any, _Watched]:
    """Run something, and watch the solver's evaluations."""
    found = _Watched(Trace())
    seen: set[int] = set()
    original = DenseLeastSquares.at

    def at(self: DenseLeastSquares, z: np.ndarray) -> Slopes:
        slopes = original(self, z)
        if id(self) not in seen:
            seen.add(id(self))
            found.problems.append((self, z.copy()))
        found.trace.note(lambda: float(slopes.residual @ slopes.residual))
        return slopes

    DenseLeastSquares.at = at  # type: ignore[method-assign]
    try:
        return run(), found
    finally:
        DenseLeastSquares.at = original  # type: ignore[method-assign]


def floor(problems: list[tuple[DenseLeastSquares, np.ndarray]]) -> float:
    """Seconds of the dense solves that Gauss and Newton need from the same starts."""
    seconds = 0.0
    for problem, start in problems:
        z = start.copy()
        for _ in range(MOST_ITERATIONS):
            slopes = problem.at(z)
            jacobian = slopes.columns * slopes.scale
            began = time.process_time()
            step = np.linalg.lstsq(jacobian, -slopes.residual, rcond=None)[0]
            seconds += time.process_time() - began
            z[: len(step)] += step
            if np.linalg.norm(step) < SETTLED * np.linalg.norm(z[: len(step)]):
                break
    return seconds


def solver_row(system: System, data: ph.Measurements) -> dict[str, Any]:
    """The whole of the solver, and its floor."""
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)

    def run() -> ph.Fit:
        return ph.identify(
            system.model(), data, ph.PHSILoss(), dict(system.l1), pruning
        )

    run()  # what is imported once is no work of the solver
    seconds = []
    for _ in range(N_RUNS):
        began = time.process_time()
        run()
        seconds.append(time.process_time() - began)
    _, found = watched(run)
    of_floor = floor(found.problems)
    total = float(np.median(seconds))
    return {
        "solves": len(found.problems),
        "solver (s)": total,
        "floor (s)": of_floor,
        "over the floor": total / of_floor,
    }


def descent_model(system: System) -> Any:
    """The model that gradient descent begins with."""
    is_spring = system.name == "mass_spring"
    return mass_spring_descent_model() if is_spring else system.model()


def schedule_seconds(system: System, data: ph.Measurements) -> float:
    """Of the whole schedule of gradient descent."""
    settings, force = descent_settings(system, "noisy")
    began = time.process_time()
    gradient_descent(descent_model(system), data, settings, 0, force=force)
    return time.process_time() - began


def solver_trace(system: System, data: ph.Measurements) -> Trace:
    """The loss of all terms by the solver, from the call on."""
    _, found = watched(lambda: ph.identify(system.model(), data, ph.PHSILoss()))
    return found.trace


def descent_trace(system: System, data: ph.Measurements) -> Trace:
    """The loss of all terms by gradient descent, after each epoch."""
    from phsi_opt.baselines import gradient_descent as module

    settings, force = descent_settings(system, "noisy")
    settings = replace(settings, l1={}, prune_every=None)
    trace = Trace()
    original = module._Run._prune

    def pruned(self: Any, epoch: int) -> int:
        tables = self.steps.all_tables()
        trace.note(lambda: float(self.steps.loss(self.adam.flat, tables).detach()))
        return original(self, epoch)

    module._Run._prune = pruned  # type: ignore[method-assign]
    try:
        gradient_descent(descent_model(system), data, settings, 0, force=force)
    finally:
        module._Run._prune = original  # type: ignore[method-assign]
    return trace


def measured(name: str, quick: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Rows of both tables for one system."""
    system = SYSTEMS[name].with_epochs(QUICK_EPOCHS) if quick else SYSTEMS[name]
    data = system.training_data("noisy")
    whole: dict[str, Any] = {"system": system.title, "samples": data.n_samples}
    whole |= solver_row(system, data)
    whole["descent (s)"] = schedule_seconds(system, data)
    whole["times as fast"] = whole["descent (s)"] / whole["solver (s)"]
    by_solver = solver_trace(system, data)
    by_descent = descent_trace(system, data)
    # The solver's objective is the loss over the mean square of the rates.
    least = min(by_solver.loss)
    exact = ph.identify(system.model(), data, ph.PHSILoss()).loss_value
    by_solver.loss = [exact * one / least for one in by_solver.loss]
    best = min(exact, *by_descent.loss)
    alone: dict[str, Any] = {
        "system": system.title,
        "best loss": best,
        "descent, last": min(by_descent.loss) / best - 1,
    }
    for said, share in WITHIN.items():
        limit = best * (1 + share) + 1e-12 * exact
        alone[f"solver, {said}"] = by_solver.reached(limit)
        alone[f"descent, {said}"] = by_descent.reached(limit)
    return whole, alone


def page(whole: pd.DataFrame, alone: pd.DataFrame, quick: bool) -> str:
    """The page with both tables, and what they say."""
    fastest = whole["times as fast"].min()
    n_ten = int((whole["times as fast"] >= 10).sum())
    n_floor = int((whole["over the floor"] <= 5).sum())
    first = alone["descent, 1 %"].to_numpy(dtype=float)
    n_first = int((whole["solver (s)"].to_numpy(dtype=float) < first).sum())
    n = len(whole)
    lines = ["# The solver's speed on the PHSI loss", ""]
    if quick:
        lines += [f"Quick: {QUICK_EPOCHS} epochs of gradient descent, no result.", ""]
    lines += [
        markdown.paragraph(
            f"""Noisy data of the thesis, processor seconds on one thread, everything
            from the call on; of the solver the median of {N_RUNS} runs. Asked: ten
            times faster than the schedule of gradient descent ({n_ten} of {n} systems;
            the least is {fastest:.1f} times), faster than its first 1 % ({n_first} of
            {n}), at most 5 times the floor ({n_floor} of {n}). The floor is one dense
            least-squares solve (LAPACK's gelsd) per Gauss-Newton iteration that each
            of the solves needs, without evaluating anything."""
        ),
        "",
        "## The whole: L1, pruning by size and significance, all re-solves",
        "",
        *markdown.frame(whole),
        "## The loss alone: all terms, no penalty, seconds until within",
        "",
        *markdown.frame(alone),
        markdown.paragraph(
            """"descent, last" is by how much the loss of gradient descent is above the
            best one at the end of its schedule; inf: never."""
        ),
    ]
    return "\n".join(lines)


def main(quick: bool = False) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Both tables; written to results/thesis/solver_speed.md unless quick."""
    rows = []
    for name in NAMES:
        rows.append(measured(name, quick))
        print(*rows[-1], sep="\n", flush=True)
    whole = pd.DataFrame([row[0] for row in rows])
    alone = pd.DataFrame([row[1] for row in rows])
    text = page(whole, alone, quick)
    if quick:
        print(text)
    else:
        write("thesis/solver_speed.md", text)
    return whole, alone


if __name__ == "__main__":
    main(flag("quick"))
