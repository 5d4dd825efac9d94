"""First and second derivatives of the defects, interval by interval.

A defect depends on the two states at its ends and on the parameters alone, so the
Jacobian of a program and the curvature of its Lagrangian are small blocks at known
places. Here the blocks are made; the losses put them where they belong.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import coo_matrix, csc_matrix

from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    argument_symbols,
    in_intervals,
    interval_arguments,
    map_intervals,
)


@dataclass(frozen=True, eq=False)
class DefectSlopes:
    """Slopes of every interval's defect in the states at its two ends.

    Attributes:
        at_begin: dd/dx0, (n_intervals, n_states, n_states).
        at_end: dd/dx1, (n_intervals, n_states, n_states).
    """

    at_begin: np.ndarray
    at_end: np.ndarray


@dataclass(frozen=True, eq=False)
class IntervalEntries:
    """Entries of a small matrix per interval that are not always zero.

    Attributes:
        values: (n_entries, n_intervals), symbols or numbers.
        places: (n_entries, 2) row and column of each entry in its matrix.
    """

    values: Any
    places: np.ndarray


def defect_slopes(
    model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray
) -> DefectSlopes:
    """Slopes of the defects in the states, as numbers.

    ``x`` is (n_nodes, n_states) and ``theta`` (n_free,).
    """
    slopes = model.built(("dense slopes", scheme), lambda: _dense_slopes(model, scheme))
    columns = interval_arguments(grid, x.T)
    at_begin, at_end = in_intervals(slopes, grid, columns, theta)
    shape = (grid.n_intervals, model.n_states, model.n_states)
    return DefectSlopes(at_begin.T.reshape(shape), at_end.T.reshape(shape))


def interval_slopes(
    model: Model, grid: Grid, scheme: str, x: Any, theta: Any, with_theta: bool
) -> IntervalEntries:
    """Slopes of every defect in (x0, x1, theta), or in (x0, x1) alone.

    ``x`` is (n_states, n_nodes), symbols or numbers; ``theta`` as that of `defects`.
    """
    one = model.built(
        ("slopes", scheme, with_theta),
        lambda: _slopes_of_one(model, scheme, with_theta),
    )
    values = map_intervals(one.entries, grid, interval_arguments(grid, x), theta)
    return IntervalEntries(values, one.places)


@dataclass(frozen=True, eq=False)
class OfOne:
    """A function of one interval or node, and the places of its entries.

    Attributes:
        entries: the function, whose last result are the entries.
        places: (n_entries, 2) row and column of each.
    """

    entries: ca.Function
    places: np.ndarray


def _dense_slopes(model: Model, scheme: str) -> ca.Function:
    """Slopes of one interval's defect in x0 and in x1, each row by row."""
    function = defect(model, scheme)
    arguments = argument_symbols(function)
    x0, x1 = arguments[:2]
    value = function(*arguments)
    in_x0 = ca.densify(ca.jacobian(value, x0).T)
    in_x1 = ca.densify(ca.jacobian(value, x1).T)
    return ca.Function("slopes", arguments, [ca.vec(in_x0), ca.vec(in_x1)])


def _slopes_of_one(model: Model, scheme: str, with_theta: bool) -> OfOne:
    function = defect(model, scheme)
    arguments = argument_symbols(function)
    x0, x1, *_, parameters = arguments
    unknowns = [x0, x1, parameters] if with_theta else [x0, x1]
    slopes = ca.jacobian(function(*arguments), ca.vertcat(*unknowns))
    entries = ca.Function("steps", arguments, [entries_of(slopes)])
    return OfOne(entries, places_of(slopes))


def linear_defect(model: Model, scheme: str) -> OfOne:
    """The defect of one interval with its slopes in (x0, x1, theta)."""
    return model.built(("linear", scheme), lambda: _linear_one(model, scheme))


def _linear_one(model: Model, scheme: str) -> OfOne:
    function = defect(model, scheme)
    arguments = argument_symbols(function)
    x0, x1, *_, parameters = arguments
    value = function(*arguments)
    slopes = ca.jacobian(value, ca.vertcat(x0, x1, parameters))
    both = ca.Function("linear", arguments, [value, entries_of(slopes)])
    return OfOne(both, places_of(slopes))


class DefectLinearization:
    """Defects of a model with their sparse slopes, made once for many points.

    Args:
        model: the model.
        scheme: name of the integrator.
    """

    def __init__(self, model: Model, scheme: str) -> None:
        self.model = model
        one = linear_defect(model, scheme)
        self._places = one.places
        self._function = one.entries

    def at(
        self, grid: Grid, x: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, csc_matrix, csc_matrix]:
        """Linearise at a point.

        Args:
            grid: nodes and intervals.
            x: (n_nodes, n_states) states.
            parameters: (n_free, n_trajectories).

        Returns:
            The defects, (n_intervals * n_states,), and sparse matrices: their slopes in
            the states, node by node, and in the parameters of every trajectory, of
            which the first n_free columns belong to the first trajectory.
        """
        columns = interval_arguments(grid, x.T)
        values, entries = in_intervals(self._function, grid, columns, parameters)
        n = self.model.n_states
        n_free, n_trajectories = parameters.shape
        rows, inner = self._places.T
        at_row = np.arange(grid.n_intervals) * n + rows[:, None]
        in_state = inner < 2 * n
        at_node = grid.begin * n + inner[in_state, None]
        in_states = coo_matrix(
            (entries[in_state].ravel(), (at_row[in_state].ravel(), at_node.ravel())),
            shape=(values.size, x.size),
        )
        first = grid.trajectory[grid.begin] * n_free
        at_parameter = first + inner[~in_state, None] - 2 * n
        of_parameters = coo_matrix(
            (
                entries[~in_state].ravel(),
                (at_row[~in_state].ravel(), at_parameter.ravel()),
            ),
            shape=(values.size, n_free * n_trajectories),
        )
        return values.T.ravel(), in_states.tocsc(), of_parameters.tocsc()


def interval_curvatures(
    model: Model, grid: Grid, scheme: str, x: Any, theta: Any, multipliers: Any
) -> IntervalEntries:
    """Second derivatives of multipliers' d in (x0, x1, theta), upper triangle.

    ``x`` is (n_states, n_nodes), ``multipliers`` (n_states, n_intervals), ``theta`` as
    that of `defects`.
    """
    one = model.built(("curvature", scheme), lambda: _curvature_of_one(model, scheme))
    columns = [*interval_arguments(grid, x), multipliers]
    values = map_intervals(one.entries, grid, columns, theta)
    return IntervalEntries(values, one.places)


def _curvature_of_one(model: Model, scheme: str) -> OfOne:
    function = defect(model, scheme)
    *given, parameters = argument_symbols(function)
    x0, x1 = given[:2]
    multiplier = ca.SX.sym("multiplier", model.n_states)
    value = ca.dot(multiplier, function(*given, parameters))
    hessian = ca.hessian(value, ca.vertcat(x0, x1, parameters))[0]
    upper = ca.triu(hessian)
    arguments = [*given, multiplier, parameters]
    entries = ca.Function("curvature", arguments, [entries_of(upper)])
    return OfOne(entries, places_of(upper))


def places_of(matrix: ca.SX) -> np.ndarray:
    """Row and column of each entry that is not always zero, (n_entries, 2)."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array([rows, columns], dtype=int).T


def entries_of(matrix: ca.SX) -> ca.SX:
    """The entries at `places_of`, as a column."""
    entries = [matrix[row, column] for row, column in places_of(matrix).tolist()]
    return ca.vertcat(ca.SX(0, 1), *entries)
