"""Defects between known states: functions of the parameters alone.

In symbols for a program (`known_defects`), and in numbers for all else
(`KnownDefects`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.column_function import in_columns
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    in_intervals,
    interval_arguments,
)


@dataclass(frozen=True, eq=False)
class ParameterSlopes:
    """Defects at some values of the parameters, and their slopes there.

    Attributes:
        d: (n_intervals, n_states) defects.
        slopes: (n_intervals * n_states, n_chosen), a row per interval and equation.
    """

    d: np.ndarray
    slopes: np.ndarray


def known_defects(
    model: Model, grid: Grid, scheme: str, theta: ca.MX
) -> tuple[ca.MX, ca.MX]:
    """Defects between the measurements in symbols, and their slopes.

    Args:
        model: the model.
        grid: nodes and intervals, every state measured at both ends.
        scheme: name of the integrator.
        theta: (n_free,) parameters.

    Returns:
        Defects (n_states * n_intervals,), one equation after the other, and slopes
        (n_states * n_intervals, n_free).
    """
    n_free = len(model.free)
    arguments: list[Sequence[ca.DM | ca.MX]] = []
    for rows in interval_arguments(grid, grid.y.T):
        # One number where all are alike.
        arguments.append([ca.DM(row if np.ptp(row) else row[:1]) for row in rows])
    arguments.append(ca.vertsplit(theta))
    together = _with_slopes(model, scheme, list(range(n_free)))
    d, slopes = in_columns(together, arguments)
    columns = []
    for entries in (d, *(slopes[j::n_free] for j in range(n_free))):
        filled = [_filled(entry, grid.n_intervals) for entry in entries]
        columns.append(ca.vertcat(*filled))
    return columns[0], ca.horzcat(*columns[1:])


def _filled(entry: ca.MX, n_places: int) -> ca.MX:
    """A column, where it may be one number for all places."""
    if entry.numel() == n_places:
        return entry
    return ca.MX.zeros(n_places) if entry.is_zero() else ca.repmat(entry, n_places, 1)


class KnownDefects:
    """Defects of all intervals between known states, and their slopes in parameters.

    Args:
        model: the model.
        grid: nodes and intervals.
        scheme: name of the integrator.
        x: (n_nodes, n_states) states at the nodes; None: ``grid.y``.
        only: places of the parameters in ``model.free`` that get a column, in this
            order; None: all.
        n_moving: as that of `defect`.
    """

    def __init__(
        self,
        model: Model,
        grid: Grid,
        scheme: str,
        x: np.ndarray | None = None,
        only: list[int] | None = None,
        n_moving: int | None = None,
    ) -> None:
        chosen = list(range(len(model.free))) if only is None else only
        self._function = _with_slopes(model, scheme, chosen, n_moving)
        self._n_chosen = len(chosen)
        self._grid = grid
        states = grid.y if x is None else x
        self._arguments = interval_arguments(grid, states.T)

    def at(self, theta: np.ndarray) -> ParameterSlopes:
        """Defects and slopes for parameters theta (n_free,), or (n_free, n_runs)."""
        theta = np.asarray(theta)
        d, slopes = in_intervals(self._function, self._grid, self._arguments, theta)
        return ParameterSlopes(d.T, slopes.T.reshape(d.size, self._n_chosen))


def _with_slopes(
    model: Model, scheme: str, chosen: list[int], n_moving: int | None = None
) -> ca.Function:
    """A function of one interval: its defect, and the slopes of each equation."""

    def made() -> ca.Function:
        function = defect(model, scheme, n_moving)
        arguments = argument_symbols(function)
        d = function(*arguments)
        slopes = ca.densify(ca.jacobian(d, arguments[-1])[:, chosen]).T
        return ca.Function("with_slopes", arguments, ca.cse([d, ca.vec(slopes)]))

    return model.built(("with slopes", scheme, tuple(chosen), n_moving), made)
