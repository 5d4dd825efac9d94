"""Defects: the residuals of the model's equations over every interval of a grid.

The defect of an interval is (x1 - x0)/h - Psi(g; x0, x1), where g is the right-hand
side of the model and Psi the mean derivative of a scheme (`integrators`). Every loss is
made from them. A defect depends on the two states at its ends and on the parameters
alone, so its derivatives are small blocks, one per interval.

A function of one interval (or node) is evaluated for all of them together, numbers and
symbols alike (`optimization.column_function`). Here the rows (n_nodes, n_states) of the
data meet CasADi's columns (n_states, n_nodes).
"""

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols, with_slopes
from phsi_opt.optimization.column_function import in_columns, in_numbers
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import integrator

# ---- functions of one interval, or node, for all of them


def interval_arguments(grid: Grid, x: Any) -> list[Any]:
    """x0, x1, t0, h, u0 and u1 of every interval, as columns.

    The states x (n_states, n_nodes) are symbols or numbers.
    """
    x0 = x[:, _places(grid.begin, x)]
    x1 = x[:, _places(grid.begin + 1, x)]
    t0 = grid.t[grid.begin]
    return [x0, x1, t0[None, :], grid.h[None, :], grid.u0.T, grid.u1.T]


def _places(numbers: np.ndarray, values: Any) -> Any:
    """Numbers of columns as these values are indexed: CasADi takes lists."""
    return numbers if isinstance(values, np.ndarray) else numbers.tolist()


def _of_each(theta: Any, trajectory: np.ndarray) -> Any:
    """Parameters theta, a column per interval or node unless all share one."""
    is_shared = len(theta.shape) < 2 or theta.shape[1] == 1
    return theta if is_shared else theta[:, _places(trajectory, theta)]


def in_intervals(
    function: ca.Function, grid: Grid, x: np.ndarray, theta: np.ndarray, *more: Any
) -> list[np.ndarray]:
    """A function of an interval in all: entries of its results, (n_entries, n).

    Its arguments are those of `defect`: of states x (n_nodes, n_states), ``more``
    numbers (n_rows, n_intervals), and parameters theta, (n_free,) or (n_free,
    n_trajectories), of which every interval has those of its trajectory.
    """
    own = _of_each(theta, grid.runs)
    own = own.ravel() if own is theta else own
    return in_numbers(function, *interval_arguments(grid, x.T), *more, own)


