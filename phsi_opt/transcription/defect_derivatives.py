"""First and second derivatives of the defects, interval by interval.

A defect depends on the two states at its ends and on the parameters alone, so the
Jacobian of a program and the curvature of its Lagrangian are small blocks at known
places. Here the blocks are made; the losses put them where they belong.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    argument_symbols,
    in_intervals,
    interval_arguments,
    map_intervals,
)
from phsi_opt.transcription.pattern import entries_of, entry_places


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
    return OfOne(entries, entry_places(slopes))


def linear_function(function: ca.Function, n_states: int) -> OfOne:
    """The value of a function, with its slopes in its states and parameters.

    Args:
        function: of one interval or node; its last argument are the parameters.
        n_states: number of its first arguments that are states.
    """
    arguments = argument_symbols(function)
    value = function(*arguments)
    unknowns = [*arguments[:n_states], arguments[-1]]
    slopes = ca.jacobian(value, ca.vertcat(*unknowns))
    both = ca.Function("linear", arguments, [value, entries_of(slopes)])
    return OfOne(both, entry_places(slopes))


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
    return OfOne(entries, entry_places(upper))
