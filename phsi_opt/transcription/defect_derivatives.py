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
from phsi_opt.optimization.evaluated import Evaluated
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    argument_symbols,
    in_intervals,
    interval_arguments,
    map_intervals,
    mapped,
    mapped_parameters,
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
    return OfOne(both, entry_places(slopes))


class DefectLinearization:
    """Defects of a model with their slopes, made once for many points of a grid.

    Args:
        model: the model.
        scheme: name of the integrator.
        grid: nodes and intervals.
        n_trajectories: of the parameters.

    Attributes:
        places: (n_entries, 2) equation and unknown of each slope that is not always
            zero, among (x0, x1, theta).
    """

    def __init__(
        self, model: Model, scheme: str, grid: Grid, n_trajectories: int
    ) -> None:
        one = linear_defect(model, scheme)
        self.places = one.places
        is_shared = n_trajectories == 1
        self._evaluated = Evaluated(mapped(one.entries, grid.n_intervals, is_shared))
        self._begin = grid.begin
        self._trajectory = grid.trajectory[grid.begin]
        self._given = [grid.t[grid.begin], grid.h, grid.u0.ravel(), grid.u1.ravel()]

    def at(
        self, x: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linearise at states (n_nodes, n_states).

        Args:
            x: the states.
            parameters: (n_free, n_trajectories).

        Returns:
            The defects, (n_intervals, n_states), and the slopes, (n_intervals,
            n_entries). They are written over by the next call.
        """
        ends = x[self._begin].ravel(), x[self._begin + 1].ravel()
        theta = mapped_parameters(parameters, self._trajectory)
        values, entries = self._evaluated(*ends, *self._given, theta)
        return values, entries


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
