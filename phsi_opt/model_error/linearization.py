"""A likelihood linearised at one point: slopes of dynamics and sensors.

::

    residual of a value   r - C x - C_theta theta - v
    dynamics              J x + J_theta theta + offset = B w

for changes x of the states and theta of the parameters, forces w that the model does
not know, and errors v of sensors. States and parameters are in the scale of the program
that was solved, forces in the unit of a rate of their state.

Data and dynamics together are one set of linear equations: the data are r and, below
them, -offset; so a force adds -B w to them where a sensor's error adds v.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags

from phsi_opt.model.structure import forced_rows
from phsi_opt.model_error.disturbances import (
    LINEAR_SHARE,
    Disturbances,
    Whitener,
    smooth_functions,
)
from phsi_opt.optimization.banded import Banded, BandLayout, Passage, neighbours_first
from phsi_opt.statistics import stretches
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.likelihood_values import LikelihoodValues, PointValues


@dataclass(frozen=True, eq=False)
class Site:
    """Where a process acts, and what it does to data and dynamics."""

    # (n,) node of each of its values; half way between two for a force.
    place: np.ndarray
    t: np.ndarray  # (n,) times
    trajectory: np.ndarray  # (n,) numbers of the trajectories
    effects: csc_matrix  # sparse, (n_values + n_intervals * n_states, n), on the data

    def whitener(self, time: float) -> Whitener:
        return Whitener.of(self.t, self.trajectory, time)


@dataclass(frozen=True, eq=False)
class Curvature:
    """Second derivatives of the dynamics times their multipliers."""

    of_states: coo_matrix  # sparse, in the states alone, upper triangle
    mixed: np.ndarray  # (n_nodes * n_states, n_theta), in states and parameters
    of_theta: np.ndarray  # (n_theta, n_theta), in the parameters alone


@dataclass(frozen=True, eq=False)
class Linearization:
    """A likelihood linearised at a point."""

    grid: Grid  # nodes and intervals
    nodes: np.ndarray  # (n_nodes, n_states) states of the solution
    dynamics_in_states: Any  # J, sparse, (n_intervals * n_states, n_nodes * n_states)
    dynamics_in_theta: np.ndarray  # J_theta, (n_intervals * n_states, n_theta)
    # B, sparse, a column per (interval, equation): what a force of one does to the
    # dynamics.
    force_effects: csc_matrix
    # Of the dynamics at the solution, (n_intervals * n_states,); zero where it obeys
    # the model.
    offset: np.ndarray
    shown_in_states: Any  # C, sparse, (n_values, n_nodes * n_states)
    shown_in_theta: np.ndarray  # C_theta, (n_values, n_theta)
    residual: np.ndarray  # r, measured minus shown, (n_values,)
    x_scale: np.ndarray  # (n_states,) scale of the states
    theta_scale: np.ndarray  # (n_theta,) scale of the parameters
    forced: tuple[int, ...]  # equations that can lack a force
    # Numbers of states that functions may depend on: not the memories.
    observed: tuple[int, ...]
    # (2, n_theta) way to the means of the parameters' priors, and their information.
    prior: np.ndarray
    # (n_nodes, n_states) states along which functions of them are taken; None: those of
    # the solution.
    along: np.ndarray | None = None
    # Of their linear part that functions of states keep.
    linear_share: float = LINEAR_SHARE
    # Of the dynamics; None: it is left out (Gauss and Newton).
    curvature: Curvature | None = None
    # (n_intervals * n_states,) variance by which the dynamics may fail to hold, that of
    # a white force; None: they hold.
    softness: np.ndarray | None = None
    # (n_theta,) slope of a further term of the log likelihood; None: there is none.
    tilt: np.ndarray | None = None

    @property
    def n_states(self) -> int:
        return len(self.x_scale)

    @property
    def n_theta(self) -> int:
        return len(self.theta_scale)

    @property
    def n_values(self) -> int:
        return len(self.residual)

    @property
    def middles(self) -> np.ndarray:
        """Times of the middles of the intervals, (n_intervals,)."""
        grid = self.grid
        middles: np.ndarray = grid.t[grid.begin] + grid.h / 2
        return middles

    def of_values(self, sigma: np.ndarray) -> np.ndarray:
        """Of noise (n_trajectories, n_states) that of every measured value."""
        return np.asarray(sigma[self.grid.run_of_value, self.grid.channel])

    @cached_property
    def log_volume(self) -> float:
        """What slopes and scales of the states add to a log evidence.

        States are integrated out given dynamics that hold, d(x) = 0. They follow from
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
        return log_slopes + len(self.grid.starts) * np.sum(np.log(self.x_scale))

    # --- Disturbances

    def sites(self, disturbances: Disturbances) -> list[Site]:
        """Where processes act, forces first."""
        sites = [self.site_of_force(force.place) for force in disturbances.forces]
        for sensor in disturbances.sensors:
            sites.append(self.site_of_sensor(sensor.place))
        return sites

    def site_of_force(self, equation: int) -> Site:
        """Of a force in an equation: it is held over each interval."""
        grid = self.grid
        own = self.force_effects[:, equation :: self.n_states].tocoo()
        row = self.n_values + own.row
        effects = self._effects(-own.data, row, own.col, grid.n_intervals)
        return Site(grid.begin + 0.5, self.middles, grid.runs, effects)

    def site_of_sensor(self, channel: int) -> Site:
        """Of errors of the sensor of one state: one for each of its values."""
        grid = self.grid
        values = np.flatnonzero(grid.channel == channel)
        node = grid.node[values]
        n = len(values)
        effects = self._effects(np.ones(n), values, np.arange(n), n)
        return Site(node.astype(float), grid.t[node], grid.trajectory[node], effects)

    def _effects(
        self, entries: np.ndarray, row: np.ndarray, column: np.ndarray, n: int
    ) -> csc_matrix:
        shape = (self.n_values + len(self.offset), n)
        return csc_matrix((entries, (row, column)), shape=shape)

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
        of_force = self.force_effects[:, equation :: self.n_states]
        return np.asarray(-(of_force @ self.function_values[state]))

    # --- Parts of a record

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
        length = max(int(np.ceil(self.grid.n_nodes / n_pieces)), 1)
        runs = self.grid.trajectory
        n_of_run = np.round(np.bincount(runs) / length)
        numbers = stretches(runs, np.maximum(n_of_run, 1).astype(int))
        chosen = np.where(numbers % stride == 0, numbers, -1)
        kept, first = np.unique(chosen, return_index=True)
        return self.cut(chosen), runs[first[kept >= 0]]

    def cut(self, piece: np.ndarray) -> "Linearization":
        """The same record in pieces, each of them a trajectory of its own.

        Args:
            piece: (n_nodes,) number of the piece of every node, not decreasing;
                negative: left out.
        """
        grid = self.grid
        same = piece[grid.begin] == piece[grid.begin + 1]
        intervals = np.flatnonzero(same & (piece[grid.begin] >= 0))
        nodes = np.flatnonzero(piece >= 0)
        number = np.cumsum(piece >= 0) - 1
        values = np.flatnonzero(piece[grid.node] >= 0)
        of_state = np.arange(self.n_states)
        rows = (intervals[:, None] * self.n_states + of_state).ravel()
        columns = (nodes[:, None] * self.n_states + of_state).ravel()
        _, trajectory = np.unique(piece[nodes], return_inverse=True)
        shorter = grid.at_nodes(
            nodes,
            begin=number[grid.begin[intervals]],
            h=grid.h[intervals],
            u0=grid.u0[intervals],
            u1=grid.u1[intervals],
        )
        dynamics = csr_matrix(self.dynamics_in_states)[rows][:, columns]
        return replace(
            self,
            grid=replace(shorter, trajectory=trajectory),
            nodes=self.nodes[nodes],
            along=None if self.along is None else self.along[nodes],
            dynamics_in_states=csc_matrix(dynamics),
            dynamics_in_theta=self.dynamics_in_theta[rows],
            force_effects=self.force_effects[:, rows][rows],
            offset=self.offset[rows],
            shown_in_states=csr_matrix(self.shown_in_states)[values][:, columns],
            shown_in_theta=self.shown_in_theta[values],
            residual=self.residual[values],
        )

    def between_samples(self) -> "Linearization":
        """The record with one interval between samples, however many steps it had.

        Steps between samples keep the integration accurate; disturbances are not
        resolved by them. The linear dynamics of the steps in a gap follow one after the
        other and make one step over the gap, in which a force is held.
        """
        grid = self.grid
        if grid.sample.all():
            return self
        n = self.n_states
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
        slopes = csr_matrix(self.dynamics_in_states)
        passage = Passage(slopes, grid.begin, grid.sample, n)
        effects = self.force_effects.tocoo()
        gap = np.cumsum(is_first) - 1
        interval, equation = np.divmod(effects.col, n)
        held = csr_matrix(
            (effects.data, (effects.row, gap[interval] * n + equation)),
            shape=(effects.shape[0], coarse.n_intervals * n),
        )
        return replace(
            self,
            grid=coarse,
            nodes=self.nodes[samples],
            dynamics_in_states=csc_matrix(passage.slopes()),
            dynamics_in_theta=passage.over(self.dynamics_in_theta),
            force_effects=csc_matrix(passage.over_blocks(held)),
            offset=passage.over(self.offset[:, None]).ravel(),
            shown_in_states=csr_matrix(self.shown_in_states)[:, passage.samples],
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
        states = enumerate(model.states)
        self._observed = tuple(k for k, name in states if name not in model.memory)
        self._forced = forced_rows(model)
        # A force enters its own equation, times the length of the interval.
        lengths = grid.h[:, None] / point.x_scale
        self._effects = csc_matrix(diags(lengths.ravel()))

    def at(self, z: np.ndarray, known: PointValues | None = None) -> Linearization:
        """The likelihood linearised at a point.

        Args:
            z: (n_variables,) scaled parameters and states.
            known: what the values are there; None: they are worked out.
        """
        point = self.values.point
        known = known or self.values.at(z)
        mean, information = self.values.prior
        return Linearization(
            grid=self.values.grid,
            nodes=point.unscaled(z)["x"],
            dynamics_in_states=self._dynamics.sparse(known.jacobian),
            dynamics_in_theta=self._dynamics_in_theta.dense(known.jacobian),
            force_effects=self._effects,
            offset=known.g,
            shown_in_states=csr_matrix(self._shown.sparse(known.slopes)),
            shown_in_theta=self._shown_in_theta.dense(known.slopes),
            residual=known.misfit,
            x_scale=point.x_scale,
            theta_scale=point.theta_scale,
            forced=self._forced,
            prior=np.array([mean - z[: len(mean)], information]),
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
