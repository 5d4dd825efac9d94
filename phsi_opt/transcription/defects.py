"""TODO."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import integrator

FINE = 8  # steps of the integration that checks one step of a scheme


@dataclass(frozen=True, eq=False)
class DefectSlopes:
    """Slopes of every interval's defect in the states at its two ends.

    Attributes:
        at_begin: dd/dx0, (n_intervals, n_states, n_states).
        at_end: dd/dx1, (n_intervals, n_states, n_states).
    """

    at_begin: np.ndarray
    at_end: np.ndarray


def defect(model: Model, scheme: str, n_moving: int | None = None) -> ca.Function:
    """CasADi function (x0, x1, t0, h, u0, u1, theta) -> (x1 - x0)/h - Psi, the defect
    of one interval.

    ``n_moving``: only the first so many states move along the interval; the others keep
    what x0 and x1 say.
    """
    n, m, rhs, psi = model.n_states, model.n_inputs, model.rhs(), integrator(scheme).psi
    x0, x1, theta = (
        ca.SX.sym("x0", n),
        ca.SX.sym("x1", n),
        ca.SX.sym("theta", len(model.free)),
    )
    t0, h, u0, u1 = (
        ca.SX.sym("t0"),
        ca.SX.sym("h"),
        ca.SX.sym("u0", m),
        ca.SX.sym("u1", m),
    )

    def g(x: Any, c: float) -> Any:
        rates = rhs(x, u0 + c * (u1 - u0), t0 + c * h, theta)
        return (
            rates
            if n_moving is None
            else ca.vertcat(rates[:n_moving], ca.SX.zeros(n - n_moving))
        )

    value = (x1 - x0) / h - psi(g, x0, x1, h)
    names = ["x0", "x1", "t0", "h", "u0", "u1", "theta"]
    return ca.Function(
        "defect", [x0, x1, t0, h, u0, u1, theta], [ca.densify(value)], names, ["d"]
    )


def defects(
    model: Model,
    grid: Grid,
    scheme: str,
    x: Any,
    theta: Any,
    n_moving: int | None = None,
) -> Any:
    """Defects of all intervals, (n_states, n_intervals); x is (n_states, n_nodes),
    symbolic or numbers.

    theta is (n_free,), or (n_free, n_trajectories) where trajectories have parameters
    of their own.
    """
    return map_intervals(
        defect(model, scheme, n_moving), grid, _columns(grid, x), theta
    )


def defect_function(
    model: Model,
    grid: Grid,
    scheme: str,
    n_columns: int = 1,
    n_moving: int | None = None,
) -> ca.Function:
    """Function (x, theta) -> `defects`, for many evaluations; theta has ``n_columns``
    (see `defect_jacobian`).
    """
    x, theta = (
        ca.MX.sym("x", model.n_states, grid.n_nodes),
        ca.MX.sym("theta", len(model.free), n_columns),
    )
    return ca.Function(
        "defects", [x, theta], [defects(model, grid, scheme, x, theta, n_moving)]
    )


def defect_jacobian(
    model: Model,
    grid: Grid,
    scheme: str,
    only: list[int] | None = None,
    n_columns: int = 1,
    n_moving: int | None = None,
) -> ca.Function:
    """Function (x, theta) -> dd/dtheta: a row per (interval, equation), a column per
    parameter (or of ``only``).

    theta has ``n_columns``: one, or as many as trajectories that have parameters of
    their own.
    """
    one = defect(model, scheme, n_moving)
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    chosen = list(range(len(model.free))) if only is None else only
    jacobian = ca.densify(ca.jacobian(one(*arguments), arguments[-1])[:, chosen])
    per_interval = ca.Function("row", arguments, [ca.vec(jacobian.T)])
    x, theta = (
        ca.MX.sym("x", model.n_states, grid.n_nodes),
        ca.MX.sym("theta", len(model.free), n_columns),
    )
    rows = map_intervals(per_interval, grid, _columns(grid, x), theta)
    return ca.Function(
        "jacobian",
        [x, theta],
        [ca.reshape(rows, len(chosen), model.n_states * grid.n_intervals).T],
    )


def defect_slopes(
    model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray
) -> DefectSlopes:
    """dd/dx0 and dd/dx1 of every interval, each (n_intervals, n_states, n_states)."""
    one, n = defect(model, scheme), model.n_states
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    value = one(*arguments)
    slopes = [ca.vec(ca.densify(ca.jacobian(value, end).T)) for end in arguments[:2]]
    mapped = _mapped(ca.Function("slopes", arguments, slopes), grid)(
        *_columns(grid, ca.DM(x.T)), theta
    )
    at_begin, at_end = mapped
    shape = (grid.n_intervals, n, n)
    return DefectSlopes(
        np.array(at_begin).T.reshape(shape), np.array(at_end).T.reshape(shape)
    )


def defect_curvature(model: Model, scheme: str) -> tuple[ca.Function, np.ndarray]:
    """CasADi function (x0, x1, t0, h, u0, u1, multiplier, theta) -> second derivatives
    of multiplier' defect.

    They are those of the upper triangle in (x0, x1, theta) that are not always zero, as
    a column; the array (n, 2) says which row and column each of them is.
    """
    one = defect(model, scheme)
    *ends, theta = (
        ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())
    )
    multiplier = ca.SX.sym("multiplier", model.n_states)
    value = ca.dot(multiplier, one(*ends, theta))
    hessian = ca.triu(ca.hessian(value, ca.vertcat(ends[0], ends[1], theta))[0])
    rows, columns = hessian.sparsity().get_triplet()
    entries = ca.vertcat(
        ca.SX(0, 1), *(hessian[i, j] for i, j in zip(rows, columns, strict=True))
    )
    return ca.Function("curvature", [*ends, multiplier, theta], [entries]), np.array(
        [rows, columns], dtype=int
    ).T


def defect_steps(
    model: Model, scheme: str, with_theta: bool
) -> tuple[ca.Function, np.ndarray]:
    """CasADi function (x0, x1, t0, h, u0, u1, theta) -> first derivatives of the
    defect, and where they stand.

    They are those in (x0, x1, theta), or in (x0, x1) alone, that are not always zero,
    as a column; the array (n, 2) holds the row and column of each.
    """
    one = defect(model, scheme)
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    along = ca.vertcat(
        arguments[0], arguments[1], *(arguments[-1:] if with_theta else [])
    )
    slopes = ca.jacobian(one(*arguments), along)
    rows, columns = slopes.sparsity().get_triplet()
    entries = ca.vertcat(
        ca.SX(0, 1), *(slopes[i, j] for i, j in zip(rows, columns, strict=True))
    )
    return ca.Function("steps", arguments, [entries]), np.array(
        [rows, columns], dtype=int
    ).T


def interval_slopes(
    model: Model, grid: Grid, scheme: str, x: Any, theta: Any, with_theta: bool
) -> tuple[Any, np.ndarray]:
    """`defect_steps` in every interval, (n, n_intervals)."""
    one, places = defect_steps(model, scheme, with_theta)
    return map_intervals(one, grid, _columns(grid, x), theta), places


def interval_curvatures(
    model: Model, grid: Grid, scheme: str, x: Any, theta: Any, multiplier: Any
) -> tuple[Any, np.ndarray]:
    """`defect_curvature` in every interval, (n, n_intervals), for multipliers
    (n_states, n_intervals).
    """
    one, places = defect_curvature(model, scheme)
    return map_intervals(one, grid, [*_columns(grid, x), multiplier], theta), places


def local_errors(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """What one step of the scheme misses of the exact solution, (n_intervals,
    n_states), for states on the scheme.

    The exact end of an interval is found by `FINE` steps of RK4 from its beginning. NaN
    where they leave the range.
    """
    rhs, psi, n, m = model.rhs(), integrator("rk4").psi, model.n_states, model.n_inputs
    x0, all_of = ca.SX.sym("x0", n), ca.SX.sym("theta", len(model.free))
    t0, h, u0, u1 = (
        ca.SX.sym("t0"),
        ca.SX.sym("h"),
        ca.SX.sym("u0", m),
        ca.SX.sym("u1", m),
    )
    at = x0
    for k in range(FINE):

        def g(x: Any, c: float, done: int = k) -> Any:
            share = (done + c) / FINE
            return rhs(x, u0 + share * (u1 - u0), t0 + share * h, all_of)

        at = at + h / FINE * psi(g, at, at, h / FINE)
    exact = ca.Function("exact", [x0, t0, h, u0, u1, all_of], [at])
    columns = _columns(grid, ca.DM(x.T))
    ends = map_intervals(exact, grid, [columns[0], *columns[2:]], theta)
    return np.array(ends).T - x[grid.begin + 1]


def map_intervals(one: ca.Function, grid: Grid, columns: list[Any], theta: Any) -> Any:
    """The function in every interval (or node) with the parameters of its trajectory."""
    shape = theta.shape if hasattr(theta, "shape") else np.shape(theta)
    if len(shape) < 2 or shape[1] == 1:
        return _mapped(one, grid)(*columns, theta)
    each = theta[:, grid.trajectory[grid.begin].tolist()]
    return one.map(len(grid.begin), "serial")(*columns, each)


def _mapped(per_interval: ca.Function, grid: Grid) -> ca.Function:
    # theta (the last argument) is one and the same for all intervals.
    return per_interval.map(
        "mapped", "serial", len(grid.begin), [per_interval.n_in() - 1], []
    )


def _columns(grid: Grid, x: Any) -> list[Any]:
    begin = grid.begin.tolist()
    ends = [i + 1 for i in begin]
    return [
        x[:, begin],
        x[:, ends],
        grid.t[grid.begin][None, :],
        grid.h[None, :],
        grid.u0.T,
        grid.u1.T,
    ]
