"""A linearised record with one interval between samples, however many steps it had.

Steps between samples keep the integration accurate; what acts beside the model is not
resolved by them. The linear dynamics of the steps in a gap follow one after the other
and make one step over the gap, in which a force is held.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix

from phsi_opt.model_error.linearization import Linearization
from phsi_opt.optimization.passage import NEGLIGIBLE


@dataclass(eq=False)
class _Dynamics:
    """``before x0 + after x1 + in_theta theta + offset = of_force w``, per interval.

    Attributes:
        before: (n, n_states, n_states).
        after: (n, n_states, n_states).
        in_theta: (n, n_states, n_theta).
        offset: (n, n_states, 1).
        of_force: (n, n_states, n_states), the last axis the equation of the force.
    """

    before: np.ndarray
    after: np.ndarray
    in_theta: np.ndarray
    offset: np.ndarray
    of_force: np.ndarray

    @classmethod
    def of(cls, problem: Linearization, intervals: np.ndarray) -> "_Dynamics":
        """Of some intervals of a record."""
        n = problem.n_states
        n_intervals = problem.grid.n_intervals
        before, after = _blocks(problem, intervals)
        in_theta = problem.dynamics_in_theta.reshape(n_intervals, n, -1)
        offset = problem.offset.reshape(n_intervals, n, 1)
        of_force = problem.force_effects[intervals]
        return cls(before, after, in_theta[intervals], offset[intervals], of_force)

    def followed_by(self, places: np.ndarray, later: "_Dynamics") -> None:
        """Some of these, each followed by one of ``later``; x1 is solved for."""
        passed = np.swapaxes(self.after[places], 1, 2)
        back = np.linalg.solve(passed, np.swapaxes(later.before, 1, 2))
        on = -np.swapaxes(back, 1, 2)
        self.before[places] = on @ self.before[places]
        self.after[places] = later.after
        self.in_theta[places] = on @ self.in_theta[places] + later.in_theta
        self.offset[places] = on @ self.offset[places] + later.offset
        self.of_force[places] = on @ self.of_force[places] + later.of_force


def _blocks(problem: Linearization, intervals: np.ndarray) -> np.ndarray:
    """Slopes in the states at begin and end, (2, n_chosen, n_states, n_states)."""
    n = problem.n_states
    rows = (intervals[:, None] * n + np.arange(n)).ravel()
    entries = csr_matrix(problem.dynamics_in_states)[rows].tocoo()
    chosen, row = np.divmod(entries.row, n)
    node, column = np.divmod(entries.col, n)
    is_end = node > problem.grid.begin[intervals[chosen]]
    blocks = np.zeros((2, len(intervals), n, n))
    blocks[is_end.astype(int), chosen, row, column] = entries.data
    return blocks


def between_samples(problem: Linearization) -> Linearization:
    """The record with its samples alone as nodes."""
    grid = problem.grid
    if grid.sample.all():
        return problem
    samples = np.flatnonzero(grid.sample)
    number = np.cumsum(grid.sample) - 1  # of the last sample, for every node
    gap = number[grid.begin]
    _, first = np.unique(gap, return_index=True)
    n_steps = np.diff(np.append(first, grid.n_intervals))
    fine = np.flatnonzero(n_steps > 1)
    over_gap = _Dynamics.of(problem, first[fine])
    for step in range(1, int(n_steps.max())):
        places = np.flatnonzero(n_steps[fine] > step)
        later = _Dynamics.of(problem, first[fine[places]] + step)
        over_gap.followed_by(places, later)
    begin = number[grid.begin[first]]
    last = first + n_steps - 1
    n = problem.n_states
    of_force = problem.force_effects[first]
    of_force[fine] = over_gap.of_force
    in_theta = problem.dynamics_in_theta.reshape(grid.n_intervals, n, -1)[first]
    in_theta[fine] = over_gap.in_theta
    offset = problem.offset.reshape(grid.n_intervals, n)[first]
    offset[fine] = over_gap.offset[:, :, 0]
    coarse = replace(
        grid,
        t=grid.t[samples],
        y=grid.y[samples],
        trajectory=grid.trajectory[samples],
        sample=grid.sample[samples],
        u=grid.u[samples],
        begin=begin,
        h=grid.t[samples][begin + 1] - grid.t[samples][begin],
        u0=grid.u0[first],
        u1=grid.u1[last],
    )
    columns = (samples[:, None] * n + np.arange(n)).ravel()
    return replace(
        problem,
        grid=coarse,
        nodes=problem.nodes[samples],
        dynamics_in_states=_in_samples(problem, columns, first, fine, over_gap),
        dynamics_in_theta=in_theta.reshape(len(begin) * n, -1),
        force_effects=of_force,
        offset=offset.ravel(),
        shown_in_states=csr_matrix(problem.shown_in_states)[:, columns],
        node=number[problem.node],
    )


def _in_samples(
    problem: Linearization,
    columns: np.ndarray,
    first: np.ndarray,
    fine: np.ndarray,
    over_gap: _Dynamics,
) -> csc_matrix:
    """Slopes of the dynamics of every gap in the states of the samples.

    Args:
        problem: with nodes between samples.
        columns: places of the samples' states.
        first: (n_gaps,) first interval of every gap.
        fine: numbers of those of several steps.
        over_gap: the dynamics of these.
    """
    n = problem.n_states
    is_fine = np.zeros(len(first), dtype=bool)
    is_fine[fine] = True
    rows = (first[:, None] * n + np.arange(n)).ravel()
    single = csr_matrix(problem.dynamics_in_states)[rows][:, columns].tocoo()
    kept = ~is_fine[single.row // n]
    begin = np.cumsum(problem.grid.sample)[problem.grid.begin[first[fine]]] - 1
    values = [single.data[kept]]
    places = [(single.row[kept], single.col[kept])]
    for slopes, node in ((over_gap.before, begin), (over_gap.after, begin + 1)):
        largest = np.max(np.abs(slopes), axis=(1, 2), keepdims=True)
        gap, row, column = np.nonzero(np.abs(slopes) > NEGLIGIBLE * largest)
        values.append(slopes[gap, row, column])
        places.append((fine[gap] * n + row, node[gap] * n + column))
    row, column = np.concatenate(places, axis=1)
    shape = (len(rows), len(columns))
    return csc_matrix(coo_matrix((np.concatenate(values), (row, column)), shape=shape))
