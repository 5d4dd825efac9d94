"""A linearised record with one interval between samples, however many steps it had.

Steps between samples keep the integration accurate; what acts beside the model is not
resolved by them. The linear dynamics of the steps in a gap follow one after the other
and make one step over the gap, in which a force is held.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix

from phsi_opt.model_error.linearization import Linearization


@dataclass(eq=False)
class _Transitions:
    """``x_after = A x + from_theta theta + offset + from_force w``, per interval.

    Attributes:
        A: (n, n_states, n_states).
        from_theta: (n, n_states, n_theta).
        offset: (n, n_states).
        from_force: (n, n_states, n_states), the last axis the equation of the force.
    """

    A: np.ndarray
    from_theta: np.ndarray
    offset: np.ndarray
    from_force: np.ndarray

    @classmethod
    def of(cls, problem: Linearization) -> "_Transitions":
        """Of every interval of a record."""
        n = problem.n_states
        n_intervals = problem.grid.n_intervals
        entries = csc_matrix(problem.dynamics_in_states).tocoo()
        interval = entries.row // n
        node = entries.col // n
        is_end = node > problem.grid.begin[interval]
        blocks = np.zeros((2, n_intervals, n, n))
        place = (is_end.astype(int), interval, entries.row % n, entries.col % n)
        np.add.at(blocks, place, entries.data)
        inverse = np.linalg.inv(blocks[1])
        in_theta = problem.dynamics_in_theta.reshape(n_intervals, n, -1)
        offset = problem.offset.reshape(n_intervals, n, 1)
        return cls(
            A=-inverse @ blocks[0],
            from_theta=-inverse @ in_theta,
            offset=-(inverse @ offset)[:, :, 0],
            from_force=inverse @ problem.force_effects,
        )

    def followed_by(self, places: np.ndarray, later: "_Transitions") -> None:
        """Some of these, each followed by one of ``later``."""
        A = later.A
        self.A[places] = A @ self.A[places]
        self.from_theta[places] = A @ self.from_theta[places] + later.from_theta
        moved = (A @ self.offset[places][:, :, None])[:, :, 0]
        self.offset[places] = moved + later.offset
        self.from_force[places] = A @ self.from_force[places] + later.from_force

    def chosen(self, places: np.ndarray) -> "_Transitions":
        """Those at some places."""
        return _Transitions(
            self.A[places],
            self.from_theta[places],
            self.offset[places],
            self.from_force[places],
        )


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
    steps = _Transitions.of(problem)
    over_gap = steps.chosen(first)
    for step in range(1, int(n_steps.max())):
        places = np.flatnonzero(n_steps > step)
        over_gap.followed_by(places, steps.chosen(first[places] + step))
    begin = number[grid.begin[first]]
    last = first + n_steps - 1
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
    n = problem.n_states
    columns = (samples[:, None] * n + np.arange(n)).ravel()
    return replace(
        problem,
        grid=coarse,
        nodes=problem.nodes[samples],
        dynamics_in_states=_dynamics(over_gap.A, begin, len(samples)),
        dynamics_in_theta=-over_gap.from_theta.reshape(len(begin) * n, -1),
        force_effects=over_gap.from_force,
        offset=-over_gap.offset.ravel(),
        shown_in_states=csr_matrix(problem.shown_in_states)[:, columns],
        node=number[problem.node],
    )


def _dynamics(A: np.ndarray, begin: np.ndarray, n_nodes: int) -> csc_matrix:
    """``x_after - A x`` of every interval, as a sparse matrix in the nodes' states."""
    n_intervals, n, _ = A.shape
    interval, row, column = np.indices(A.shape).reshape(3, -1)
    rows = interval * n + row
    columns = begin[interval] * n + column
    after = np.arange(n_intervals * n)
    columns_after = ((begin + 1)[:, None] * n + np.arange(n)).ravel()
    values = np.concatenate([-A.ravel(), np.ones(n_intervals * n)])
    places = (np.r_[rows, after], np.r_[columns, columns_after])
    return csc_matrix((values, places), shape=(n_intervals * n, n_nodes * n))
