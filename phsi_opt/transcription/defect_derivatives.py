"""Slopes of functions of one interval, or node, in its states and parameters."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    argument_symbols,
    in_intervals,
    interval_arguments,
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
