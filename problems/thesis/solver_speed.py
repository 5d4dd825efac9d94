"""Processor seconds of the solver and of gradient descent on the same loss.

Noisy data of the thesis, the three systems without a network. First the whole of what a
user calls: the solver with L1, pruning by size and significance, and the schedule of
gradient descent (Algorithm 6). Then the loss alone, all terms and no penalty: the
seconds that the solver takes, and those until gradient descent comes within 1 %, 0.1 %
and 1e-6 of the best loss that either finds.

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
from phsi_opt.baselines.gradient_descent import DescentRun, gradient_descent
from phsi_opt.sweeps.local_workers import one_thread
from problems.thesis.methods import SIGNIFICANCE, descent_settings
from problems.thesis.systems import SYSTEMS, System, mass_spring_descent_model
from problems.tools import markdown
from problems.tools.command_line import flag
from problems.tools.provenance import write

NAMES = ("henon_heiles", "schrodinger", "mass_spring")
N_RUNS = 3  # of the solver; the median is told
WITHIN = {"1 %": 1e-2, "0.1 %": 1e-3, "1e-6": 1e-6}  # of the best loss
ASKED = 8  # times as fast as the schedule of gradient descent
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


def solver_row(system: System, data: ph.Measurements) -> dict[str, Any]:
    """The whole of the solver."""
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)
    lines: list[str] = []

    def run() -> ph.Fit:
        return ph.identify(
            system.model(),
            data,
            ph.PHSILoss(),
            dict(system.l1),
            pruning,
            progress=lines.append,
        )

    run()  # what is imported once is no work of the solver
    solves = len(lines)
    return {"solves": solves, "solver (s)": median_seconds(run)}


def median_seconds(run: Callable[[], Any]) -> float:
    """Processor seconds of a call, the median of `N_RUNS`."""
    seconds = []
    for _ in range(N_RUNS):
        began = time.process_time()
        run()
        seconds.append(time.process_time() - began)
    return float(np.median(seconds))


def descent_model(system: System) -> Any:
    """The model that gradient descent begins with."""
    is_spring = system.name == "mass_spring"
    return mass_spring_descent_model() if is_spring else system.model()


def schedule_seconds(system: System, data: ph.Measurements) -> float:
    """Of the whole schedule of gradient descent."""
    settings, _ = descent_settings(system, "noisy")
    began = time.process_time()
    gradient_descent(descent_model(system), data, settings, 0)
    return time.process_time() - began


def descent_trace(system: System, data: ph.Measurements) -> Trace:
    """The loss of all terms by gradient descent, after each epoch."""
    settings, _ = descent_settings(system, "noisy")
    settings = replace(settings, l1={}, prune_every=None)
    trace = Trace()

    class Traced(DescentRun):
        def after_epoch(self, epoch: int) -> int:
            trace.note(lambda: float(self.loss(self.tables).detach()))
            return super().after_epoch(epoch)

    with one_thread():
        Traced(descent_model(system), data, settings, 0).result()
    return trace


def measured(name: str, quick: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Rows of both tables for one system."""
    system = SYSTEMS[name].with_epochs(QUICK_EPOCHS) if quick else SYSTEMS[name]
    data = system.training_data("noisy")
    whole: dict[str, Any] = {"system": system.title, "samples": data.n_samples}
    whole |= solver_row(system, data)
    whole["descent (s)"] = schedule_seconds(system, data)
    whole["times as fast"] = whole["descent (s)"] / whole["solver (s)"]
    by_descent = descent_trace(system, data)
    exact = ph.identify(system.model(), data, ph.PHSILoss())
    best = min(exact.loss_value, *by_descent.loss)
    alone: dict[str, Any] = {
        "system": system.title,
        "best loss": best,
        "solver, last": exact.loss_value / best - 1,
        "iterations": exact.outcome.iterations,
        "solver (s)": median_seconds(
            lambda: ph.identify(system.model(), data, ph.PHSILoss())
        ),
        "descent, last": min(by_descent.loss) / best - 1,
    }
    for said, share in WITHIN.items():
        alone[f"descent, {said} (s)"] = by_descent.reached(best * (1 + share))
    return whole, alone


def page(whole: pd.DataFrame, alone: pd.DataFrame, quick: bool) -> str:
    """The page with both tables, and what they say."""
    slowest = whole["times as fast"].min()
    n_asked = int((whole["times as fast"] >= ASKED).sum())
    first = alone["descent, 1 % (s)"].to_numpy(dtype=float)
    n_first = int((alone["solver (s)"].to_numpy(dtype=float) < first).sum())
    n = len(whole)
    lines = ["# The solver's speed on the PHSI loss", ""]
    if quick:
        lines += [f"Quick: {QUICK_EPOCHS} epochs of gradient descent, no result.", ""]
    lines += [
        markdown.paragraph(
            f"""Noisy data of the thesis, processor seconds on one thread, everything
            from the call on; of the solver the median of {N_RUNS} runs. Each program is
            symbolic and IPOPT solves it. Asked: {ASKED} times as fast as the schedule
            of gradient descent ({n_asked} of {n} systems; the least is {slowest:.1f}
            times), and the loss alone faster than its first 1 % ({n_first} of
            {n})."""
        ),
        "",
        "## The whole: L1, pruning by size and significance, all re-solves",
        "",
        *markdown.frame(whole),
        "## The loss alone: all terms, no penalty",
        "",
        *markdown.frame(alone),
        markdown.paragraph(
            """"last" is by how much a method's loss is above the best one at its end;
            seconds of gradient descent until its loss is so near to the best one; inf:
            never."""
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
