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
from typing import Any

import cvxpy as cp
import numpy as np
import pysindy as ps
from sklearn.exceptions import ConvergenceWarning

from phsi_opt.arguments import require_choice, require_positive, require_size
from phsi_opt.baselines.descent import Baseline
from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import FirstOrder
from problems.peers.regression import Regression, regressions

__all__ = ["Regression", "lasso", "regressions", "sindy"]
OPTIMIZERS = ("stlsq", "sr3")
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
    relaxation: float = 1.0,
    debias: bool = True,
    max_iterations: int = 10_000,
) -> Baseline:
    """Sequentially thresholded regression of each equation, by pysindy.

    The equations are dx_i/dt = Theta_i xi_i (thesis Eq. 4.7).
    """
    require_choice("optimizer", optimizer, OPTIMIZERS)
    require_size("threshold", threshold)
    require_size("ridge", ridge)
    require_positive("relaxation", relaxation)

    def thresholding(n_terms: int) -> Any:
        if optimizer == "stlsq":
            rounds = n_terms + 1  # every round but the last drops a term
            return ps.STLSQ(
                threshold=threshold, alpha=ridge, max_iter=rounds, unbias=debias
            )
        return ps.SR3(
            reg_weight_lam=ps.SR3.calculate_l0_weight(threshold, relaxation),
            relax_coeff_nu=relaxation,
            max_iter=max_iterations,
            unbias=debias,
        )

    def solve(columns: np.ndarray, rates: np.ndarray) -> np.ndarray:
        return _by_pysindy(thresholding(columns.shape[1]), columns, rates)

    weight = f"relaxation {relaxation:g}"
    if optimizer == "stlsq":
        weight = f"ridge {ridge:g}"
    settings = (
        f"threshold {threshold:g}, {weight}, derivative midpoint, "
        f"debias {debias}{_fixed_text(fixed)}"
    )
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
    settings = f"weight {weight:g}, derivative midpoint{_fixed_text(fixed)}"

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
            raise SolveError(
                f"{warning} Allow more (max_iterations), "
                "or change threshold or relaxation."
            ) from None
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
