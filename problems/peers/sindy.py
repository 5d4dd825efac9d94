"""SINDy on the same measurements: sparse regression of rates on a dictionary.

The dictionary is the model's own, so each equation may have a different one (thesis
Section 4.2). SINDy is a regression: it learns coefficients that enter linearly and no
others, a frequency for instance not, and it knows no bounds. The thresholding is done
by pysindy (STLSQ and SR3), the LASSO by CVXPY.

Sources: S. L. Brunton, J. L. Proctor and J. N. Kutz (2016) for SINDy and STLSQ,
P. Zheng et al. (2019) for SR3, R. Tibshirani (1996) for the LASSO. Rates are
(x1 - x0)/h at the middle of each interval.
"""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import pysindy as ps
from sklearn.exceptions import ConvergenceWarning

from phsi_opt.arguments import require_choice, require_size
from phsi_opt.baselines.gradient_descent import Baseline
from phsi_opt.data.checks import checked_hold, hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import InputCurve
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import FirstOrder, Model
from phsi_opt.transcription.grid import aligned_once

OPTIMIZERS = ("stlsq", "sr3")
RELAXATION = 1.0  # of SR3
MOST_ITERATIONS = 10_000  # of SR3
# Share of the rates (both as root mean squares) below which a term of the LASSO is the
# solver's rounding.
LASSO_ROUNDING = 1e-6
# Tolerances of Clarabel, close to the rounding of float64: the zeros of the LASSO are
# read off its solution.
GAP = 1e-14
RELATIVE_GAP = 1e-13
FEASIBILITY = 1e-13


@interruptible
def sindy(
    model: FirstOrder,
    data: Measurements,
    optimizer: str = "stlsq",
    threshold: float = 0.05,
    ridge: float = 0.05,
    *,
    fixed: Mapping[str, float] | None = None,
) -> Baseline:
    """Sequentially thresholded regression of each equation, by pysindy.

    The equations are dx_i/dt = Theta_i xi_i (thesis Eq. 4.7).
    """
    require_choice("optimizer", optimizer, OPTIMIZERS)
    require_size("threshold", threshold)
    require_size("ridge", ridge)

    def thresholding(n_terms: int) -> Any:
        if optimizer == "stlsq":
            rounds = n_terms + 1  # every round but the last drops a term
            return ps.STLSQ(threshold=threshold, alpha=ridge, max_iter=rounds)
        weight = ps.SR3.calculate_l0_weight(threshold, RELAXATION)
        return ps.SR3(
            reg_weight_lam=weight,
            relax_coeff_nu=RELAXATION,
            max_iter=MOST_ITERATIONS,
            unbias=True,
        )

    def solve(columns: np.ndarray, rates: np.ndarray) -> np.ndarray:
        return _by_pysindy(thresholding(columns.shape[1]), columns, rates)

    weight = f"ridge {ridge:g}" if optimizer == "stlsq" else f"relaxation {RELAXATION}"
    settings = f"threshold {threshold:g}, {weight}{_fixed_text(fixed)}"
    name = f"SINDy ({optimizer.upper()})"
    return _regressed(model, data, fixed, name, settings, solve)


def lasso(
    model: FirstOrder,
    data: Measurements,
    weight: float,
    *,
    fixed: Mapping[str, float] | None = None,
) -> Baseline:
    """The LASSO of each equation (thesis Eq. 4.8), by CVXPY and Clarabel.

    The coefficients are::

        argmin |dx_i - Theta_i xi|^2 + weight |xi|_1

    The squares are summed over the rows, not averaged, as in the thesis. An interior
    point leaves small numbers where the optimum is zero: a coefficient whose term is
    smaller than 1e-6 of the rates (both as root mean squares over the rows) is set to
    zero. Coefficients that stay are shrunk by the weight and not debiased.
    """
    require_size("weight", weight)
    settings = f"weight {weight:g}{_fixed_text(fixed)}"

    def solve(columns: np.ndarray, rates: np.ndarray) -> np.ndarray:
        return _by_cvxpy(columns, rates, weight)

    return _regressed(model, data, fixed, "LASSO", settings, solve)


