"""The likelihood of `MaximumLikelihood` in numbers: values and slopes at a point.

The program of the same likelihood is for solvers that want symbols. Full steps need
numbers alone: defects and what the sensors show with their slopes, each from one small
function that is evaluated for all intervals, or nodes, together. Nothing is built but
the places of the entries, and other noise asks for no evaluation.
"""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.column_function import ColumnFunction
from phsi_opt.transcription.defect_derivatives import linear_function
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import known_arguments, node_arguments
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.pattern import Pattern
from phsi_opt.transcription.point import Point


@dataclass(frozen=True, eq=False)
class PointValues:
    """What does not depend on the noise, at a point.

    Attributes:
        g: (n_constraints,) scaled defects.
        jacobian: entries of their slopes in z.
        misfit: (n_values,) measured minus shown.
        slopes: entries of what is shown, in z.
    """

    g: np.ndarray
    jacobian: np.ndarray
    misfit: np.ndarray
    slopes: np.ndarray


class LikelihoodValues:
    """Values of a likelihood at scaled variables z: parameters, then states.

    Args:
        model: the model.
        grid: nodes, intervals and measurements.
        scheme: name of the integrator.
        point: with the sizes of the unknowns.
        unknown: the parameters in z.
    """

    def __init__(
        self, model: Model, grid: Grid, scheme: str, point: Point, unknown: Theta
    ) -> None:
        self.model = model
        self.grid = grid
        self.point = point
        self.unknown = unknown
        self.n_states = model.n_states
        self._scale = point.scale
        self._measured = np.flatnonzero(grid.measured.ravel())
        self._channel = self._measured % self.n_states
        self._y = grid.y.ravel()[self._measured]
        self._set_defects(scheme)
        self._set_shown()

    def _function(self, function: ca.Function) -> ColumnFunction:
        """Parameters of all trajectories are one column where they are shared."""
        last = function.n_in() - 1
        return ColumnFunction(function, (last,) if self.unknown.is_shared else ())

    def _of_runs(self, theta: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
        """The model's parameters, a column per interval or node unless all share one.

        Args:
            theta: (n_theta,).
            trajectory: (n,) number of each one's trajectory.
        """
        by_trajectory: np.ndarray = self.unknown.by_trajectory(theta)
        if self.unknown.is_shared:
            return by_trajectory
        return by_trajectory[:, trajectory]

    def _columns(
        self, local: np.ndarray, n_x: int, trajectory: np.ndarray
    ) -> np.ndarray:
        """Places in z of the unknowns of every interval, or node, (n, n_entries).

        Args:
            local: (n_entries,) numbers among its states and then parameters.
            n_x: number of its states.
            trajectory: (n,) number of each one's trajectory.
        """
        columns = np.empty((len(trajectory), len(local)), dtype=np.int64)
        is_state = local < n_x
        columns[:, is_state] = len(self.unknown) + local[is_state]
        table = self.unknown.table[local[~is_state] - n_x]
        columns[:, ~is_state] = table[:, trajectory].T
        return columns

    def _set_defects(self, scheme: str) -> None:
        """Places of the slopes of the defects: row by row, interval by interval."""
        grid = self.grid
        n = self.n_states
        model = self.model
        one = model.built(
            ("linear", scheme), lambda: linear_function(defect(model, scheme), 2)
        )
        equation, local = one.places.T
        is_state = local < 2 * n
        # Parameters are the first columns of z.
        self._order = np.lexsort((local, is_state, equation))
        equation, local, is_state = (
            part[self._order] for part in (equation, local, is_state)
        )
        trajectory = grid.trajectory[grid.begin]
        columns = self._columns(local, 2 * n, trajectory)
        columns[:, is_state] += n * grid.begin[:, None]
        rows = n * np.arange(grid.n_intervals)[:, None] + equation
        shape = (n * grid.n_intervals, len(self._scale))
        self.jacobian = Pattern(rows.ravel(), columns.ravel(), shape)
        self._per_size = grid.h[:, None] / self.point.x_scale
        self._factor = self._per_size[:, equation] * self._scale[columns]
        self._defect = self._function(one.entries)
        self._known = known_arguments(grid)

    def _set_shown(self) -> None:
        """Places of the slopes of what is shown, a row per measured value."""
        n_values = len(self._measured)
        n = self.n_states
        shape = (n_values, len(self._scale))
        first = len(self.unknown)
        if not self.model.sensor:
            self.shown = Pattern(np.arange(n_values), first + self._measured, shape)
            self._sensor = None
            return
        model = self.model
        one = model.built("linear output", lambda: linear_function(model.output(), 1))
        channel, local = one.places.T
        columns = self._columns(local, n, self.grid.trajectory)
        columns[:, local < n] += n * np.arange(self.grid.n_nodes)[:, None]
        is_shown = self.grid.measured[:, channel]
        row = np.zeros(self.grid.measured.size, dtype=np.int64)
        row[self._measured] = np.arange(n_values)
        rows = row.reshape(self.grid.measured.shape)[:, channel]
        self._is_shown = is_shown
        self.shown = Pattern(rows[is_shown], columns[is_shown], shape)
        self._sensor = self._function(one.entries)

    def at(self, z: np.ndarray) -> PointValues:
        """Defects and what is shown, with their slopes, at z (n_variables,)."""
        grid = self.grid
        n = self.n_states
        values = z * self._scale
        theta = values[self.point.of_theta]
        x = values[self.point.of_x].reshape(-1, n)
        states = [x[grid.begin].T, x[grid.begin + 1].T]
        of_intervals = self._of_runs(theta, grid.trajectory[grid.begin])
        d, entries = self._defect(*states, *self._known, of_intervals)
        misfit, slopes = self._misfit(x, theta)
        return PointValues(
            g=(d.T * self._per_size).ravel(),
            jacobian=(entries[self._order].T * self._factor).ravel(),
            misfit=misfit,
            slopes=slopes * self._scale[self.shown.columns],
        )

    def _misfit(
        self, x: np.ndarray, theta: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Measured minus shown (n_values,), and unscaled slopes of what is shown."""
        if self._sensor is None:
            return self._y - x.ravel()[self._measured], np.ones(len(self._y))
        of_nodes = self._of_runs(theta, self.grid.trajectory)
        shown, entries = self._sensor(*node_arguments(self.grid, x.T), of_nodes)
        return self._y - shown.T.ravel()[self._measured], entries.T[self._is_shown]

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower bounds of z, (n_variables,)."""
        bounds = self.point.x_bounds
        of_states = np.full(self.point.x.size, -np.inf)
        if bounds is not None:
            of_states = bounds.lower.ravel()
        return np.concatenate([self.unknown.lower, of_states]) / self._scale

    @cached_property
    def upper(self) -> np.ndarray:
        """Upper bounds of z, (n_variables,)."""
        bounds = self.point.x_bounds
        of_states = np.full(self.point.x.size, np.inf)
        if bounds is not None:
            of_states = bounds.upper.ravel()
        return np.concatenate([self.unknown.upper, of_states]) / self._scale
