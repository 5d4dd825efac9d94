"""First and second derivatives of the defects, interval by interval.

A defect depends on the two states at its ends and on the parameters alone, so the
Jacobian of a program and the curvature of its Lagrangian are small blocks at known
places. Here the blocks are made; who asks for them puts them where they belong.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    in_intervals,
    interval_arguments,
)


@dataclass(frozen=True, eq=False)
class OfOne:
    """A small matrix of one interval or node, by its entries that are not always zero.

    Attributes:
        function: whose last result are the entries, as a column.
        places: (n_entries, 2) row and column of each.
    """

    function: ca.Function
    places: np.ndarray


def linear_function(function: ca.Function, n_states: int) -> OfOne:
    """The value of a function, and its slopes in its states and parameters.

    Args:
        function: of one interval or node; its last argument are the parameters.
        n_states: number of its first arguments that are states.
    """
    arguments = argument_symbols(function)
    value = function(*arguments)
    unknowns = [*arguments[:n_states], arguments[-1]]
    slopes = ca.jacobian(value, ca.vertcat(*unknowns))
    return _of_one("linear", arguments, [value], slopes)


def linear_defect(model: Model, scheme: str) -> OfOne:
    """A defect, and its slopes in (x0, x1, theta)."""
    return model.built(
        ("linear", scheme), lambda: linear_function(defect(model, scheme), 2)
    )


def defect_curvature(model: Model, scheme: str) -> OfOne:
    """Second derivatives of multipliers'd in (x0, x1, theta), upper triangle.

    A function of the arguments of `defect`, the multipliers before the parameters.
    """
    return model.built(("curvature", scheme), lambda: _curvature(model, scheme))


def _curvature(model: Model, scheme: str) -> OfOne:
    function = defect(model, scheme)
    *given, parameters = argument_symbols(function)
    multiplier = ca.SX.sym("multiplier", model.n_states)
    value = ca.dot(multiplier, function(*given, parameters))
    hessian = ca.hessian(value, ca.vertcat(*given[:2], parameters))[0]
    arguments = [*given, multiplier, parameters]
    return _of_one("curvature", arguments, [], ca.triu(hessian))


def _of_one(
    name: str, arguments: list[ca.SX], values: list[ca.SX], matrix: ca.SX
) -> OfOne:
    rows, columns = matrix.sparsity().get_triplet()
    entries = [matrix[i, j] for i, j in zip(rows, columns, strict=True)]
    results = [*values, ca.vertcat(ca.SX(0, 1), *entries)]
    places = np.array([rows, columns], dtype=int).T
    return OfOne(ca.Function(name, arguments, results), places)


def defect_slopes(
    model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Defects (n_intervals, n_states), and their slopes in (x0, x1, theta).

    ``x`` is (n_nodes, n_states) and ``theta`` (n_free,); the slopes are
    (n_intervals, n_states, 2 n_states + n_free).
    """
    one = linear_defect(model, scheme)
    columns = interval_arguments(grid, x.T)
    d, entries = in_intervals(one.function, grid, columns, theta)
    n_states = model.n_states
    slopes = np.zeros((grid.n_intervals, n_states, 2 * n_states + len(theta)))
    slopes[:, *one.places.T] = entries.T
    return d.T, slopes
