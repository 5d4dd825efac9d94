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
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import DescentRun, gradient_descent
from phsi_opt.sweeps.local_workers import one_thread
from problems.thesis.methods import SIGNIFICANCE, descent_model, descent_settings
from problems.thesis.systems import SYSTEMS
from problems.tools.command_line import flag
from problems.tools.pages import render
from problems.tools.provenance import write

NAMES = ("henon_heiles", "schrodinger", "mass_spring")
N_RUNS = 3  # of the solver; the median is told
WITHIN = {"1 %": 1e-2, "0.1 %": 1e-3, "1e-6": 1e-6}  # of the best loss
ASKED = 8  # times as fast as the schedule of gradient descent
QUICK_EPOCHS = 2
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 8


class Traced(DescentRun):
    """A descent that keeps its loss after every epoch, over processor seconds without
    those that this takes.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.trace: list[tuple[float, float]] = []
        self.began = time.process_time()
        self.spent = 0.0

    def after_epoch(self, epoch: int) -> int:
        """Keep the loss of now."""
        now = time.process_time()
        loss = float(self.loss(self.tables).detach())
        self.trace.append((now - self.began - self.spent, loss))
        self.spent += time.process_time() - now
        return super().after_epoch(epoch)


def median_seconds(run: Callable[[], Any], n: int = N_RUNS) -> float:
    """Processor seconds of a call, the median of some runs."""
    seconds = []
    for _ in range(n):
        began = time.process_time()
        run()
        seconds.append(time.process_time() - began)
    return float(np.median(seconds))


def measured(name: str, quick: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Rows of both tables for one system."""
    system = SYSTEMS[name].shortened(QUICK_EPOCHS) if quick else SYSTEMS[name]
    data = system.few("noisy", QUICK_N) if quick else system.training_data("noisy")
    settings, _ = descent_settings(system, "noisy")
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)
    lines: list[str] = []

    def whole_solver() -> ph.Fit:
        weights = dict(system.l1)
        say = lines.append
        loss = ph.PHSILoss()
        return ph.identify(system.model(), data, loss, weights, pruning, progress=say)

    def solver() -> ph.Fit:
        return ph.identify(system.model(), data, ph.PHSILoss())

    def descent() -> Any:
        return gradient_descent(descent_model(system), data, settings, 0)

    whole_solver()  # what is imported once is no work of the solver
    whole: dict[str, Any] = {
        "system": system.title,
        "samples": data.n_samples,
        "solves": len(lines),
    }
    whole["solver (s)"] = median_seconds(whole_solver)
    whole["descent (s)"] = median_seconds(descent, 1)
    whole["times as fast"] = whole["descent (s)"] / whole["solver (s)"]
    exact = solver()
    with one_thread():
        alone = replace(settings, l1={}, prune_every=None)
        run = Traced(descent_model(system), data, alone, 0)
        run.result()
    seconds, losses = np.array(run.trace).T
    best = min(exact.loss_value, losses.min())
    row: dict[str, Any] = {
        "system": system.title,
        "best loss": best,
        "solver, last": exact.loss_value / best - 1,
        "iterations": exact.outcome.iterations,
        "solver (s)": median_seconds(solver),
        "descent, last": losses.min() / best - 1,
    }
    for said, share in WITHIN.items():
        is_near = losses <= best * (1 + share)
        row[f"descent, {said} (s)"] = min(seconds[is_near], default=np.inf)
    return whole, row


def page(whole: pd.DataFrame, alone: pd.DataFrame, quick: bool) -> str:
    """The page with both tables, and what they say."""
    return render(
        "thesis/pages/solver_speed.md",
        whole=whole,
        alone=alone,
        quick=quick,
        n_asked=(whole["times as fast"] >= ASKED).sum(),
        n_first=(alone["solver (s)"] < alone["descent, 1 % (s)"]).sum(),
        n_runs=N_RUNS,
        asked=ASKED,
        epochs=QUICK_EPOCHS,
    )


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
