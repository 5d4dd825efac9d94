"""An estimate's likelihood linearised at its solution: slopes of dynamics and sensors.

::

    shown residual   r - C x - C_theta theta
    dynamics         J x + J_theta theta + offset = B w

for changes x of the states, theta of the parameters, and forces w that the model does
not know. States and parameters are in the scale of the program that was solved, forces
in the unit of a rate of their state.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags

from phsi_opt.model.structure import forced_rows
from phsi_opt.model_error.disturbances import LINEAR_SHARE, smooth_functions
from phsi_opt.optimization.banded import Banded, BandLayout, Passage, neighbours_first
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.likelihood_values import LikelihoodValues, PointValues


@dataclass(frozen=True, eq=False)
class ForceEffects:
    """What a force of one in each equation does to the dynamics of its interval.

    Attributes:
        matrix: sparse, a column per (interval, equation).
        n_states: number of states, and equations.
    """

    matrix: csc_matrix
    n_states: int

    def of(self, equation: int) -> csc_matrix:
        """B of one equation, (n_intervals * n_states, n_intervals)."""
        if equation not in self._asked:
            self._asked[equation] = self.matrix[:, equation :: self.n_states]
        return self._asked[equation]

    @cached_property
    def _asked(self) -> dict[int, csc_matrix]:
        """Those of the equations asked for: a search asks hundreds of times."""
        return {}


@dataclass(frozen=True, eq=False)
class Curvature:
    """Second derivatives of the dynamics times their multipliers.

    Attributes:
        of_states: sparse, in the states alone, upper triangle.
        mixed: (n_nodes * n_states, n_theta), in states and parameters.
        of_theta: (n_theta, n_theta), in the parameters alone.
    """

    of_states: coo_matrix
    mixed: np.ndarray
    of_theta: np.ndarray


@dataclass(frozen=True, eq=False)
class Linearization:
    """A likelihood linearised at a solution.

    Attributes:
        grid: nodes and intervals.
        nodes: (n_nodes, n_states) states of the solution.
        dynamics_in_states: J, sparse, (n_intervals * n_states, n_nodes * n_states).
        dynamics_in_theta: J_theta, (n_intervals * n_states, n_theta).
        shown_in_states: C, sparse, (n_values, n_nodes * n_states).
        shown_in_theta: C_theta, (n_values, n_theta).
        force_effects: what a force in each equation does to the dynamics.
        offset: of the dynamics at the solution, (n_intervals * n_states,); zero where
            it obeys the model.
        residual: r, measured minus shown, (n_values,).
        node: (n_values,) node of every measured value.
        channel: (n_values,) its state.
        x_scale: (n_states,) scale of the states.
        theta_scale: (n_theta,) scale of the parameters.
        forced: equations that can lack a force.
        observed: numbers of states that functions may depend on: not the memories.
        along: (n_nodes, n_states) states along which functions of them are taken; None:
            those of the solution.
        linear_share: of their linear part that functions of states keep.
        curvature: of the dynamics; None: it is left out, as by Gauss and Newton.
        tilt: (n_theta,) slope of a log likelihood that acts beside; None: none does.
    """

    grid: Grid
    nodes: np.ndarray
    dynamics_in_states: Any
    dynamics_in_theta: np.ndarray
    force_effects: ForceEffects
    offset: np.ndarray
    shown_in_states: Any
    shown_in_theta: np.ndarray
    residual: np.ndarray
    node: np.ndarray
    channel: np.ndarray
    x_scale: np.ndarray
    theta_scale: np.ndarray
    forced: tuple[int, ...]
    observed: tuple[int, ...]
    along: np.ndarray | None = None
    linear_share: float = LINEAR_SHARE
    curvature: Curvature | None = None
    tilt: np.ndarray | None = None

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.x_scale)

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return len(self.theta_scale)

    @property
    def slope(self) -> np.ndarray:
        """`tilt`, (n_theta,)."""
        return np.zeros(self.n_theta) if self.tilt is None else self.tilt

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return len(self.residual)

    @property
    def noise_freedom(self) -> np.ndarray:
        """Degrees of freedom where noise is all there is, (n_theta,)."""
        return np.full(self.n_theta, max(float(self.n_values - self.n_theta), 1.0))

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories."""
        return self.grid.n_trajectories

    @cached_property
    def middles(self) -> np.ndarray:
        """Times of the middles of the intervals, (n_intervals,)."""
        grid = self.grid
        middles: np.ndarray = grid.t[grid.begin] + grid.h / 2
        return middles

    @cached_property
    def log_volume(self) -> float:
        """What slopes and scales of the states add to a log evidence.

        States are integrated out behind dynamics that hold, d(x) = 0. They follow from
        the starting states, whose flat prior is in their own units, so the slopes of d
        in the states at the ends of the intervals have to be divided out.

        Raises:
            SolveError: an interval's end does not follow from its begin.
        """
        n = self.n_states
        slopes = coo_matrix(self.dynamics_in_states)
        interval, row = np.divmod(slopes.row, n)
        node, column = np.divmod(slopes.col, n)
        at_end = node == self.grid.begin[interval] + 1
        interval, row, column = interval[at_end], row[at_end], column[at_end]
        order = neighbours_first(row, column, n)
        first = n * np.arange(self.grid.n_intervals)[:, None]
        layout = BandLayout(
            interval * n + row, interval * n + column, (first + order).ravel()
        )
        log_slopes = Banded(layout, slopes.data[at_end]).log_abs_det
        return log_slopes + self.n_trajectories * float(np.sum(np.log(self.x_scale)))

    def effect_of_force(self, equation: int) -> np.ndarray:
        """B: what a force of one does to the dynamics, (n_intervals, n_states)."""
        effect = coo_matrix(self.dynamics_of_force(equation))
        dense = np.zeros((self.grid.n_intervals, self.n_states))
        dense[effect.col, effect.row % self.n_states] = effect.data
        return dense

    def dynamics_of_force(self, equation: int) -> csc_matrix:
        """B as a sparse matrix, (n_intervals * n_states, n_intervals)."""
        return self.force_effects.of(equation)

    def values_of(self, channel: int) -> np.ndarray:
        """Places of the measured values of one state."""
        return np.flatnonzero(self.channel == channel)

    @property
    def states_of_functions(self) -> np.ndarray:
        """States along which functions of them are taken, (n_nodes, n_states)."""
        return self.nodes if self.along is None else self.along

    @cached_property
    def function_values(self) -> dict[int, np.ndarray]:
        """Values of the smooth functions of every state, (n_intervals, n_functions)."""
        begin = self.grid.begin
        nodes = self.states_of_functions
        middles = (nodes[begin] + nodes[begin + 1]) / 2
        found = {}
        for state in self.observed:
            found[state] = smooth_functions(middles[:, state], self.linear_share)
        return found

    def dynamics_of_function(self, equation: int, state: int) -> np.ndarray:
        """What functions of a state do to the dynamics, as J_theta does."""
        values = self.function_values[state]
        effect = self.effect_of_force(equation)
        columns = -effect[:, :, None] * values[:, None, :]
        return columns.reshape(effect.size, -1)

    def piece_numbers(self, n_pieces: int) -> np.ndarray:
        """Number of the piece of every node when the record is cut evenly, (n_nodes,).

        Every trajectory is cut into pieces of about an equal number of nodes.
        """
        length = max(int(np.ceil(self.grid.n_nodes / n_pieces)), 1)
        numbers = np.zeros(self.grid.n_nodes, dtype=int)
        first = 0
        for begin, end in self.grid.spans:
            n_of_run = max(round((end - begin) / length), 1)
            place = np.arange(end - begin) * n_of_run // (end - begin)
            numbers[begin:end] = first + place
            first += n_of_run
        return numbers

    def evenly_spread(self) -> "tuple[Linearization, np.ndarray] | None":
        """Evenly spread pieces of a long record, and the trajectory of each.

        None where it is short. Each piece is a trajectory of its own.
        """
        n_intervals = self.grid.n_intervals
        most_intervals = min(1_500, 13_500 / self.n_states)
        if n_intervals <= 1.5 * most_intervals:
            return None
        per_sample = max(n_intervals / max(int(self.grid.sample.sum()), 1), 1.0)
        most = most_intervals * per_sample**0.5
        n_pieces = max(int(n_intervals / (250 * per_sample)), 2)  # of 250 samples
        stride = max(round(n_intervals / most), 2)
        numbers = self.piece_numbers(n_pieces)
        chosen = np.where(numbers % stride == 0, numbers, -1)
        kept, first = np.unique(chosen, return_index=True)
        return self.cut(chosen), self.grid.trajectory[first[kept >= 0]]

    def cut(self, piece: np.ndarray) -> "Linearization":
        """The same record in pieces, each of them a trajectory of its own.

        Args:
            piece: (n_nodes,) number of the piece of every node, not decreasing;
                negative: left out.
        """
        grid = self.grid
        same = piece[grid.begin] == piece[grid.begin + 1]
        intervals = np.flatnonzero(same & (piece[grid.begin] >= 0))
        kept_nodes = np.flatnonzero(piece >= 0)
        new_number = np.cumsum(piece >= 0) - 1
        values = np.flatnonzero(piece[self.node] >= 0)
        places = intervals[:, None] * self.n_states + np.arange(self.n_states)
        rows = places.ravel()
        columns = (
            kept_nodes[:, None] * self.n_states + np.arange(self.n_states)
        ).ravel()
        _, trajectory = np.unique(piece[kept_nodes], return_inverse=True)
        shorter = grid.at_nodes(
            kept_nodes,
            begin=new_number[grid.begin[intervals]],
            h=grid.h[intervals],
            u0=grid.u0[intervals],
            u1=grid.u1[intervals],
        )
        shorter = replace(shorter, trajectory=trajectory)
        dynamics = csc_matrix(csr_matrix(self.dynamics_in_states)[rows][:, columns])
        shown = csr_matrix(self.shown_in_states)[values][:, columns]
        return replace(
            self,
            grid=shorter,
            nodes=self.nodes[kept_nodes],
            along=None if self.along is None else self.along[kept_nodes],
            dynamics_in_states=dynamics,
            dynamics_in_theta=self.dynamics_in_theta[rows],
            force_effects=ForceEffects(
                self.force_effects.matrix[:, rows][rows], self.n_states
            ),
            offset=self.offset[rows],
            shown_in_states=shown,
            shown_in_theta=self.shown_in_theta[values],
            residual=self.residual[values],
            node=new_number[self.node[values]],
            channel=self.channel[values],
        )


