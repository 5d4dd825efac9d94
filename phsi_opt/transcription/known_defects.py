"""Defects of known states in numbers: a function of the parameters alone."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.column_function import ColumnFunction
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import argument_symbols, interval_arguments


@dataclass(frozen=True, eq=False)
class ParameterSlopes:
    """Defects at some values of the parameters, and their slopes there.

    Attributes:
        d: (n_intervals, n_states) defects.
        slopes: (n_intervals * n_states, n_chosen), a row per interval and equation.
    """

    d: np.ndarray
    slopes: np.ndarray


class KnownDefects:
    """Defects of all intervals between known states, and their slopes in parameters.

    Args:
        model: the model.
        grid: nodes and intervals.
        scheme: name of the integrator.
        x: (n_nodes, n_states) states at the nodes; None: ``grid.y``.
        only: places of the parameters in ``model.free`` that get a column, in this
            order; None: all.
    """

    def __init__(
        self,
        model: Model,
        grid: Grid,
        scheme: str,
        x: np.ndarray | None = None,
        only: list[int] | None = None,
    ) -> None:
        chosen = list(range(len(model.free))) if only is None else only
        together = model.built(
            ("with slopes", scheme, tuple(chosen)),
            lambda: _with_slopes(model, scheme, chosen),
        )
        self._n_chosen = len(chosen)
        self._function = ColumnFunction(together, (together.n_in() - 1,))
        states = grid.y if x is None else x
        self._arguments = interval_arguments(grid, states.T)

    def at(self, theta: np.ndarray) -> ParameterSlopes:
        """Defects and slopes for parameters theta (n_free,)."""
        d, slopes = self._function(*self._arguments, np.asarray(theta))
        return ParameterSlopes(d.T, slopes.T.reshape(d.size, self._n_chosen))

    def residual_at(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Defects (n_defects,) and slopes (n_defects, n_chosen), for a program."""
        found = self.at(theta)
        return found.d.ravel(), found.slopes


def _with_slopes(model: Model, scheme: str, chosen: list[int]) -> ca.Function:
    """A function of one interval: its defect, and the slopes of each equation."""
    function = defect(model, scheme)
    arguments = argument_symbols(function)
    d = function(*arguments)
    slopes = ca.densify(ca.jacobian(d, arguments[-1])[:, chosen]).T
    return ca.Function("with_slopes", arguments, [d, ca.vec(slopes)])
