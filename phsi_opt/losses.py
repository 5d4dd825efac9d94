"""The three losses: one family of problems that differ in where the noise is assumed to be.

| loss                | states             | defects                | objective |
| PHSILoss            | the data           | minimised              | mean of squared defects + L1 (thesis Eq. 5.6) |
| MaximumLikelihood   | decision variables | equal to zero          | mean of squared residuals over sigma^2 + L1 |
| MissingForce        | decision variables | decision variables w   | squared residuals over sigma^2 + smoothness of w |

Each makes a `Program` from a model, a grid and a starting point; what is done with the program is the business of
`identify`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.grid import Grid, defect_jacobian, defects
from phsi_opt.model import Model
from phsi_opt.nlp import Assembly, Program


@dataclass(frozen=True, eq=False)
class Point:
    """A point to start from, with each quantity's size: theta in the order of `Model.free`, x (n_nodes, n_states)."""

    theta: np.ndarray
    x: np.ndarray
    theta_scale: np.ndarray
    x_scale: np.ndarray
    w: np.ndarray | None = None  # (n_intervals, n_forced)


@dataclass(frozen=True)
class PHSILoss:
    """(1/m) sum_i |(x_{i+1} - x_i)/h_i - Psi(g; x_i, x_{i+1})|^2 + sum_j lambda_j |xi_j| (thesis Eq. 5.6 as a mean).

    The states are the data, so every state must be measured; an interval with a missing end is left out. Fast, and
    convex where Psi is one evaluation of g and R is fixed. The noise in the states biases it: final estimates with
    measured data are `MaximumLikelihood`'s.
    """

    integrator: str = "srk4"

    def program(self, model: Model, grid: Grid, point: Point, l1: Mapping[str, float]) -> Program:
        """The program in theta and the slacks; the data enter as numbers."""
        used = complete(model, grid)
        size = rate_size(used)
        weight = np.sqrt(2 / (size * used.n_intervals))
        exact = defect_jacobian(model, used, self.integrator)
        scale, n = ca.DM(point.theta_scale), len(model.free)

        def jacobian(z: ca.MX) -> ca.MX:
            dense = weight * exact(used.y.T, z[:n] * scale) @ ca.diag(scale)
            return ca.horzcat(dense, ca.MX(dense.size1(), z.numel() - n))

        build = Assembly()
        theta = _theta(build, model, point)
        build.residual(weight * defects(model, used, self.integrator, ca.DM(used.y.T), theta), jacobian)
        _add_l1(build, model, theta, point, l1, 1 / size)
        return build.finish()


@dataclass(frozen=True)
class MaximumLikelihood:
    """Minimise (1/N) sum ((y - x)/sigma)^2 + sum lambda |xi| over states and parameters, subject to zero defects.

    States that nobody measured and missing samples are no obstacle. ``noise`` are standard deviations by state name;
    None estimates them. ``steps`` intervals are put between neighbouring samples (None: as many as the integration
    error asks for).
    """

    noise: Mapping[str, float] | None = None
    integrator: str = "srk4"
    steps: int | None = None

    def program(self, model: Model, grid: Grid, point: Point, l1: Mapping[str, float], sigma: np.ndarray) -> Program:
        """The program in theta, x and the slacks. ``sigma`` (n_states,): noise of each channel."""
        build = Assembly()
        theta = _theta(build, model, point)
        x = _states(build, grid, point)
        d = defects(model, grid, self.integrator, x, theta)
        build.constrain("defect", _scaled(d, grid, point), label=grid.interval_label(model.n_states))
        n = int(grid.measured.sum())
        build.residual(_misfit(x, grid, sigma) * np.sqrt(2 / n))
        _add_l1(build, model, theta, point, l1, 1.0)
        return build.finish()


@dataclass(frozen=True)
class MissingForce:
    """Minimise 1/2 sum ((y - x)/sigma)^2 + 1/2 |w|_prior^2 subject to defects = w in the forced equations, else zero.

    w, one value per interval and forced equation, is a force that the model lacks. Its prior is an Ornstein-Uhlenbeck
    process of standard deviation ``size`` and correlation time ``time``: smooth enough to tell force from noise, rough
    enough for a friction that jumps. Its size is chosen by marginal likelihood (`missing`), never inside this program,
    where it would collapse to zero.
    """

    integrator: str = "srk4"

    def program(
        self, model: Model, grid: Grid, point: Point, prior: "ForcePrior", sigma: np.ndarray, fixed: bool = True
    ) -> Program:
        """The program in x and w (and theta, unless ``fixed``)."""
        build = Assembly()
        theta = ca.DM(point.theta) if fixed else _theta(build, model, point)
        x = _states(build, grid, point)
        n_forced, rows = len(prior.rows), list(prior.rows)
        start = np.zeros((grid.n_intervals, n_forced)) if point.w is None else point.w
        w = ca.reshape(build.variable("w", start.ravel(), scale=np.tile(prior.size, grid.n_intervals)), n_forced, -1)
        selector = np.zeros((model.n_states, n_forced))
        selector[rows, np.arange(n_forced)] = 1.0
        d = defects(model, grid, self.integrator, x, theta) - ca.mtimes(ca.DM(selector), w)
        build.constrain("defect", _scaled(d, grid, point), label=grid.interval_label(model.n_states))
        build.residual(_misfit(x, grid, sigma))
        for k in range(n_forced):
            build.residual(prior.whiten(grid, k, w[k, :].T))
        return build.finish()


