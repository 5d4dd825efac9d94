"""Starting values of the parameters, by convex programs and scans of frequencies.

The loss with the midpoint rule is convex in the coefficients that enter linearly while
R is fixed, so its global optimum is found: by least squares within the bounds, or by
CVXPY where there is an L1 penalty. A frequency is scanned (`frequency_scan`), with the
amplitudes solved at every step of the scan. The states must be known; what to do where
they are not is the business of `identify`.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import casadi as ca
import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.initialization.frequency_scan import (
    N_STARTS,
    RANK,
    candidate_frequencies,
    frequency_scans,
    squared_defects,
    with_entry,
)
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.bounded_step import bounded_least_squares
from phsi_opt.transcription.defects import KnownDefects
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME
from phsi_opt.transcription.losses import complete_intervals, mean_square_rate
from phsi_opt.transcription.parameter_vector import Theta


def starting_values(
    model: Model, grid: Grid, l1: Mapping[str, float]
) -> list[np.ndarray]:
    """Starting points of theta, the best first.

    Args:
        model: the model.
        grid: nodes whose states are all known (``grid.y``).
        l1: weight by slot.

    Returns:
        Up to `N_STARTS` arrays (n_free,).
    """
    grid = complete_intervals(model, grid)
    groups = _linear_groups(model)
    start = _ConvexStart(model, grid, l1, groups)
    starts = [start.improved(model.theta, rounds=1)]
    linear = list(chain.from_iterable(groups))
    for scan in frequency_scans(model):
        frequency = model.free.index(scan.name)
        scanned = []
        for theta in starts:
            for omega in candidate_frequencies(model, grid, theta, linear, scan):
                moved = with_entry(theta, frequency, omega)
                # The start carries what the polynomials explained before the wave was
                # there; begin again beside it.
                scanned.append(start.improved(moved, rounds=2))
        best_first = sorted(scanned, key=lambda s: squared_defects(model, grid, s))
        starts = best_first[:N_STARTS]
    return starts


def _linear_groups(model: Model) -> list[list[int]]:
    """Groups of parameters in which the right-hand side is linear, others fixed.

    Those of H and F, then those of R; a parameter with a value of its own keeps it.
    """
    rhs = model.rhs()
    arguments = argument_symbols(rhs)
    rates = rhs(*arguments)
    theta = arguments[-1]
    entries = [model.entries[name] for name in model.free]
    groups = []
    for slots in (("H", "F"), ("R",)):
        coefficients = []
        others = []
        for place, entry in enumerate(entries):
            if entry.slot not in slots:
                continue
            if entry.prunable:
                coefficients.append(place)
            elif entry.parameter.value is None:
                others.append(place)
        # Coefficients first: a frequency beside them would make its amplitudes look
        # curved.
        linear = _with_linear(rates, theta, [], coefficients)
        linear = _with_linear(rates, theta, linear, others)
        if linear:
            groups.append(sorted(linear))
    return groups


def _with_linear(
    rates: ca.SX, theta: ca.SX, linear: list[int], tried: list[int]
) -> list[int]:
    """The parameters ``linear`` with those tried in which the rates stay linear."""
    together = linear + tried
    if not together:
        return []
    chosen = theta[together]
    slopes = ca.jacobian(rates, chosen)
    result = list(linear)
    for column in range(len(linear), len(together)):
        if not ca.depends_on(slopes[:, column], chosen):
            result.append(together[column])
    return result


@dataclass(frozen=True, eq=False)
class _ConvexStart:
    """The loss over groups of coefficients in which it is convex, one after another."""

    model: Model
    grid: Grid
    l1: Mapping[str, float]
    groups: Sequence[Sequence[int]]

    @cached_property
    def _defects(self) -> KnownDefects:
        return KnownDefects(self.model, self.grid, STARTING_SCHEME)

    def improved(self, theta: np.ndarray, rounds: int) -> np.ndarray:
        """Theta with every group at its optimum, found so many times in turn."""
        for _ in range(rounds):
            for group in self.groups:
                theta = self._solved(theta, list(group))
        return theta

    def _solved(self, theta: np.ndarray, group: list[int]) -> np.ndarray:
        """Theta with the coefficients ``group`` at their optimum, others fixed.

        The squared defects are linearised, which is exact where they are linear in the
        group.
        """
        grid = self.grid
        unknown = Theta.of(self.model, ("",))
        known = self._defects.at(theta)
        jacobian = known.slopes[:, group]
        d = known.d.ravel()
        is_usable = np.isfinite(jacobian).all(axis=1) & np.isfinite(d)
        weight = np.sqrt(1 / (mean_square_rate(grid) * grid.n_intervals))
        A = weight * jacobian[is_usable]
        b = A @ theta[group] - weight * d[is_usable]
        scale = 1 / np.maximum(np.linalg.norm(A, axis=0), LEAST_SIZE)
        lower = unknown.lower[group]
        upper = unknown.upper[group]
        l1 = unknown.weights(self.l1)[group] / mean_square_rate(grid)
        z = _optimum(A * scale, b, (lower / scale, upper / scale), l1 * scale)
        result = theta.copy()
        if z is not None and np.all(np.isfinite(z)):
            result[group] = np.clip(z * scale, lower, upper)
        return result


def _optimum(
    A: np.ndarray, b: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], l1: np.ndarray
) -> np.ndarray | None:
    """Coefficients z of least |A z - b|^2 + l1 |z| within bounds; None: not found.

    Where the loss does not change along a direction (Casimirs of S), rounding errors
    would set them; the smallest ones are taken there.
    """
    n = A.shape[1]
    lower, upper = bounds
    q, r = np.linalg.qr(np.vstack([A, RANK * np.eye(n)]))
    right = q.T @ np.append(b, np.zeros(n))
    if not np.any(l1):
        return bounded_least_squares(r, right, lower, upper)
    import cvxpy as cp  # takes longer to load than most fits to solve

    z = cp.Variable(n)
    misfit = cp.sum_squares(r @ z - right)
    penalty = cp.sum(cp.multiply(l1, cp.abs(z)))
    below = np.isfinite(lower)
    above = np.isfinite(upper)
    constraints = [z[below] >= lower[below], z[above] <= upper[above]]
    program = cp.Problem(cp.Minimize(misfit + penalty), constraints)
    with warnings.catch_warnings():  # a start need not be accurate to the last digit
        warnings.simplefilter("ignore", UserWarning)
        program.solve(
            solver=cp.CLARABEL, tol_gap_abs=1e-14, tol_gap_rel=1e-12, tol_feas=1e-12
        )
    return None if z.value is None else z.value
