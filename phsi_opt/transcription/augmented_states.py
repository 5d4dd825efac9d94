"""The memory of effects, states that nobody measures, along the other states of a
record.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.point import StateBounds

MEMORY_STEPS = 4  # of an integration of an effect's memory along one interval


def with_memory(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """States (n_nodes, n_states) with the memory of the model's effects integrated
    along the other states ``x``.

    ``x`` holds the other states and those of older effects; ``theta`` is (n_free,) or
    (n_free, n_trajectories). A memory begins at rest where its equation is linear in
    it, else at zero.
    """
    return (
        x
        if x.shape[1] == model.n_states
        else MemoryIntegration(model, grid, x)(theta).states
    )


def memory_start_bounds(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> StateBounds | None:
    """Bounds of the states, (n_nodes, n_states): of the memory that a trajectory begins
    with, the others are infinite.

    It is such as the records show later on: within the values that it takes from rest,
    widened by their range to both sides. Free of bounds, the memory of a delay shorter
    than a sample takes any value for the sake of one residual. Arguments as
    `with_memory`; None where the model has no memory, or not as its last states.
    """
    n_old = model.n_states - len(model.memory)
    if n_old == model.n_states or model.states[n_old:] != model.memory:
        return None
    along = MemoryIntegration(model, grid, x[:, :n_old])(theta).states[:, n_old:]
    lowest, highest = along.min(axis=0), along.max(axis=0)
    spread = np.where(highest > lowest, highest - lowest, np.inf)
    lower, upper = np.full(x.shape, -np.inf), np.full(x.shape, np.inf)
    lower[grid.first, n_old:], upper[grid.first, n_old:] = (
        lowest - spread,
        highest + spread,
    )
    return StateBounds(lower, upper)


@dataclass(frozen=True, eq=False)
class MemoryRecord:
    """The memory of a model's effects along a record.

    Attributes:
        states: (n_nodes, n_states) states with the memory as the last of them.
        interval_means: (n_intervals, n_memory) means of the memory over the intervals.
    """

    states: np.ndarray
    interval_means: np.ndarray


class MemoryIntegration:
    """The memory of a model's effects along given states, as a function of the
    parameters (see `with_memory`).
    """

    def __init__(self, model: Model, grid: Grid, x: np.ndarray) -> None:
        self.model, self.grid, self.x = model, grid, x
        one, self.at = _memory_step(model, x.shape[1]), []
        self.along = []
        for run in range(len(grid.first)):
            at = np.flatnonzero(grid.trajectory[grid.begin] == run)
            self.at.append(at)
            self.along.append(one.mapaccum("memory", len(at)))
        self.rest = _rest(model, x.shape[1])

    def __call__(self, theta: np.ndarray) -> MemoryRecord:
        """The states with their memory, (n_nodes, n_states), and the memory's means
        over the intervals.
        """
        grid, x, n_old = self.grid, self.x, self.x.shape[1]
        result, means = (
            padded(self.model, x),
            np.zeros((grid.n_intervals, self.model.n_states - n_old)),
        )
        columns = theta if theta.ndim == 2 else theta[:, None]
        for run, (first, at, along) in enumerate(
            zip(grid.first, self.at, self.along, strict=True)
        ):
            values = columns[:, run % columns.shape[1]]
            z0 = np.array(
                self.rest(x[first], grid.u0[at[0]], grid.t[first], values)
            ).ravel()
            z0 = z0 if np.all(np.isfinite(z0)) else np.zeros(len(z0))
            ends = [
                x[grid.begin[at]].T,
                x[grid.begin[at] + 1].T,
                grid.u0[at].T,
                grid.u1[at].T,
            ]
            times = [grid.t[grid.begin[at]][None, :], grid.h[at][None, :]]
            z, mean = along(
                z0, *ends, *times, np.repeat(values[:, None], len(at), axis=1)
            )
            result[first, n_old:], result[grid.begin[at] + 1, n_old:] = z0, z.full().T
            means[at] = mean.full().T
        return MemoryRecord(result, means)


def _memory_step(model: Model, n_old: int) -> ca.Function:
    """CasADi function (z, x0, x1, u0, u1, t0, h, theta) -> z at the end of an interval,
    its mean over the interval.

    Steps of the trapezoidal rule with the slope taken at their beginning: a short delay
        is stiff.
    """
    n_new, m, rhs = model.n_states - n_old, model.n_inputs, model.rhs()
    z, x0, x1 = ca.SX.sym("z", n_new), ca.SX.sym("x0", n_old), ca.SX.sym("x1", n_old)
    u0, u1, t0, h = (
        ca.SX.sym("u0", m),
        ca.SX.sym("u1", m),
        ca.SX.sym("t0"),
        ca.SX.sym("h"),
    )
    theta, share = ca.SX.sym("theta", len(model.free)), ca.SX.sym("share")

    def rate(value: Any, at: Any) -> Any:
        x = ca.vertcat(x0 + at * (x1 - x0), value)
        return rhs(x, u0 + at * (u1 - u0), t0 + at * h, theta)[n_old:]

    step, given = h / MEMORY_STEPS, [x0, x1, u0, u1, t0, h, theta]
    both = rate(z, share) + rate(z, share + 1 / MEMORY_STEPS)
    end = z + step / 2 * ca.solve(
        ca.SX.eye(n_new) - step / 2 * ca.jacobian(rate(z, share), z), both
    )
    one = ca.Function("part", [z, share, *given], [end])
    at, mean = z, ca.SX.zeros(n_new)
    for k in range(MEMORY_STEPS):
        after = one(at, k / MEMORY_STEPS, *given)
        at, mean = after, mean + (at + after) / (2 * MEMORY_STEPS)
    return ca.Function("step", [z, *given], [at, mean])


def _rest(model: Model, n_old: int) -> ca.Function:
    """CasADi function (x, u, t, theta) -> the memory whose rates vanish, if they are
    linear in it; else zeros.
    """
    n_new, rhs = model.n_states - n_old, model.rhs()
    x, u, t = ca.SX.sym("x", n_old), ca.SX.sym("u", model.n_inputs), ca.SX.sym("t")
    theta, z = ca.SX.sym("theta", len(model.free)), ca.SX.sym("z", n_new)
    rates = rhs(ca.vertcat(x, z), u, t, theta)[n_old:]
    slope = ca.jacobian(rates, z)
    if ca.depends_on(slope, z):
        return ca.Function("rest", [x, u, t, theta], [ca.DM.zeros(n_new)])
    at_zero = ca.substitute(rates, z, ca.DM.zeros(n_new))
    return ca.Function("rest", [x, u, t, theta], [-ca.solve(slope, at_zero)])


def padded(model: Model, x: np.ndarray) -> np.ndarray:
    """States with zeros for those at the end that x does not hold yet."""
    return np.pad(x, ((0, 0), (0, model.n_states - x.shape[1])))
