"""The likelihood of `MaximumLikelihood` in numbers: values and slopes at a point.

Full steps need numbers alone: defects and the output of the sensors with their slopes,
each from one small function that is evaluated for all intervals, or nodes, together.
Nothing is built but the places of the entries, and other noise asks for no evaluation.
The program of the same likelihood is for solvers that want symbols (`losses`).
"""

from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy

from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import (
    at_nodes,
    defect_curvature,
    in_intervals,
    linear_defect,
    linear_function,
    symbols_in_intervals,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Point, Theta


class Pattern(NamedTuple):
    """Where entries of a sparse matrix stand, while their values come and go."""

    rows: np.ndarray  # (n_entries,); entries at one place are added
    columns: np.ndarray  # (n_entries,)
    shape: tuple[int, int]  # of the matrix
    # Of the values that are given, those of the entries; all by default.
    chosen: np.ndarray | slice = slice(None)

    def part(self, columns: slice) -> "Pattern":
        """The same of a range of columns; the values of all are given as before."""
        own = (self.columns >= columns.start) & (self.columns < columns.stop)
        shape = (self.shape[0], columns.stop - columns.start)
        shifted = self.columns[own] - columns.start
        return Pattern(self.rows[own], shifted, shape, np.flatnonzero(own))

    def sparse(self, values: np.ndarray) -> "scipy.sparse.coo_matrix":
        """The matrix with values (n_values,) of the whole pattern."""
        own = (values[self.chosen], (self.rows, self.columns))
        return scipy.sparse.coo_matrix(own, shape=self.shape)

    def dense(self, values: np.ndarray) -> np.ndarray:
        """The same as an array."""
        n_rows, n_columns = self.shape
        places = self.rows * n_columns + self.columns
        filled = np.bincount(places, values[self.chosen], n_rows * n_columns)
        return filled.reshape(self.shape)


class PointValues(NamedTuple):
    """Everything at a point that does not depend on the noise."""

    g: np.ndarray  # (n_constraints,) scaled defects
    jacobian: np.ndarray  # entries of their slopes in z
    misfit: np.ndarray  # (n_values,) measured minus output of the sensors
    slopes: np.ndarray  # entries of the slopes of that output, in z


class LikelihoodValues:
    """Values of a likelihood at scaled variables z: parameters, then states.

    A constraint is the defect times the interval's length over the state's size: an
    error of the state in units of its size, comparable between equations and between
    lengths.

    Args:
        model: the model.
        grid: nodes, intervals and measurements.
        scheme: name of the integrator.
        point: with the sizes of the unknowns.
        unknown: the parameters in z.

    Attributes:
        scale: sizes of the variables, (n_variables,).
        lower: bounds of z, (n_variables,); upper: likewise.
        per_size: (n_intervals, n_states) length over the state's size.
        prior: (2, n_theta) mean and information of the scaled parameters' priors.
        jacobian: places of the slopes of the constraints, interval by interval.
        shown: places of the slopes of the sensors' output, a row per measured value.
    """

    def __init__(
        self, model: Model, grid: Grid, scheme: str, point: Point, unknown: Theta
    ) -> None:
        self.model = model
        # For symbols, delayed inputs are linear in the delay beside that of the point.
        self.grid = grid.driven(model, unknown.by_trajectory(point.theta))
        self.scheme = scheme
        self.point = point
        self.unknown = unknown
        self.n_states = model.n_states
        self.scale = point.scale
        x_bounds = np.broadcast_to(point.x_bounds, (2, *point.x.shape)).reshape(2, -1)
        bounds = np.hstack([[unknown.lower, unknown.upper], x_bounds]) / self.scale
        self.lower, self.upper = bounds
        sizes = point.theta_scale
        self.prior = unknown.priors * np.array([1 / sizes, sizes**2])
        self._measured = np.flatnonzero(grid.measured.ravel())
        self._y = grid.y.ravel()[self._measured]
        self._set_defects()
        self._set_shown()

    def __reduce__(self) -> tuple[Any, ...]:  # made anew where it travels to
        own = (self.model, self.grid, self.scheme, self.point, self.unknown)
        return LikelihoodValues, own

    def places(self, node: np.ndarray, n_nodes: int) -> np.ndarray:
        """Places in z of the states at nodes (n,) and the next ones, and of parameters.

        (n, n_nodes * n_states + n_free) for ``n_nodes`` that follow each other.
        """
        first = len(self.unknown) + self.n_states * node[:, None]
        states = first + np.arange(n_nodes * self.n_states)
        return np.hstack([states, self.unknown.table.T[self.grid.trajectory[node]]])

    def _set_defects(self) -> None:
        grid = self.grid
        n = self.n_states
        self._defect, places = linear_defect(self.model, self.scheme)
        equation, local = places.T
        columns = self.places(grid.begin, 2)[:, local]
        rows = n * np.arange(grid.n_intervals)[:, None] + equation
        shape = (n * grid.n_intervals, len(self.scale))
        self.jacobian = Pattern(rows.ravel(), columns.ravel(), shape)
        self.per_size = grid.h[:, None] / self.point.x_scale
        self._factor = self.per_size[:, equation] * self.scale[columns]

    def _set_shown(self) -> None:
        model = self.model
        shape = (len(self._measured), len(self.scale))
        self._sensor, places = model.built(
            "linear output", lambda: linear_function(model.output(), 1)
        )
        channel, local = places.T
        columns = self.places(np.arange(self.grid.n_nodes), 1)[:, local]
        row = np.cumsum(self.grid.measured).reshape(self.grid.measured.shape) - 1
        self._is_shown = self.grid.measured[:, channel]
        rows = row[:, channel][self._is_shown]
        self.shown = Pattern(rows, columns[self._is_shown], shape)

    def _unscaled(self, z: np.ndarray) -> tuple[np.ndarray, Any]:
        """States (n_nodes, n_states), and the parameters of every trajectory."""
        values = self.point.unscaled(z)
        return values["x"], self.unknown.by_trajectory(values["theta"])

    def at(self, z: np.ndarray) -> PointValues:
        """Defects and output of the sensors, with their slopes, at z (n_variables,)."""
        x, theta = self._unscaled(z)
        grid = self.grid.driven(self.model, theta)
        d, entries = in_intervals(self._defect, grid, x, theta)
        shown, of_shown = at_nodes(self._sensor, grid, x, theta)
        return PointValues(
            g=(d.T * self.per_size).ravel(),
            jacobian=(entries.T * self._factor).ravel(),
            misfit=self._y - shown.T.ravel()[self._measured],
            slopes=of_shown.T[self._is_shown] * self.scale[self.shown.columns],
        )

    @cached_property
    def curvature(self) -> Pattern:
        """Places of the second derivatives of the defects, upper triangle of z's."""
        local = defect_curvature(self.model, self.scheme).places
        places = self.places(self.grid.begin, 2)[:, local].reshape(-1, 2)
        row, column = np.sort(places, axis=1).T
        return Pattern(row, column, (len(self.scale), len(self.scale)))

    def curvature_in_symbols(self, x: ca.MX, theta: ca.MX, multipliers: ca.MX) -> ca.MX:
        """The same in symbols, as an upper triangle; of states (n_states, n_nodes)."""
        function = defect_curvature(self.model, self.scheme).function
        sizes = ca.DM(self.per_size.T)
        weighted = ca.reshape(multipliers, self.n_states, -1) * sizes
        (entries,) = symbols_in_intervals(function, self.grid, x, theta, weighted)
        pattern = self.curvature
        n = len(self.scale)
        # Entries at one place are added, column by column as CasADi has them.
        places, owner = np.unique(
            pattern.columns * n + pattern.rows, return_inverse=True
        )
        scale = self.scale[pattern.rows] * self.scale[pattern.columns]
        shape = (len(places), len(owner))
        added = scipy.sparse.csc_matrix((scale, (owner, np.arange(len(owner)))), shape)
        columns, rows = np.divmod(places, n)
        where = ca.Sparsity.triplet(n, n, rows.tolist(), columns.tolist())
        return ca.MX(where, ca.DM(added) @ ca.vec(entries.T))

    def curvature_at(self, z: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Second derivatives of multipliers'g at z, entries of `curvature`.

        ``multipliers`` (n_constraints,) are those of the scaled defects.
        """
        x, theta = self._unscaled(z)
        weighted = multipliers.reshape(-1, self.n_states) * self.per_size
        grid = self.grid.driven(self.model, theta)
        function = defect_curvature(self.model, self.scheme).function
        (entries,) = in_intervals(function, grid, x, theta, weighted.T)
        pattern = self.curvature
        sizes = self.scale[pattern.rows] * self.scale[pattern.columns]
        return entries.T.ravel() * sizes
