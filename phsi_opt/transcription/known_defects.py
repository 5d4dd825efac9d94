"""Defects between known states: functions of the parameters alone.

In symbols for a program (`known_defects`), and in numbers for all else
(`KnownDefects`).
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.column_symbols import in_columns, stacked
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import (
    argument_symbols,
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
    model: Model, grid: Grid, scheme: str, weight: float
) -> tuple[ca.Function, ca.Function]:
    """Weighted defects between the measurements, as functions of the parameters.

    Args:
        model: the model.
        grid: nodes and intervals, every state measured at both ends.
        scheme: name of the integrator.
        weight: of all defects.

    Returns:
        theta (n_free,) -> defects (n_states * n_intervals,), one equation after the
        other; and theta -> their slopes, (n_states * n_intervals, n_free).
    """
    n_free = len(model.free)
    theta = ca.MX.sym("theta", n_free)
    arguments = [_columns(one) for one in interval_arguments(grid, grid.y.T)]
    arguments.append(ca.vertsplit(theta))
    together = _with_slopes(model, scheme, list(range(n_free)))
    d, slopes = in_columns(together, arguments)
    by_parameter = []
    for j in range(n_free):
        by_parameter.append(stacked(slopes[j::n_free], grid.n_intervals))
    residual = weight * stacked(d, grid.n_intervals)
    return (
        ca.Function("defects", [theta], [residual]),
        ca.Function("slopes", [theta], [weight * ca.horzcat(*by_parameter)]),
    )


def _columns(rows: np.ndarray) -> list[ca.MX]:
    """A column of numbers for each row (n_places,), one number if all are alike."""
    return [ca.MX(ca.DM(row if np.ptp(row) else row[:1])) for row in rows]


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
