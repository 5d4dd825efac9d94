"""One function in every interval, or at every node, of a grid.

CasADi maps a function over columns: differentiated and compiled once, called as often
as there are intervals. Here, and in `defects`, the rows (n_nodes, n_states) of the data
meet CasADi's columns (n_states, n_nodes).
"""

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.optimization.column_function import ColumnFunction
from phsi_opt.transcription.grid import Grid


def interval_arguments(grid: Grid, x: Any) -> list[Any]:
    """x0, x1, t0, h, u0 and u1 of every interval, as columns.

    Args:
        grid: nodes and intervals.
        x: (n_states, n_nodes) states, symbols or numbers.
    """
    begin: Any = grid.begin
    end: Any = grid.begin + 1
    if not isinstance(x, np.ndarray):  # CasADi takes lists of places
        begin, end = begin.tolist(), end.tolist()
    return [x[:, begin], x[:, end], *known_arguments(grid)]


def known_arguments(grid: Grid) -> list[np.ndarray]:
    """t0, h, u0 and u1 of every interval, (n_rows, n_intervals) each."""
    t0 = grid.t[grid.begin]
    return [t0[None, :], grid.h[None, :], grid.u0.T, grid.u1.T]


def _of_each(theta: Any, trajectory: np.ndarray) -> tuple[Any, bool]:
    """Parameters theta, a column per interval or node unless all share one.

    And whether they do.
    """
    shape = theta.shape if hasattr(theta, "shape") else np.shape(theta)
    if len(shape) < 2 or shape[1] == 1:
        return theta, True
    places: Any = trajectory
    if not isinstance(theta, np.ndarray):  # CasADi takes lists of places
        places = trajectory.tolist()
    return theta[:, places], False


def map_intervals(
    function: ca.Function, grid: Grid, arguments: list[Any], theta: Any
) -> Any:
    """The function in every interval with the parameters of its trajectory.

    Args:
        function: its last argument are the parameters.
        grid: nodes and intervals.
        arguments: the other arguments, a column per interval.
        theta: (n_free,) parameters, or (n_free, n_trajectories).
    """
    own, is_shared = _of_each(theta, grid.runs)
    return mapped(function, grid.n_intervals, is_shared)(*arguments, own)


def map_nodes(function: ca.Function, grid: Grid, x: Any, theta: Any) -> Any:
    """A function of (x, u, t, theta) at every node; ``x`` is (n_states, n_nodes)."""
    own, is_shared = _of_each(theta, grid.trajectory)
    arguments = node_arguments(grid, x)
    return mapped(function, grid.n_nodes, is_shared)(*arguments, own)


@lru_cache(32)  # of one model and its next neighbours; each takes some memory
def mapped(function: ca.Function, n: int, is_shared: bool) -> ca.Function:
    """The function in n columns; the last argument may be one and the same for all."""
    if is_shared:
        return function.map("mapped", "serial", n, [function.n_in() - 1], [])
    return function.map(n, "serial")


def in_intervals(
    function: ca.Function, grid: Grid, arguments: list[Any], theta: np.ndarray
) -> list[np.ndarray]:
    """`map_intervals` in numbers: entries of every result, (n_entries, n_intervals)."""
    return _in_columns(function, arguments, theta, grid.runs)


def at_nodes(
    function: ca.Function, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> list[np.ndarray]:
    """`map_nodes` in numbers: entries of every result, (n_entries, n_nodes)."""
    arguments = node_arguments(grid, x)
    return _in_columns(function, arguments, theta, grid.trajectory)


def _in_columns(
    function: ca.Function,
    arguments: list[Any],
    theta: np.ndarray,
    trajectory: np.ndarray,
) -> list[np.ndarray]:
    own, is_shared = _of_each(theta, trajectory)
    if not is_shared:
        return ColumnFunction(function)(*arguments, own)
    last = function.n_in() - 1
    return ColumnFunction(function, (last,))(*arguments, own.ravel())


def node_arguments(grid: Grid, x: Any) -> list[Any]:
    """x, u and t of every node, as columns; ``x`` is (n_states, n_nodes)."""
    return [x, grid.u.T, grid.t[None, :]]