class Linearizer:
    """Linearises one likelihood at point after point, whose patterns stay.

    Attributes:
        values: of the likelihood.
    """

    def __init__(self, values: LikelihoodValues) -> None:
        grid, model, point = values.grid, values.model, values.point
        self.values = values
        self._dynamics = values.jacobian.part(point.of_x)
        self._dynamics_in_theta = values.jacobian.part(point.of_theta)
        self._shown = values.shown.part(point.of_x)
        self._shown_in_theta = values.shown.part(point.of_theta)
        self._measured = np.flatnonzero(grid.measured.ravel())
        memory = model.memory
        states = enumerate(model.states)
        self._observed = tuple(k for k, name in states if name not in memory)
        self._forced = forced_rows(model)
        # A force enters its own equation, times the length of the interval.
        lengths = grid.h[:, None] / point.x_scale
        self._effects = ForceEffects(csc_matrix(diags(lengths.ravel())), model.n_states)

    def at(self, z: np.ndarray, known: PointValues) -> Linearization:
        """The likelihood linearised at a point.

        Args:
            z: (n_variables,) scaled parameters and states.
            known: what the values are there.
        """
        values = self.values
        point = values.point
        n_states = values.n_states
        return Linearization(
            grid=values.grid,
            nodes=point.unscaled(z)["x"].reshape(-1, n_states),
            dynamics_in_states=self._dynamics.sparse(known.jacobian),
            dynamics_in_theta=self._dynamics_in_theta.dense(known.jacobian),
            force_effects=self._effects,
            offset=known.g,
            shown_in_states=csr_matrix(self._shown.sparse(known.slopes)),
            shown_in_theta=self._shown_in_theta.dense(known.slopes),
            residual=known.misfit,
            node=self._measured // n_states,
            channel=self._measured % n_states,
            x_scale=point.x_scale,
            theta_scale=point.theta_scale,
            forced=self._forced,
            observed=self._observed,
        )

    def curvature(self, z: np.ndarray, multipliers: np.ndarray) -> Curvature:
        """Second derivatives of multipliers'g at a point.

        Args:
            z: (n_variables,) scaled parameters and states.
            multipliers: (n_constraints,) of the dynamics.
        """
        values = self.values
        entries = values.curvature_at(z, multipliers)
        upper = csr_matrix(values.curvature.sparse(entries))
        n = len(values.unknown)  # the first columns of z
        of_theta = upper[:n, :n].toarray()
        return Curvature(
            of_states=coo_matrix(upper[n:, n:]),
            mixed=upper[:n, n:].toarray().T,
            of_theta=of_theta + np.triu(of_theta, 1).T,
        )


