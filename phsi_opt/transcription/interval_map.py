"""One function in every interval, or at every node, of a grid.

CasADi maps a function over columns: differentiated and compiled once, called as often
as there are intervals. Here, and in `defects`, the rows (n_nodes, n_states) of the data
meet CasADi's columns (n_states, n_nodes).
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.optimization.column_function import ColumnFunction
from phsi_opt.transcription.grid import Grid

# Mapped functions that are kept: those of one model and its next neighbours. Each
# takes some memory per interval.
MOST_KEPT = 32


def argument_symbols(function: ca.Function) -> list[ca.SX]:
    """A column of symbols for every argument of a function, named as there."""
    return [
        ca.SX.sym(function.name_in(i), function.size1_in(i))
        for i in range(function.n_in())
    ]


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
    shape = theta.shape if hasattr(theta, "shape") else np.shape(theta)
    n_intervals = len(grid.begin)
    if len(shape) < 2 or shape[1] == 1:
        return mapped(function, n_intervals, True)(*arguments, theta)
    by_interval = theta[:, grid.trajectory[grid.begin].tolist()]
    return mapped(function, n_intervals, False)(*arguments, by_interval)


def in_intervals(
    function: ca.Function, grid: Grid, arguments: list[Any], theta: np.ndarray
) -> list[np.ndarray]:
    """`map_intervals` in numbers: entries of every result, (n_entries, n_intervals)."""
    last = function.n_in() - 1
    if theta.ndim < 2 or theta.shape[1] == 1:
        shared = theta.reshape(len(theta))
        return ColumnFunction(function, (last,))(*arguments, shared)
    by_interval = theta[:, grid.trajectory[grid.begin]]
    return ColumnFunction(function)(*arguments, by_interval)


def at_nodes(
    function: ca.Function, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> list[np.ndarray]:
    """`map_nodes` in numbers: entries of every result, (n_entries, n_nodes)."""
    nodes = replace(grid, begin=np.arange(grid.n_nodes))
    return in_intervals(function, nodes, node_arguments(grid, x), theta)


@lru_cache(MOST_KEPT)
def mapped(function: ca.Function, n: int, is_shared: bool) -> ca.Function:
    """The function in n columns; the last argument may be one and the same for all."""
    if is_shared:
        return function.map("mapped", "serial", n, [function.n_in() - 1], [])
    return function.map(n, "serial")


def node_arguments(grid: Grid, x: Any) -> list[Any]:
    """x, u and t of every node, as columns; ``x`` is (n_states, n_nodes)."""
    return [x, grid.u.T, grid.t[None, :]]


def map_nodes(function: ca.Function, grid: Grid, x: Any, theta: Any) -> Any:
    """A function of (x, u, t, theta) at every node; ``x`` is (n_states, n_nodes)."""
    nodes = replace(grid, begin=np.arange(grid.n_nodes))
    return map_intervals(function, nodes, node_arguments(grid, x), theta)