def _regressed(
    model: FirstOrder,
    data: Measurements,
    fixed: Mapping[str, float] | None,
    method: str,
    settings: str,
    solve: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Baseline:
    """Every equation solved from columns (n_rows, n_terms) and rates (n_rows,); zeros
    removed from the model.
    """
    began = time.perf_counter()
    held = model.with_fixed(fixed or {})
    values: dict[str, float] = {}
    loss = 0.0
    for problem in regressions(held, data):
        try:
            found = solve(problem.columns, problem.rates)
        except SolveError as error:
            where = f"{method}, equation d{problem.equation}/dt"
            raise SolveError(f"{where}: {error}") from None
        values.update(zip(problem.names, found.tolist(), strict=True))
        residual = problem.rates - problem.columns @ found
        loss += float(np.mean(residual**2))
    entries = held.entries.items()
    removed = [n for n, entry in entries if entry.prunable and values.get(n) == 0]
    if len(removed) == len(values):
        raise ModelError(
            f"{method} removes every term ({settings}); "
            "lower the threshold or the weight."
        )
    return Baseline(
        model=held.with_values(values).without(set(removed)),
        hold=checked_hold(data.hold, data.inputs),
        seconds=time.perf_counter() - began,
        removed=tuple(removed),
        method=method,
        loss_value=loss,
        settings=settings,
    )


def _by_pysindy(optimizer: Any, columns: np.ndarray, rates: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        # "eliminated all coefficients": the record names them
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", ConvergenceWarning)
        try:
            fitted = optimizer.fit(columns, rates)
        except ConvergenceWarning as warning:
            raise SolveError(f"{warning} Change the threshold.") from None
        return np.asarray(fitted.coef_, dtype=float).ravel()


def _by_cvxpy(columns: np.ndarray, rates: np.ndarray, weight: float) -> np.ndarray:
    size = np.linalg.norm(columns, axis=0)
    scale = 1 / np.where(size > 0, size, 1.0)
    q, r = np.linalg.qr(columns * scale)
    # The program is in units of the rates, for the solver's tolerances.
    unit = float(np.linalg.norm(rates)) or 1.0
    z = cp.Variable(columns.shape[1])
    misfit = cp.sum_squares(r @ z - q.T @ rates / unit)
    penalty = cp.sum(cp.multiply(weight * scale / unit, cp.abs(z)))
    problem = cp.Problem(cp.Minimize(misfit + penalty))
    problem.solve(
        solver=cp.CLARABEL,
        tol_gap_abs=GAP,
        tol_gap_rel=RELATIVE_GAP,
        tol_feas=FEASIBILITY,
    )
    if z.value is None or not np.all(np.isfinite(z.value)):
        raise SolveError(
            f"the convex program was not solved ({problem.status}); "
            "check the data for huge values."
        )
    stays = (np.abs(z.value) > LASSO_ROUNDING) & (size > 0)
    return np.where(stays, z.value * scale * unit, 0.0)


def _fixed_text(fixed: Mapping[str, float] | None) -> str:
    if not fixed:
        return ""
    return ", fixed " + ", ".join(f"{name}={v:g}" for name, v in fixed.items())


# ---- a model as linear regressions of its rates: dx_i/dt = known_i + Theta_i xi_i ----


@dataclass(frozen=True, eq=False)
class Regression:
    """One equation: rates = columns times the coefficients.

    Attributes:
        equation: the state whose rate it is.
        names: of the coefficients.
        columns: (n_rows, n_terms), the terms at the samples.
        rates: (n_rows,), less the terms whose coefficient is known.
    """

    equation: str
    names: tuple[str, ...]
    columns: np.ndarray
    rates: np.ndarray


def regressions(model: Model, data: Measurements) -> tuple[Regression, ...]:
    """The regression of each equation that has unknown coefficients."""
    record = aligned_once(model, data)
    theta = ca.SX.sym("th", len(model.free))
    x = ca.SX.sym("x", model.n_states)
    u = ca.SX.sym("u", model.n_inputs)
    t = ca.SX.sym("t", 1)
    dx = model.rhs()(x, u, t, theta)
    slopes = ca.jacobian(dx, theta)
    _check_regression(model, slopes, theta)
    x_at, u_at, t_at, rates_at = midpoint_rates(record)
    at_zero = np.zeros((len(model.free), 1))
    problems = []
    for i, equation in enumerate(model.states):
        pattern = slopes.sparsity()
        chosen = [k for k in range(len(model.free)) if pattern.has_nz(i, k)]
        if not chosen:
            continue
        row = ca.densify(ca.horzcat(dx[i], slopes[i, chosen])).T
        at_samples = ca.Function("row", [x, u, t, theta], [row]).map(len(t_at))
        terms = np.array(at_samples(x_at.T, u_at.T, t_at[None, :], at_zero)).T
        names = tuple(model.free[k] for k in chosen)
        # At zero coefficients dx is what is known already: the terms with fixed
        # coefficients.
        known = terms[:, 0]
        rates = rates_at[:, i] - known
        problems.append(Regression(equation, names, terms[:, 1:], rates))
    return tuple(problems)


def midpoint_rates(data: Measurements) -> tuple[np.ndarray, ...]:
    """States, inputs and times at the middle of every interval, and the rates
    (x1 - x0)/h there, a row per interval of all trajectories.

    PHSI needs none of this: its loss compares steps, not rates.
    """
    hold = hold_of_each(data.hold, data.inputs)
    parts = []
    for run in data.trajectories:
        x, u, t = ((v[1:] + v[:-1]) / 2 for v in (run.x, run.u, run.t))
        u = np.where(hold == "zero", run.u[:-1], u)
        for k in np.flatnonzero(hold == "cubic"):
            curve = InputCurve(run.t, run.u[:, k], "cubic")
            u[:, k] = curve.lines(run.t[:-1], run.t[1:])[:2].mean(axis=0)
        parts.append((x, u, t, np.diff(run.x, axis=0) / np.diff(run.t)[:, None]))
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _check_regression(model: Model, slopes: ca.SX, theta: ca.SX) -> None:
    """Refuse what does not enter linearly."""
    bent = [k for k in range(len(model.free)) if ca.depends_on(slopes[:, k], theta)]
    # A wave's amplitude is bent by its frequency; the frequency, bent by itself too, is
    # the one to name.
    bent.sort(key=lambda k: not ca.depends_on(slopes[:, k], theta[k]))
    if bent:
        name = model.free[bent[0]]
        raise ModelError(
            f"parameter {name!r} does not enter linearly, so a regression such as "
            f"SINDy cannot learn it; give a value and fix it: fixed={{{name!r}: 1.0}}."
        )