@dataclass(frozen=True, eq=False)
class ForcePrior:
    """Ornstein-Uhlenbeck prior of the missing force: rows (equations) it acts in, size per row, correlation time."""

    rows: tuple[int, ...]
    size: np.ndarray
    time: float

    def whiten(self, grid: Grid, k: int, w: ca.MX) -> ca.MX:
        """Independent standard normal innovations of the force in row k, one per interval."""
        return ca.mtimes(ca.DM(self.whitener(grid, k)), w)

    def whitener(self, grid: Grid, k: int):  # type: ignore[no-untyped-def]
        """Sparse matrix from the force in row k to its innovations."""
        from scipy.sparse import diags

        middle = grid.t[grid.begin] + grid.h / 2
        first = np.diff(grid.trajectory[grid.begin], prepend=-1) != 0
        decay = np.exp(-np.diff(middle, prepend=middle[0]) / self.time)
        decay[first] = 0.0
        spread = self.size[k] * np.sqrt(-np.expm1(2 * np.log(np.maximum(decay, 1e-300))))
        return diags([1 / spread, -decay[1:] / spread[1:]], [0, -1], format="csc")


def l1_weights(l1: Mapping[str, float] | float | None) -> dict[str, float]:
    """L1 weight per slot: a number stands for H and F alike."""
    if l1 is None:
        return {}
    weights = dict(l1) if isinstance(l1, Mapping) else {"H": l1, "F": l1}
    for slot, weight in weights.items():
        if slot not in ("H", "R", "F"):
            raise ModelError(f"l1 names slot {slot!r}; expected 'H', 'R' or 'F'.{did_you_mean(str(slot), 'HRF')}")
        if not np.isfinite(weight) or weight < 0:
            raise ModelError(f"l1[{slot!r}]={weight!r} must be a finite number of at least 0.")
    return weights


def complete(model: Model, grid: Grid) -> Grid:
    """The grid with only the intervals whose two ends are completely measured; raises `DataError` if there are none."""
    never = [name for name, seen in zip(model.states, grid.measured.T, strict=True) if not np.any(seen)]
    if never:
        raise DataError(
            f"state {never[0]!r} was never measured, but PHSILoss takes the states from the data; use "
            "MaximumLikelihood(), where the states are decision variables."
        )
    full = np.asarray(grid.measured.all(axis=1))
    keep = np.flatnonzero(full[grid.begin] & full[grid.begin + 1])
    if not len(keep):
        raise DataError("no two neighbouring samples are complete, so there is no defect; use MaximumLikelihood().")
    return grid.intervals(keep)


def rate_size(grid: Grid) -> float:
    """Mean square of the rates: the objective is divided by it, so that a tolerance does not depend on units."""
    size = float(np.mean(np.sum(grid.rates(grid.y) ** 2, axis=1)))
    return size if size > 0 else 1.0


def _theta(build: Assembly, model: Model, point: Point) -> ca.MX:
    entries = [model.entries[name].parameter for name in model.free]
    lower, upper = np.array([p.lower for p in entries]), np.array([p.upper for p in entries])
    return build.variable("theta", point.theta, lower, upper, point.theta_scale, lambda i: model.free[i])


def _states(build: Assembly, grid: Grid, point: Point) -> ca.MX:
    n = point.x.shape[1]
    label = lambda i: f"trajectory={grid.trajectory[i // n]}, t={grid.t[i // n]:g}, state={i % n}"  # noqa: E731
    return ca.reshape(
        build.variable("x", point.x.ravel(), scale=np.tile(point.x_scale, grid.n_nodes), label=label), n, -1
    )


def _scaled(d: ca.MX, grid: Grid, point: Point) -> ca.MX:
    # As an error of the state in units of its size: comparable between equations and between step lengths.
    return d * ca.DM(grid.h[None, :] / point.x_scale[:, None])


def _misfit(x: ca.MX, grid: Grid, sigma: np.ndarray) -> ca.MX:
    seen = np.flatnonzero(grid.measured.ravel()).tolist()  # row-major (n_nodes, n_states) = CasADi's columns
    weight = 1 / np.tile(sigma, grid.n_nodes)[seen]
    return (ca.DM(grid.y.ravel()[seen]) - ca.vec(x)[seen]) * ca.DM(weight)


def _add_l1(build: Assembly, model: Model, theta: ca.MX, point: Point, l1: Mapping[str, float], factor: float) -> None:
    entries = model.entries
    chosen = [i for i, name in enumerate(model.free) if entries[name].prunable and l1.get(entries[name].slot, 0) > 0]
    if chosen:
        weight = factor * np.array([l1[entries[model.free[i]].slot] for i in chosen])
        build.l1("theta", theta[chosen], weight, point.theta[chosen], point.theta_scale[chosen])
