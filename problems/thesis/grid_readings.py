"""Does sparsity help? Three points of each grid, as the thesis may be read.

The thesis finds that L1 and pruning help on three of four systems. Its text and its
code differ in what is summed, when pruning begins and where the data of the
Schroedinger system start, and with these in how heavy a given lambda is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.grid_points import (
    SPARSITY,
    Grid,
    Point,
    diagonal,
    error_row,
    trained,
)
from problems.thesis.systems import System

BATCH = 32  # samples in a batch of the descent
WIDE_RUNS = 30  # trajectories of the Schroedinger system in the thesis' text
WIDE_THRESHOLD = 0.05  # in its text
SEED = 1  # of data that the thesis' files do not hold
QUICK_N = 20  # trajectories of a quick run


@dataclass(frozen=True)
class Reading:
    """One way to read Section 6.5.

    Attributes:
        words: what differs.
        first_pruned: interval at whose end pruning begins.
        is_sum: whether the loss is a sum over batch and states, as Eq. 5.6 has it; the
            code has the mean over both.
        changed: the system of the text; None: that of the stored data.
    """

    words: str
    first_pruned: int = 1
    is_sum: bool = False
    changed: Callable[[System], System] | None = None

    def share_of_weight(self, system: System) -> float:
        """Factor of lambda, which the code adds to the mean over the states."""
        n_states = system.descent.n_states
        return 1 / (BATCH * n_states) if self.is_sum else 1.0


def wide(system: System) -> System:
    """The Schroedinger system as the text has it: fewer runs, starts within +-1."""
    descent = replace(system.descent, threshold=WIDE_THRESHOLD)
    return replace(
        system,
        start=lambda rng: rng.uniform(-1, 1, 4),
        n_trajectories=WIDE_RUNS,
        descent=descent,
    )


AS_HERE = "as in the grids"
SUM = "sum of squares (Eq. 5.6)"
WIDE = "starts within +-1 (text)"
WIDE_SUM = "starts within +-1, sum of squares"
READINGS = (
    Reading(AS_HERE),
    Reading("first pruned at 2P (code)", first_pruned=2),
    Reading(SUM, is_sum=True),
)
OF_THE_TEXT = (
    Reading(WIDE, changed=wide),
    Reading(WIDE_SUM, is_sum=True, changed=wide),
)


def readings_of(system: System) -> tuple[Reading, ...]:
    """The readings of one system."""
    return READINGS + OF_THE_TEXT if system.name == "schrodinger" else READINGS


def study(system: System, grid: Grid, n_tests: int, quick: bool) -> pd.DataFrame:
    """A row per reading and point of the diagonal."""
    rows = []
    for reading in readings_of(system):
        read = system if reading.changed is None else reading.changed(system)
        data = _data(read, reading, quick)
        t, tests = read.tests(n_tests)
        for sparsity, point in zip(SPARSITY, diagonal(grid, "descent"), strict=False):
            fit = _fitted(read, data, point, grid, reading)
            row = {
                "system": system.name,
                "reading": reading.words,
                "sparsity": sparsity,
                "lambda_H": point.weight,
                "pruning": point.pruning,
                "price": price(read, data, point.weight, reading),
                **error_row(read, fit, t, tests),
            }
            rows.append(row)
            print("... " + ", ".join(str(v) for v in row.values()), flush=True)
    return pd.DataFrame(rows)


def _data(system: System, reading: Reading, quick: bool) -> ph.Measurements:
    if quick:
        return system.data(SEED, 0.0, n=QUICK_N)
    if reading.changed is not None:
        return system.data(SEED, 0.0)
    return system.training_data("clean")


def _fitted(
    system: System, data: ph.Measurements, point: Point, grid: Grid, reading: Reading
) -> Any:
    share = reading.share_of_weight(system)
    try:
        return trained(system, data, point, grid, reading.first_pruned, share)
    except ph.PhsiOptError as failed:
        return failed


def price(
    system: System, data: ph.Measurements, weight: float, reading: Reading
) -> float:
    """L1 penalty of the true H, over the loss of a model without any term.

    Above 1 the penalty alone is dearer than to explain nothing.
    """
    n_states = system.descent.n_states
    coefficients = [abs(v) for name, v in system.truth.items() if name[0] == "H"]
    penalty = weight * n_states * reading.share_of_weight(system) * sum(coefficients)
    return penalty / mean_square_rate(data)


def mean_square_rate(data: ph.Measurements) -> float:
    """Mean over all steps of the squared norm of (x1 - x0)/h."""
    squares = []
    for run in data.trajectories:
        rates = np.diff(run.x, axis=0) / np.diff(run.t)[:, None]
        squares.append(np.sum(rates**2, axis=1))
    return float(np.mean(np.concatenate(squares)))
