"""The memory of effects: states that nobody measures, behind the other states.

An effect such as hysteresis or a delay adds states to the model. What they are follows
from the other states and the inputs by integration, so a start and a screening find
them along a record without an optimisation. Here a memory does not act back on the
other states; that is the business of the program that is solved afterwards.
"""

from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.column_function import in_numbers
from phsi_opt.transcription.defects import (
    interval_arguments,
    interval_symbols,
    rates_within,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import UNBOUNDED


def with_memory(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """States (n_nodes, n_states) with the memory of the model's effects as the last.

    The memory is integrated along the other states x (n_nodes, n_old). It begins at
    rest where its equation is linear in it, else at zero. Parameters theta are
    (n_free,), or (n_free, n_trajectories).
    """
    if x.shape[1] == model.n_states:
        return x
    return MemoryIntegration(model, grid, x)(theta)[0]


def memory_start_bounds(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Bounds (2, n_nodes, n_states) of the memory that a trajectory begins with.

    It is such as the records show later on: within the values that it takes from rest,
    widened by their range to both sides. Free of bounds, the memory of a delay shorter
    than a sample takes any value for the sake of one residual. Other states have none;
    nor has a model without memory, or one whose last states it is not.
    """
    n_old = model.n_states - len(model.memory)
    if n_old == model.n_states or model.states[n_old:] != model.memory:
        return UNBOUNDED
    integration = MemoryIntegration(model, grid, x[:, :n_old])
    memory = integration(theta)[0][:, n_old:]
    lowest = memory.min(axis=0)
    highest = memory.max(axis=0)
    reach = np.where(highest > lowest, highest - lowest, np.inf)
    bounds = np.broadcast_to(UNBOUNDED, (2, *x.shape)).copy()
    bounds[0, grid.starts, n_old:] = lowest - reach
    bounds[1, grid.starts, n_old:] = highest + reach
    return bounds


def padded(model: Model, x: np.ndarray) -> np.ndarray:
    """States (n_nodes, n_states) with zeros for those at the end that x lacks."""
    n_lacking = model.n_states - x.shape[1]
    return np.pad(x, ((0, 0), (0, n_lacking)))


class MemoryIntegration:
    """The memory of effects along states x (n_nodes, n_old), of the parameters.

    Made once and called for many parameters; `with_memory` is for a single call.
    """

    def __init__(self, model: Model, grid: Grid, x: np.ndarray) -> None:
        self.model = model
        self.grid = grid
        self.x = x
        self._rest = _memory_at_rest(model, x.shape[1])
        # One behind the other, whichever start they follow.
        over_interval = _memory_over_interval(model, x.shape[1])
        self._integrate = over_interval.mapaccum("memory", grid.n_intervals)

    def __call__(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n_nodes, n_states) with their memory, and means of this.

        For theta (n_free,) or (n_free, n_trajectories); the means of the memory over
        the intervals are (n_intervals, n_memory).
        """
        grid = self.grid.driven(self.model, theta)
        n_old = self.x.shape[1]
        states = padded(self.model, self.x)
        by_run = np.broadcast_to(theta.T, (grid.n_trajectories, len(theta))).T
        first = np.flatnonzero(np.isin(grid.begin, grid.starts))
        starts = grid.begin[first]
        (at_rest,) = in_numbers(
            self._rest,
            self.x[starts].T,
            grid.u0[first].T,
            grid.t[None, starts],
            by_run[:, grid.trajectory[starts]],
        )
        at_rest[:, ~np.isfinite(at_rest).all(axis=0)] = 0.0
        states[starts, n_old:] = at_rest.T
        # What the memory is where an interval begins anew, and where one does.
        anew = np.zeros((len(at_rest) + 1, grid.n_intervals))
        anew[:, first] = np.vstack([at_rest, np.ones(len(first))])
        arguments = interval_arguments(grid, self.x.T)
        found = self._integrate(at_rest[:, 0], anew, *arguments, by_run[:, grid.runs])
        at_ends, means = (one.full().T for one in found)
        states[grid.begin + 1, n_old:] = at_ends
        return states, means


def _memory_over_interval(model: Model, n_old: int, n_steps: int = 4) -> ca.Function:
    """CasADi function (z, anew, x0, ..., theta) -> (z at the end, mean of z).

    z is the memory where the interval before ended, ``anew`` the one that this interval
    may begin with instead, and whether it does; x0 and the rest are those of a
    `defect`.

    By steps of the trapezoidal rule, linearised at their beginning: with r the rate of
    z and J its slope in z there, each step dt adds::

        dt/2 (I - dt/2 J)^-1 (r(z, begin) + r(z, end))

    Implicit, because a short delay is stiff.
    """
    n_memory = model.n_states - n_old
    z = ca.SX.sym("z", n_memory)
    anew = ca.SX.sym("anew", n_memory + 1)
    x0 = ca.SX.sym("x0", n_old)
    x1 = ca.SX.sym("x1", n_old)
    interval = interval_symbols(model)
    share = ca.SX.sym("share")  # of the interval
    given = [x0, x1, *interval]
    rhs = model.rhs()

    def rate(value: Any, at: Any) -> Any:
        x = ca.vertcat(x0 + at * (x1 - x0), value)
        return rates_within(rhs, interval, x, at)[n_old:]

    dt = interval[1] / n_steps
    both_rates = rate(z, share) + rate(z, share + 1 / n_steps)
    slope = ca.jacobian(rate(z, share), z)
    implicit = ca.SX.eye(n_memory) - dt / 2 * slope
    end = z + dt / 2 * ca.solve(implicit, both_rates)
    step = ca.Function("part", [z, share, *given], [end])
    before = ca.if_else(anew[-1], anew[:-1], z)
    mean: Any = ca.SX.zeros(n_memory)
    for k in range(n_steps):
        after = step(before, k / n_steps, *given)
        mean = mean + (before + after) / (2 * n_steps)
        before = after
    return ca.Function("step", [z, anew, *given], [before, mean])


def _memory_at_rest(model: Model, n_old: int) -> ca.Function:
    """CasADi function (x, u, t, theta) -> memory without rates; zeros: not linear."""
    rhs = model.rhs()
    states, *others = argument_symbols(rhs)
    z = states[n_old:]
    rates = rhs(states, *others)[n_old:]
    slope = ca.jacobian(rates, z)
    rest: Any = ca.DM.zeros(z.numel())
    if not ca.depends_on(slope, z):
        rest = -ca.solve(slope, ca.substitute(rates, z, rest))
    return ca.Function("rest", [states[:n_old], *others], [rest])
