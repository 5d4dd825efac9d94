"""The grids of thesis Section 6.5: points, the descent at one of them, its error."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.thesis.methods import descent
from problems.thesis.scores import free_run, score
from problems.thesis.systems import FLOWS, System

THRESHOLDS = (0.0, 0.05, 0.2)
METHODS = ("descent", "solver")
OF_LEVELS = "error of levels"
KNOWN_FORM = ("slope", "limit")  # of the leak; no terms
SPARSITY = ("least", "middle", "most")


@dataclass(frozen=True)
class Grid:
    """What the thesis varies for one system, for how many epochs it trains, and the
    weight of L1 on the coefficients of the force.
    """

    weights: tuple[float, ...]
    intervals: tuple[int, ...]
    epochs: int
    force_weight: float = 0.0


@dataclass(frozen=True)
class Point:
    """A point of a grid: ``size`` is the pruning interval or the threshold."""

    method: str
    weight: float
    size: float

    @property
    def pruning(self) -> str:
        """The label of the column."""
        if self.method == "descent":
            return f"P = {self.size:g}"
        return f"threshold {self.size:g}"


GRIDS = {
    "henon_heiles": Grid((0.0, 0.05, 0.5), (1, 2, 4), 3),
    "schrodinger": Grid((0.0, 0.05, 0.5), (1, 5, 10), 10),
    "mass_spring": Grid((0.0, 0.1, 0.5), (20, 40, 80), 80, force_weight=0.01),
    "tanks": Grid((0.0, 0.05, 0.5), (10, 40, 80), 80),
}


def points(grid: Grid) -> Iterator[Point]:
    """All points of a grid, gradient descent first."""
    for weight in grid.weights:
        for interval in grid.intervals:
            yield Point("descent", weight, interval)
    for weight in grid.weights:
        for threshold in THRESHOLDS:
            yield Point("solver", weight, threshold)


def diagonal(grid: Grid, method: str) -> list[Point]:
    """From the least sparsity (no L1, latest pruning or none) to the most."""
    sizes = THRESHOLDS if method == "solver" else grid.intervals[::-1]
    return [Point(method, *pair) for pair in zip(grid.weights, sizes, strict=False)]


def trained(
    system: System,
    data: ph.Measurements,
    point: Point,
    grid: Grid,
    first_pruned: int = 1,
    share_of_weight: float = 1.0,
) -> Any:
    """Gradient descent at a point.

    Args:
        system: with the other settings.
        data: of the training.
        point: weight and interval.
        grid: number of epochs, weight on the force.
        first_pruned: interval at whose end pruning begins: the first (Algorithm 6).
        share_of_weight: factor of both weights, which the training multiplies by the
            number of states, because the thesis' code has the mean over the states.

    Raises:
        ModelError: every term was pruned.
    """
    interval = int(point.size)
    l1 = {**system.descent.l1, "H": point.weight * share_of_weight}
    if grid.force_weight:
        l1["F"] = grid.force_weight * share_of_weight
    settings = replace(
        system.descent,
        epochs=grid.epochs,
        prune_every=interval,
        prune_from=first_pruned * interval,
        l1=l1,
    )
    return descent(replace(system, descent=settings), data, "clean")


def error_row(
    system: System, fit: Any, t: np.ndarray, tests: np.ndarray
) -> dict[str, Any]:
    """Error of free runs (of the tanks, of their levels alone too), terms too many and
    too few, seconds; of no model where ``fit`` is an error.
    """
    row = _error_row(system, fit, t, tests)
    if system.name == "tanks":
        is_model = not isinstance(fit, ph.PhsiOptError)
        row[OF_LEVELS] = level_error(fit, t, tests) if is_model else np.inf
    return row


def _error_row(
    system: System, fit: Any, t: np.ndarray, tests: np.ndarray
) -> dict[str, Any]:
    if isinstance(fit, ph.PhsiOptError):
        return {
            "error": np.inf,
            "spurious": 0,
            "missed": len(system.truth),
            "seconds": np.nan,
        }
    found = score(system, fit)
    return {
        "error": float(free_run(fit, t, tests).mean()),
        "spurious": len(set(found.spurious) - set(KNOWN_FORM)),
        "missed": len(found.missed),
        "seconds": fit.seconds,
    }


def level_error(fit: Any, t: np.ndarray, tests: np.ndarray) -> float:
    """Mean l2 error of the tanks' levels in free runs over the times and starts."""
    errors = []
    for x in tests:
        try:
            error = fit.simulate(t, x[0]) - x
        except ph.SolveError:
            return np.inf
        errors.append(np.linalg.norm(error[:, len(FLOWS) :], axis=1))
    return float(np.mean(errors))