def at_nodes(
    function: ca.Function, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> list[np.ndarray]:
    """The same of a function of (x, u, t, theta) at every node."""
    own = _of_each(theta, grid.trajectory)
    own = own.ravel() if own is theta else own
    return in_numbers(function, x.T, grid.u.T, grid.t[None, :], own)


def with_matrices(results: list[np.ndarray]) -> list[np.ndarray]:
    """Values (n, n_rows) of a function `with_slopes`, and slopes (n, n_rows, n_of).

    From the entries that `in_intervals` or `at_nodes` have of it.
    """
    values, *slopes = results
    n_rows, n = values.shape
    return [values.T, *(one.T.reshape(n, n_rows, len(one) // n_rows) for one in slopes)]


def symbols_in_intervals(
    function: ca.Function, grid: Grid, x: Any, theta: ca.MX, *more: ca.MX
) -> list[ca.MX]:
    """`in_intervals` in symbols: of every result a row per interval.

    States x are (n_states, n_nodes), symbols or numbers.
    """
    arguments = [*interval_arguments(grid, x), *more, _of_each(theta, grid.runs)]
    return in_columns(function, list(map(_columns, arguments)), grid.n_intervals)


def symbols_at_nodes(
    function: ca.Function, grid: Grid, x: ca.MX, theta: ca.MX
) -> list[ca.MX]:
    """`at_nodes` in symbols: of every result a row per node."""
    arguments = [x, grid.u.T, grid.t[None, :], _of_each(theta, grid.trajectory)]
    return in_columns(function, list(map(_columns, arguments)), grid.n_nodes)


def _columns(rows: Any) -> list[Any]:
    """Every row of an argument as a column; one number where all are alike."""
    if isinstance(rows, np.ndarray):
        return [ca.DM(row if np.ptp(row) else row[:1]) for row in rows]
    return ca.horzsplit(rows.T)


# ---- defects


def interval_symbols(model: Model) -> list[ca.SX]:
    """Of one interval: start, length, inputs at both ends, parameters."""
    sizes = {"t0": 1, "h": 1, "u0": model.n_inputs, "u1": model.n_inputs}
    symbols = [ca.SX.sym(name, size) for name, size in sizes.items()]
    return [*symbols, ca.SX.sym("theta", len(model.free))]


def rates_within(rhs: ca.Function, interval: list[ca.SX], x: Any, share: Any) -> Any:
    """Right-hand side at state x, at a share of the interval."""
    t0, h, u0, u1, theta = interval
    return rhs(x, u0 + share * (u1 - u0), t0 + share * h, theta)


def defect(model: Model, scheme: str, n_moving: int | None = None) -> ca.Function:
    """CasADi function of one interval, (x0, x1, t0, h, u0, u1, theta) -> defect d.

    ::

        d = (x1 - x0)/h - Psi(g; x0, x1)

    Only the first ``n_moving`` states move along the interval; None: all.

    Raises:
        ModelError: there is no integrator of that name.
    """
    key = ("defect", scheme, n_moving)
    return model.built(key, lambda: _defect(model, scheme, n_moving))


def _defect(model: Model, scheme: str, n_moving: int | None) -> ca.Function:
    n_states = model.n_states
    rhs = model.rhs()
    psi = integrator(scheme).psi
    x0 = ca.SX.sym("x0", n_states)
    x1 = ca.SX.sym("x1", n_states)
    interval = interval_symbols(model)

    def g(x: Any, share: float) -> Any:
        rates = rates_within(rhs, interval, x, share)
        if n_moving is None:
            return rates
        return ca.vertcat(rates[:n_moving], ca.SX.zeros(n_states - n_moving))

    h = interval[1]
    value = (x1 - x0) / h - psi(g, x0, x1, h)
    names = ["x0", "x1", "t0", "h", "u0", "u1", "theta"]
    arguments = [x0, x1, *interval]
    return ca.Function("defect", arguments, [ca.densify(value)], names, ["d"])


# ---- their derivatives in the states and parameters


class SparseSlopes(NamedTuple):
    """A matrix of slopes of one interval or node, by its entries that are not zero."""

    function: ca.Function  # whose last result are the entries, as a column
    places: np.ndarray  # (n_entries, 2) row and column of each


def linear_function(function: ca.Function, n_states: int) -> SparseSlopes:
    """The value of a function, and its slopes in its states and parameters.

    Of one interval or node: its first ``n_states`` arguments are states, its last one
    the parameters.
    """
    arguments = argument_symbols(function)
    value = function(*arguments)
    unknowns = [*arguments[:n_states], arguments[-1]]
    return _sparse(arguments, [value], ca.jacobian(value, ca.vertcat(*unknowns)))


def linear_defect(model: Model, scheme: str) -> SparseSlopes:
    """A defect, and its slopes in (x0, x1, theta)."""
    return model.built(
        ("linear", scheme), lambda: linear_function(defect(model, scheme), 2)
    )


def defect_curvature(model: Model, scheme: str) -> SparseSlopes:
    """Second derivatives of multipliers'd in (x0, x1, theta), upper triangle.

    A function of the arguments of `defect`, the multipliers before the parameters.
    """

    def make() -> SparseSlopes:
        function = defect(model, scheme)
        *given, parameters = argument_symbols(function)
        multiplier = ca.SX.sym("multiplier", model.n_states)
        value = ca.dot(multiplier, function(*given, parameters))
        hessian = ca.hessian(value, ca.vertcat(*given[:2], parameters))[0]
        return _sparse([*given, multiplier, parameters], [], ca.triu(hessian))

    return model.built(("curvature", scheme), make)


def _sparse(arguments: list[ca.SX], values: list[ca.SX], matrix: ca.SX) -> SparseSlopes:
    rows, columns = matrix.sparsity().get_triplet()
    entries = [matrix[i, j] for i, j in zip(rows, columns, strict=True)]
    results = [*values, ca.vertcat(ca.SX(0, 1), *entries)]
    places = np.array([rows, columns], dtype=int).T
    return SparseSlopes(ca.Function("sparse", arguments, results), places)


def defect_slopes(
    model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray
) -> list[np.ndarray]:
    """Defects (n_intervals, n_states), and their slopes in x0, in x1 and in theta.

    ``x`` is (n_nodes, n_states) and ``theta`` (n_free,); slopes are (n_intervals,
    n_states, n) each.
    """
    function = model.built(
        ("slopes", scheme),
        lambda: with_slopes(defect(model, scheme), "x0", "x1", "theta"),
    )
    return with_matrices(in_intervals(function, grid.driven(model, theta), x, theta))


# ---- between known states, as functions of the parameters alone


class ParameterSlopes(NamedTuple):
    """Defects at some values of the parameters, and their slopes there."""

    d: np.ndarray  # (n_intervals, n_states) defects
    # (n_intervals * n_states, n_chosen), a row per interval and equation.
    slopes: np.ndarray


def parameter_slopes(
    model: Model,
    grid: Grid,
    scheme: str,
    theta: np.ndarray,
    x: np.ndarray | None = None,
    only: list[int] | None = None,
    n_moving: int | None = None,
) -> ParameterSlopes:
    """Defects of all intervals between known states, and their slopes in parameters.

    Args:
        model: the model.
        grid: nodes and intervals.
        scheme: name of the integrator.
        theta: parameters, (n_free,) or (n_free, n_trajectories).
        x: (n_nodes, n_states) states at the nodes; None: ``grid.y``.
        only: places of the parameters in ``model.free`` that get a column, in this
            order; None: all.
        n_moving: as that of `defect`.
    """
    chosen = list(range(len(model.free))) if only is None else only
    function = _with_slopes(model, scheme, chosen, n_moving)
    grid = grid.driven(model, theta)
    d, slopes = in_intervals(function, grid, grid.y if x is None else x, theta)
    by_equation = slopes.reshape(len(chosen), *d.shape)
    return ParameterSlopes(d.T, by_equation.T.reshape(d.size, len(chosen)))


def known_defects(
    model: Model, grid: Grid, scheme: str, theta: ca.MX
) -> tuple[ca.MX, ca.MX]:
    """Defects between the measurements in symbols, and their slopes in theta (n_free,).

    Every state is measured at both ends of the intervals. Defects are (n_states *
    n_intervals,), one equation after the other; slopes have a column per parameter.
    """
    n_free = len(model.free)
    together = _with_slopes(model, scheme, list(range(n_free)))
    d, slopes = symbols_in_intervals(together, grid, grid.y.T, theta)
    return ca.vec(d), ca.reshape(slopes, d.numel(), n_free)


def _with_slopes(
    model: Model, scheme: str, chosen: list[int], n_moving: int | None = None
) -> ca.Function:
    """A function of one interval: its defect, and its slopes, one after the other."""

    def make() -> ca.Function:
        function = defect(model, scheme, n_moving)
        arguments = argument_symbols(function)
        d = function(*arguments)
        slopes = ca.densify(ca.jacobian(d, arguments[-1])[:, chosen])
        return ca.Function("with_slopes", arguments, ca.cse([d, ca.vec(slopes)]))

    return model.built(("with slopes", scheme, tuple(chosen), n_moving), make)


# ---- integration along an interval


def local_errors(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Error of one step of the scheme: exact end minus state at the end.

    For states x (n_nodes, n_states) that obey the scheme. The exact end of an interval
    is found by eight steps of RK4 from its beginning; (n_intervals, n_states),
    NaN where it leaves the range of numbers.
    """
    return _ends(model, grid, x, theta) - x[grid.begin + 1]


def integration_errors(
    model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Defects that exact solutions from states x have, (n_intervals, n_states).

    Zero where the exact end leaves the range of numbers.
    """
    x0, _, *interval = interval_arguments(grid.driven(model, theta), x.T)
    ends = _ends(model, grid, x, theta).T
    own = _of_each(theta, grid.runs)
    (d,) = in_numbers(defect(model, scheme), x0, ends, *interval, own)
    return np.where(np.isfinite(d.T), d.T, 0.0)


def between_samples(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """States at all nodes, those between samples as the model goes on from a sample.

    So the model is violated at the ends of gaps alone: a straight line would cut the
    corners of dry friction, and a search that begins there does not come back. A state
    that the model would carry further than it ever moves stays.
    """
    if grid.sample.all():
        return x
    place = np.arange(grid.n_nodes)
    behind = place - np.maximum.accumulate(np.where(grid.sample, place, 0))
    reach = np.ptp(x, axis=0)
    nodes = np.empty((grid.n_nodes, x.shape[1]))
    nodes[grid.sample] = x
    for n_behind in range(1, int(behind.max()) + 1):
        own = grid.intervals(np.flatnonzero(behind[grid.begin + 1] == n_behind))
        begins = nodes[own.begin]
        ends = _ends(model, own, nodes, theta)
        is_near = np.abs(ends - begins) <= reach
        nodes[own.begin + 1] = np.where(is_near, ends, begins)
    return nodes


def _ends(model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """The exact ends of intervals that begin at states x, (n_intervals, n_states)."""
    exact = model.built("exact", lambda: _fine_integration(model))
    (ends,) = in_intervals(exact, grid.driven(model, theta), x, theta)
    return ends.T


def _fine_integration(model: Model, n_steps: int = 8) -> ca.Function:
    """CasADi function of an interval -> x at its end; arguments as of `defect`."""
    rhs = model.rhs()
    psi = integrator("rk4").psi
    x0 = ca.SX.sym("x0", model.n_states)
    n_done = ca.SX.sym("n_done")
    interval = interval_symbols(model)
    h_fine = interval[1] / n_steps

    def g(at: Any, c: float) -> Any:
        return rates_within(rhs, interval, at, (n_done + c) / n_steps)

    after = x0 + h_fine * psi(g, x0, x0, h_fine)
    step = ca.Function("step", [x0, n_done, *interval], [after])
    x = x0
    for k in range(n_steps):
        x = step(x, k, *interval)
    x1 = ca.SX.sym("x1", model.n_states)  # which does not count
    return ca.Function("exact", [x0, x1, *interval], [x])