def linearized(
    values: LikelihoodValues, z: np.ndarray, known: PointValues
) -> Linearization:
    """A likelihood linearised at one point.

    Args:
        values: of the likelihood.
        z: (n_variables,) scaled parameters and states.
        known: what the values are there.
    """
    return Linearizer(values).at(z, known)


def between_samples(problem: Linearization) -> Linearization:
    """The record with its samples alone as nodes."""
    grid = problem.grid
    if grid.sample.all():
        return problem
    samples = np.flatnonzero(grid.sample)
    number = np.cumsum(grid.sample) - 1  # of the last sample, for every node
    is_first = grid.sample[grid.begin]
    begin = number[grid.begin[is_first]]
    coarse = grid.at_nodes(
        samples,
        begin=begin,
        h=grid.t[samples][begin + 1] - grid.t[samples][begin],
        u0=grid.u0[is_first],
        u1=grid.u1[grid.sample[grid.begin + 1]],
    )
    passage = _passage(problem)
    offset = passage.over(problem.offset[:, None])
    effects = csc_matrix(passage.over_blocks(_held(problem)))
    return replace(
        problem,
        grid=coarse,
        nodes=problem.nodes[samples],
        dynamics_in_states=csc_matrix(passage.slopes()),
        dynamics_in_theta=passage.over(problem.dynamics_in_theta),
        force_effects=ForceEffects(effects, problem.n_states),
        offset=offset.ravel(),
        shown_in_states=csr_matrix(problem.shown_in_states)[:, passage.samples],
        node=number[problem.node],
    )


def _passage(problem: Linearization) -> Passage:
    slopes = csr_matrix(problem.dynamics_in_states)
    touching = slopes.tocoo()
    n = problem.n_states
    order = neighbours_first(touching.row % n, touching.col % n, n)
    grid = problem.grid
    return Passage(slopes, grid.begin, grid.sample, np.argsort(order))


def _held(problem: Linearization) -> csr_matrix:
    """What forces do that are held over each gap, (n_intervals * n_states, ...)."""
    grid = problem.grid
    n = problem.n_states
    gap = np.cumsum(grid.sample[grid.begin]) - 1
    effects = coo_matrix(problem.force_effects.matrix)
    interval, equation = np.divmod(effects.col, n)
    places = (effects.row, gap[interval] * n + equation)
    shape = (effects.shape[0], (gap[-1] + 1) * n)
    return csr_matrix((effects.data, places), shape=shape)
