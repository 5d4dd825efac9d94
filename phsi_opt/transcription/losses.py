"""The three losses: one family of problems that differ in where the noise is assumed to
be.

| loss                | states             | defects                | objective | |
PHSILoss            | the data           | minimised              | mean of squared
defects + L1 (thesis Eq. 5.6) | | MaximumLikelihood   | decision variables | equal to
zero          | mean of squared residuals over sigma^2 + L1 | | MissingForce        |
decision variables | decision variables w   | squared residuals over sigma^2 +
smoothness of w |

Each makes a `Program` from a model, a grid and a starting point; what is done with the
program is the business of `identify`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix

from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.model.model import Model
from phsi_opt.optimization.program import Assembly, Program
from phsi_opt.transcription.defects import (
    defect_jacobian,
    defects,
    interval_curvatures,
    interval_slopes,
)
from phsi_opt.transcription.force_prior import ForcePrior
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import outputs


@dataclass(frozen=True)
class PHSILoss:
    """(1/m) sum_i |(x_{i+1} - x_i)/h_i - Psi(g; x_i, x_{i+1})|^2 + sum_j lambda_j
    |xi_j| (thesis Eq. 5.6 as a mean).

    The states are the data, so every state must be measured; an interval with a missing
    end is left out. Fast, and convex where Psi is one evaluation of g and R is fixed.
    The noise in the states biases it: final estimates with measured data are
    `MaximumLikelihood`'s.
    """

    integrator: str = "srk4"

    def program(
        self, model: Model, grid: Grid, point: Point, l1: Mapping[str, float]
    ) -> Program:
        """The program in theta and the slacks; the data enter as numbers."""
        used = complete_intervals(model, grid)
        size = mean_square_rate(used)
        weight = np.sqrt(2 / (size * used.n_intervals))
        exact = defect_jacobian(model, used, self.integrator)
        scale, n = ca.DM(point.theta_scale), len(model.free)

        def jacobian(z: ca.MX) -> ca.MX:
            dense = weight * exact(used.y.T, z[:n] * scale) @ ca.diag(scale)
            return ca.horzcat(dense, ca.MX(dense.size1(), z.numel() - n))

        build = Assembly()
        unknown = Theta.of(model, ("",))
        theta = _theta(build, unknown, point)
        build.residual(
            weight * defects(model, used, self.integrator, ca.DM(used.y.T), theta),
            jacobian,
        )
        _add_l1(build, unknown, theta, point, l1, 1 / size)
        return build.finish()


@dataclass(frozen=True)
class MaximumLikelihood:
    """Minimise (1/N) sum ((y - x)/sigma)^2 + sum lambda |xi| over states and
    parameters, subject to zero defects.

    States that nobody measured and missing samples are no obstacle.

    Args:
        noise: standard deviations by state name; None estimates them.
        integrator: the scheme of the defects.
        steps: intervals between neighbouring samples; None puts as many, where they are
            needed, as the estimates and residuals notice.
        huber: residuals beyond so many standard deviations count linearly (1.345 costs
            5 % of the efficiency on normal noise), so that outliers pull little; None:
            all count squared.
        window: length in time of the pieces with free starting states that are solved
            first, from which the whole record starts; None: only where the whole record
            cannot be solved.
        starts: number of starting points, the first from the data, others moved from it
            by a fixed random sequence; the fit's warnings say how many of them agree.
    """

    noise: Mapping[str, float] | None = None
    integrator: str = "srk4"
    steps: int | None = None
    huber: float | None = None
    window: float | None = None
    starts: int = 1

    def __post_init__(self) -> None:
        for name in ("huber", "window"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ModelError(
                    f"{name}={value!r} of MaximumLikelihood must be a number above zero, or None."
                )
        for name in ("steps", "starts"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int) or value < 1):
                raise ModelError(
                    f"{name}={value!r} of MaximumLikelihood must be a whole number of at least 1."
                )

    def program(
        self,
        model: Model,
        grid: Grid,
        point: Point,
        l1: Mapping[str, float],
        sigma: np.ndarray,
        unknown: Theta,
    ) -> Program:
        """The program in theta, x and the slacks. ``sigma`` (n_states,), noise of each
        channel, is a setting of it.
        """
        build = Assembly()
        theta = _theta(build, unknown, point)
        x = _states(build, grid, point)
        of_runs = unknown.by_trajectory(theta)
        d = defects(model, grid, self.integrator, x, of_runs)
        build.constrain(
            "defect",
            _scaled(d, grid, point),
            label=grid.interval_label(model.n_states),
            jacobian=lambda z: _defect_rows(
                model, grid, self.integrator, point, unknown, z
            ),
        )
        n = int(grid.measured.sum())
        residual = _misfit(model, x, of_runs, grid, build.setting("sigma", sigma))
        if self.huber is not None:
            residual = residual - _outliers(build, n, self.huber)
        build.residual(residual * np.sqrt(2 / n))
        _add_l1(build, unknown, theta, point, l1, 1.0)
        build.curvature(
            lambda z, multipliers: self._curvature(
                model, grid, point, unknown, z, multipliers
            )
        )
        return build.finish()

    def _curvature(
        self,
        model: Model,
        grid: Grid,
        point: Point,
        unknown: Theta,
        z: ca.MX,
        multipliers: ca.MX,
    ) -> ca.MX:
        """What the defects add to the Hessian of the Lagrangian: second derivatives per
        interval, summed in place.
        """
        n, m, p = model.n_states, grid.n_intervals, len(unknown)
        scale = np.r_[point.theta_scale, np.tile(point.x_scale, grid.n_nodes)]
        values = z[: len(scale)] * ca.DM(scale)
        x, theta = ca.reshape(values[p:], n, -1), unknown.by_trajectory(values[:p])
        # The constraint is the defect times h over the state's size.
        weighted = ca.reshape(multipliers[: n * m], n, m) * ca.DM(
            grid.h[None, :] / point.x_scale[:, None]
        )
        entries, places = interval_curvatures(
            model, grid, self.integrator, x, theta, weighted
        )
        local = _local(model, grid, unknown)
        i, j = local[:, places[:, 0]].ravel(), local[:, places[:, 1]].ravel()
        i, j = np.minimum(i, j), np.maximum(i, j)
        keys, where = np.unique(j * z.numel() + i, return_inverse=True)
        gather = ca.DM(
            csc_matrix(
                (scale[i] * scale[j], (where, np.arange(len(i)))),
                shape=(len(keys), len(i)),
            )
        )
        pattern = ca.Sparsity.triplet(
            z.numel(),
            z.numel(),
            (keys % z.numel()).tolist(),
            (keys // z.numel()).tolist(),
        )
        return ca.MX(pattern, ca.mtimes(gather, ca.vec(entries)))


@dataclass(frozen=True)
class MissingForce:
    """Minimise 1/2 sum ((y - x)/sigma)^2 + 1/2 |w|_prior^2 subject to defects = w in
    the forced equations, else zero.

    w, one value per interval and forced equation, is a force that the model lacks. Its
    prior is an Ornstein-Uhlenbeck process of standard deviation ``size`` and
    correlation time ``time``: smooth enough to tell force from noise, rough enough for
    a friction that jumps. Its size is chosen by marginal likelihood (`missing`), never
    inside this program, where it would collapse to zero.
    """

    integrator: str = "srk4"

    def program(
        self,
        model: Model,
        grid: Grid,
        point: Point,
        prior: ForcePrior,
        sigma: np.ndarray,
        unknown: Theta | None = None,
    ) -> Program:
        """The program in x and w, and in theta where it is ``unknown``; else that stays
        at ``point.theta``.
        """
        build = Assembly()
        theta: Any = (
            ca.DM(point.theta)
            if unknown is None
            else unknown.by_trajectory(_theta(build, unknown, point))
        )
        x = _states(build, grid, point)
        n_forced, rows = len(prior.rows), list(prior.rows)
        start = np.zeros((grid.n_intervals, n_forced)) if point.w is None else point.w
        # Size and noise are settings: the updates of both solve the same program again.
        size, noise = build.setting("size", prior.size), build.setting("sigma", sigma)
        scale = np.tile(prior.size, grid.n_intervals)
        w = ca.reshape(build.variable("w", start.ravel(), scale=scale), n_forced, -1)
        selector = np.zeros((model.n_states, n_forced))
        selector[rows, np.arange(n_forced)] = 1.0
        d = defects(model, grid, self.integrator, x, theta) - ca.mtimes(
            ca.DM(selector), w
        )
        # The force enters linearly: per interval and forced row, minus its scale.
        pushes = -csc_matrix(
            (
                np.tile(scale[:n_forced], grid.n_intervals)
                * (grid.h[:, None] / point.x_scale[rows]).ravel(),
                (
                    (
                        model.n_states * np.arange(grid.n_intervals)[:, None] + rows
                    ).ravel(),
                    np.arange(w.numel()),
                ),
            ),
            shape=(model.n_states * grid.n_intervals, w.numel()),
        )
        build.constrain(
            "defect",
            _scaled(d, grid, point),
            label=grid.interval_label(model.n_states),
            jacobian=lambda z: ca.horzcat(
                _defect_rows(
                    model,
                    grid,
                    self.integrator,
                    point,
                    unknown,
                    z[: z.numel() - w.numel()],
                ),
                ca.DM(pushes),
            ),
        )
        build.residual(_misfit(model, x, theta, grid, noise))
        for k in range(n_forced):
            build.residual(
                ca.mtimes(ca.DM(prior.unit_whitener(grid)), w[k, :].T) / size[k]
            )
        return build.finish()


def l1_weights(l1: Mapping[str, float] | float | None) -> dict[str, float]:
    """L1 weight per slot: a number stands for H and F alike."""
    if l1 is None:
        return {}
    weights = dict(l1) if isinstance(l1, Mapping) else {"H": l1, "F": l1}
    for slot, weight in weights.items():
        if slot not in ("H", "R", "F"):
            raise ModelError(
                f"l1 names slot {slot!r}; expected 'H', 'R' or 'F'.{did_you_mean(str(slot), 'HRF')}"
            )
        if not np.isfinite(weight) or weight < 0:
            raise ModelError(
                f"l1[{slot!r}]={weight!r} must be a finite number of at least 0."
            )
    return weights


def complete_intervals(model: Model, grid: Grid) -> Grid:
    """The grid with only the intervals whose two ends are completely measured; raises
    `DataError` if there are none.
    """
    alone = [
        name for name, entry in model.entries.items() if entry.parameter.per_trajectory
    ]
    if model.sensor or alone:
        what = (
            f"the parameter per trajectory {alone[0]!r}"
            if alone
            else f"the sensor of {next(iter(model.sensor))!r}"
        )
        raise ModelError(f"PHSILoss has no place for {what}; use MaximumLikelihood().")
    never = [
        name
        for name, seen in zip(model.states, grid.measured.T, strict=True)
        if not np.any(seen)
    ]
    if never:
        raise DataError(
            f"state {never[0]!r} was never measured, but PHSILoss takes the states from the data; use "
            "MaximumLikelihood(), where the states are decision variables."
        )
    full = np.asarray(grid.measured.all(axis=1))
    keep = np.flatnonzero(full[grid.begin] & full[grid.begin + 1])
    if not len(keep):
        raise DataError(
            "no two neighbouring samples are complete, so there is no defect; use MaximumLikelihood()."
        )
    return grid.intervals(keep)


def mean_square_rate(grid: Grid) -> float:
    """Mean square of the rates: the objective is divided by it, so that a tolerance
    does not depend on units.
    """
    size = float(np.mean(np.sum(grid.rates(grid.y) ** 2, axis=1)))
    return size if size > 0 else 1.0


def _theta(build: Assembly, unknown: Theta, point: Point) -> ca.MX:
    entries = [entry.parameter for entry in unknown.entries]
    lower, upper = (
        np.array([p.lower for p in entries]),
        np.array([p.upper for p in entries]),
    )
    return build.variable(
        "theta",
        point.theta,
        lower,
        upper,
        point.theta_scale,
        lambda i: unknown.names[i],
    )


def _defect_rows(
    model: Model, grid: Grid, scheme: str, point: Point, unknown: Theta | None, z: ca.MX
) -> ca.MX:
    """Jacobian of the scaled defects in z, whose first entries are theta (where it is
    ``unknown``) and the states.
    """
    n, m, p = model.n_states, grid.n_intervals, 0 if unknown is None else len(unknown)
    scale = np.r_[
        point.theta_scale if p else np.zeros(0), np.tile(point.x_scale, grid.n_nodes)
    ]
    values = z[: len(scale)] * ca.DM(scale)
    x, theta = (
        ca.reshape(values[p:], n, -1),
        ca.DM(point.theta) if unknown is None else unknown.by_trajectory(values[:p]),
    )
    entries, places = interval_slopes(model, grid, scheme, x, theta, p > 0)
    i = n * np.arange(m)[:, None] + places[:, 0]
    j = _local(model, grid, unknown)[:, places[:, 1]]
    size = (grid.h[:, None] / point.x_scale[places[:, 0]]) * scale[j]
    order = np.lexsort((i.ravel(), j.ravel()))
    pattern = ca.Sparsity.triplet(
        n * m, z.numel(), i.ravel()[order].tolist(), j.ravel()[order].tolist()
    )
    return ca.MX(pattern, ca.vec(entries)[order.tolist()] * ca.DM(size.ravel()[order]))


def _local(model: Model, grid: Grid, unknown: Theta | None) -> np.ndarray:
    """Places in z of x0, x1 and the parameters of every interval, (n_intervals, 2
    n_states + n_free).
    """
    n, p = model.n_states, 0 if unknown is None else len(unknown)
    states = p + n * grid.begin[:, None] + np.arange(2 * n)
    return (
        states
        if unknown is None
        else np.hstack([states, unknown.table.T[grid.trajectory[grid.begin]]])
    )


def _states(build: Assembly, grid: Grid, point: Point) -> ca.MX:
    n = point.x.shape[1]
    label = lambda i: (
        f"trajectory={grid.trajectory[i // n]}, t={grid.t[i // n]:g}, state={i % n}"
    )  # noqa: E731
    lower, upper = (
        (-np.inf, np.inf)
        if point.x_bounds is None
        else (point.x_bounds.lower.ravel(), point.x_bounds.upper.ravel())
    )
    scale = np.tile(point.x_scale, grid.n_nodes)
    return ca.reshape(
        build.variable("x", point.x.ravel(), lower, upper, scale, label), n, -1
    )


def _scaled(d: ca.MX, grid: Grid, point: Point) -> ca.MX:
    # As an error of the state in units of its size: comparable between equations and
    # between step lengths.
    return d * ca.DM(grid.h[None, :] / point.x_scale[:, None])


def _misfit(model: Model, x: ca.MX, theta: Any, grid: Grid, sigma: ca.MX) -> ca.MX:
    shown = outputs(model, grid, x, theta) if model.sensor else x
    measured = grid.measured
    seen = np.flatnonzero(
        measured.ravel()
    ).tolist()  # row-major (n_nodes, n_states) = CasADi's columns
    spread = ca.vec(sigma[np.nonzero(measured)[1].tolist()])
    return (ca.DM(grid.y.ravel()[seen]) - ca.vec(shown)[seen]) / spread


def _outliers(build: Assembly, n: int, limit: float) -> ca.MX:
    """Slack variables that take over what is beyond the limit, at a linear cost:
    together, Huber's function.
    """
    parts = [
        build.variable(f"outlier_{name}", np.full(n, 0.1), lower=0.0)
        for name in ("above", "below")
    ]
    build.cost(2 * limit / n * (ca.sum1(parts[0]) + ca.sum1(parts[1])))
    return parts[0] - parts[1]


def _add_l1(
    build: Assembly,
    unknown: Theta,
    theta: ca.MX,
    point: Point,
    l1: Mapping[str, float],
    factor: float,
) -> None:
    entries = unknown.entries
    chosen = [
        i
        for i, entry in enumerate(entries)
        if entry.prunable and l1.get(entry.slot, 0) > 0
    ]
    if chosen:
        weight = factor * np.array([l1[entries[i].slot] for i in chosen])
        build.l1(
            "theta",
            theta[chosen],
            weight,
            point.theta[chosen],
            point.theta_scale[chosen],
        )
