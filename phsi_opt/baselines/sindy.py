"""SINDy on the same measurements: sparse regression of rates on a dictionary (thesis
Section 4.2).

The dictionary is the model's own, so each equation may have a different one. SINDy is a
regression: it learns coefficients that enter linearly and no others, a frequency for
instance not, and it knows no bounds. The thresholding is done by pysindy (STLSQ and
SR3), the LASSO by CVXPY.
"""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import pysindy as ps
from sklearn.exceptions import ConvergenceWarning

from phsi_opt.baselines.result import Baseline
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, ModelError, SolveError, did_you_mean
from phsi_opt.model.model import FirstOrder, Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.transcription.alignment import aligned

OPTIMIZERS = ("stlsq", "sr3")
ZERO = 1e-6  # LASSO: a term below this share of the rates is the solver's rounding
WINDOW, WINDOW_DEGREE = 11, 3  # of the Savitzky-Golay filter; pysindy's own choice

Regress = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Regression:
    """One equation: rates (n_rows,) = columns (n_rows, n_terms) times the coefficients
    ``names``.
    """

    equation: str
    names: tuple[str, ...]
    columns: np.ndarray
    rates: np.ndarray


def sindy(
    model: FirstOrder,
    data: Measurements,
    optimizer: str = "stlsq",
    threshold: float = 0.05,
    ridge: float = 0.05,
    derivative: str = "midpoint",
    *,
    fixed: Mapping[str, float] | None = None,
    relaxation: float = 1.0,
    debias: bool = True,
    max_iterations: int = 10_000,
) -> Baseline:
    """Sequentially thresholded regression of each equation, dx_i/dt = Theta_i xi_i
    (thesis Eq. 4.7), by pysindy.

    Args:
        optimizer: "stlsq": minimise |dx - Theta xi|^2 + ridge |xi|^2 (thesis Eq. 4.9),
            drop |xi_j| < threshold, repeat. "sr3": minimise |dx - Theta w|^2/2 + lambda
            |xi|_0 + |w - xi|^2/(2 relaxation), where lambda = threshold^2/(2
            relaxation) makes ``threshold`` the least coefficient; it uses no ridge.
        threshold: least magnitude of a coefficient that stays, in the units of that
            coefficient.
        ridge: weight on a sum over all rows, as in pysindy (its default). It shrinks
            what multiplies small columns:
            with states of 0.2 and cubic terms, 0.05 already hides the true ones; use
            1e-10 there.
        derivative: "midpoint": (x1 - x0)/h at (x0 + x1)/2, a row per interval (the only
            one for lone pairs); "finite difference": second order at each sample;
            "smoothed": the same after a Savitzky-Golay filter of 11 samples, whose
            states are used as well. The last two by pysindy, per trajectory.
        fixed: values at which parameters are held, such as {"F_p.omega_t": 1.0} for a
            frequency.
        debias: least squares on the terms that stay, without ridge or relaxation, at
            the end.
        max_iterations: limit of SR3; STLSQ ends by itself.

    Returns a `Baseline` without the terms whose coefficient is zero; ``loss_value`` is
    the mean over the rows of the squared residual, summed over the equations. A
    parameter of a formula stays, with the value zero. Raises `ModelError` for a model
    that is not a linear regression, `DataError` for incomplete states, `SolveError` if
    SR3 does not converge.
    """
    if optimizer not in OPTIMIZERS:
        raise ModelError(
            f"optimizer {optimizer!r} is unknown; expected one of {', '.join(OPTIMIZERS)}."
            f"{did_you_mean(str(optimizer), OPTIMIZERS)}"
        )
    for name, value in (("threshold", threshold), ("ridge", ridge)):
        _check_number(name, value, positive=False)
    _check_number("relaxation", relaxation, positive=True)

    def make(n_terms: int) -> Any:
        if optimizer == "stlsq":  # every round but the last drops a term
            return ps.STLSQ(
                threshold=threshold, alpha=ridge, max_iter=n_terms + 1, unbias=debias
            )
        weight = ps.SR3.calculate_l0_weight(threshold, relaxation)
        return ps.SR3(
            reg_weight_lam=weight,
            relax_coeff_nu=relaxation,
            max_iter=max_iterations,
            unbias=debias,
        )

    size = f"threshold {threshold:g}, " + (
        f"ridge {ridge:g}" if optimizer == "stlsq" else f"relaxation {relaxation:g}"
    )
    settings = f"{size}, derivative {derivative}, debias {debias}{_fixed_text(fixed)}"
    return _regressed(
        model,
        data,
        derivative,
        fixed,
        lambda A, b: _by_pysindy(make(A.shape[1]), A, b),
        f"SINDy ({optimizer.upper()})",
        settings,
    )


def lasso(
    model: FirstOrder,
    data: Measurements,
    weight: float,
    derivative: str = "midpoint",
    *,
    fixed: Mapping[str, float] | None = None,
) -> Baseline:
    """argmin |dx_i - Theta_i xi|^2 + weight |xi|_1 for each equation (thesis Eq. 4.8),
    by CVXPY (Clarabel).

    The squares are summed over the rows, not averaged, as in the thesis. An interior
    point leaves small numbers where the optimum is zero: a coefficient whose term is
    smaller than 1e-6 of the rates (both as root mean squares over the rows) is set to
    zero. Coefficients that stay are shrunk by the weight and not debiased. Other
    arguments, result and errors as for `sindy`.
    """
    _check_number("weight", weight, positive=False)
    settings = f"weight {weight:g}, derivative {derivative}{_fixed_text(fixed)}"
    return _regressed(
        model,
        data,
        derivative,
        fixed,
        lambda A, b: _by_cvxpy(A, b, weight),
        "LASSO",
        settings,
    )


def regressions(
    model: FirstOrder,
    data: Measurements,
    derivative: str = "midpoint",
    fixed: Mapping[str, float] | None = None,
) -> tuple[Regression, ...]:
    """The regression of each equation that has unknown coefficients, as `sindy` and
    `lasso` see it.
    """
    return _regressions(*_prepared(model, data, fixed), derivative)


def _regressed(
    model: FirstOrder,
    data: Measurements,
    derivative: str,
    fixed: Mapping[str, float] | None,
    regress: Regress,
    method: str,
    settings: str,
) -> Baseline:
    began = time.perf_counter()
    held, complete = _prepared(model, data, fixed)
    values: dict[str, float] = {}
    loss = 0.0
    for problem in _regressions(held, complete, derivative):
        try:
            found = regress(problem.columns, problem.rates)
        except SolveError as error:
            raise SolveError(
                f"{method}, equation d{problem.equation}/dt: {error}"
            ) from None
        values.update(zip(problem.names, found.tolist(), strict=True))
        loss += float(np.mean((problem.rates - problem.columns @ found) ** 2))
    entries = held.entries
    zero = {
        name for name, value in values.items() if value == 0 and entries[name].prunable
    }
    if len(zero) == len(values):
        raise ModelError(
            f"{method} removes every term ({settings}); lower the threshold or the weight."
        )
    return Baseline(
        model=held.with_values(values).without(zero),
        hold=data.hold,
        seconds=time.perf_counter() - began,
        removed=tuple(name for name in entries if name in zero),
        method=method,
        loss_value=loss,
        settings=settings,
    )


def _by_pysindy(optimizer: Any, columns: np.ndarray, rates: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # "eliminated all coefficients": the record names them
        warnings.simplefilter("error", ConvergenceWarning)
        try:
            return np.asarray(optimizer.fit(columns, rates).coef_, dtype=float).ravel()
        except ConvergenceWarning as warning:
            raise SolveError(
                f"{warning} Allow more (max_iterations), or change threshold or relaxation."
            ) from None


def _by_cvxpy(columns: np.ndarray, rates: np.ndarray, weight: float) -> np.ndarray:
    size = np.linalg.norm(columns, axis=0)
    scale = 1 / np.where(size > 0, size, 1.0)
    q, r = np.linalg.qr(columns * scale)
    unit = (
        float(np.linalg.norm(rates)) or 1.0
    )  # the program in units of the rates, for the solver's tolerances
    z = cp.Variable(columns.shape[1])
    misfit = cp.sum_squares(r @ z - q.T @ rates / unit)
    problem = cp.Problem(
        cp.Minimize(misfit + cp.sum(cp.multiply(weight * scale / unit, cp.abs(z))))
    )
    problem.solve(
        solver=cp.CLARABEL, tol_gap_abs=1e-14, tol_gap_rel=1e-13, tol_feas=1e-13
    )
    if z.value is None or not np.all(np.isfinite(z.value)):
        raise SolveError(
            f"the convex program was not solved ({problem.status}); check the data for huge values."
        )
    return np.where((np.abs(z.value) > ZERO) & (size > 0), z.value * scale * unit, 0.0)


# --- the model as a regression


def _prepared(
    model: FirstOrder, data: Measurements, fixed: Mapping[str, float] | None
) -> tuple[Model, Measurements]:
    """Model with the fixed values in place and data in its order, both checked."""
    if not isinstance(model, FirstOrder):
        raise ModelError(
            f"SINDy regresses rates on terms, so it needs a FirstOrder model, not {type(model).__name__}; write the "
            "right-hand sides as dictionaries: FirstOrder(states, {'q': polynomials(...), ...})."
        )
    held = _held(model, fixed or {})
    if not held.free:
        raise ModelError(
            "the model has no free coefficient, so there is nothing to regress."
        )
    complete = aligned(held, data)
    for run in complete.trajectories:
        if not np.all(np.isfinite(run.x)):
            i, k = np.argwhere(~np.isfinite(run.x))[0]
            raise DataError(
                f"trajectory {run.name!r}: {complete.states[k]} at t[{i}]={run.t[i]:g} is missing, but SINDy needs "
                "every state at every sample; leave the sample out, or use identify with MaximumLikelihood()."
            )
    return held, complete


def _held(model: Model, values: Mapping[str, float]) -> Model:
    for name in values:
        if name not in model.entries:
            raise ModelError(
                f"fixed names {name!r}, which is not in the model.{did_you_mean(name, model.entries)}"
            )
        _check_number(f"fixed[{name!r}]", values[name], positive=None)

    def hold(parameter: Parameter, name: str) -> Parameter:
        return (
            replace(parameter, value=values[name], fixed=True)
            if name in values
            else parameter
        )

    def term(old: Term, place: str) -> Term:
        own = old.coefficient and hold(old.coefficient, old.coefficient_name(place))
        return replace(
            old,
            coefficient=own,
            inner={n: hold(p, old.inner_name(n, place)) for n, p in old.inner.items()},
        )

    slots: dict[str, Any] = {
        slot: {
            n: Dictionary(tuple(term(t, place_of(slot, n)) for t in terms))
            for n, terms in old.items()
        }
        for slot, old in (("F", model.F), ("R", model.R))
    }
    return replace(model, **slots)


def _regressions(
    model: Model, data: Measurements, derivative: str
) -> tuple[Regression, ...]:
    theta, x, u, t = (
        ca.SX.sym(n, k)
        for n, k in (
            ("th", len(model.free)),
            ("x", model.n_states),
            ("u", model.n_inputs),
            ("t", 1),
        )
    )
    dx = model.rhs()(x, u, t, theta)
    slopes = ca.jacobian(dx, theta)
    _check_linear(model, slopes, theta)
    at, rates = _rows(data, derivative)
    problems = []
    for i, equation in enumerate(model.states):
        chosen = [k for k in range(len(model.free)) if slopes.sparsity().has_nz(i, k)]
        if not chosen:
            continue
        names = tuple(model.free[k] for k in chosen)
        both = ca.Function(
            "row",
            [x, u, t, theta],
            [ca.densify(ca.horzcat(dx[i], slopes[i, chosen])).T],
        )
        # At zero coefficients dx is what is known already: the terms with fixed
        # coefficients.
        values = np.array(
            both.map(at.shape[1])(*_split(at, model), np.zeros((theta.numel(), 1)))
        ).T
        _check_columns(equation, names, values)
        problems.append(
            Regression(equation, names, values[:, 1:], rates[i] - values[:, 0])
        )
    return tuple(problems)


def _split(at: np.ndarray, model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n, m = model.n_states, model.n_inputs
    return at[:n], at[n : n + m], at[n + m :]


def _check_linear(model: Model, slopes: ca.SX, theta: ca.SX) -> None:
    entries = [model.entries[name] for name in model.free]
    bent = [k for k in range(len(entries)) if ca.depends_on(slopes[:, k], theta)]
    # A wave's amplitude is bent by its frequency; the frequency, bent by itself too, is
    # the one to name.
    bent.sort(
        key=lambda k: (not ca.depends_on(slopes[:, k], theta[k]), entries[k].prunable)
    )
    if bent:
        name = entries[bent[0]].name
        raise ModelError(
            f"parameter {name!r} does not enter linearly, so a regression such as SINDy cannot learn it; give a "
            f"frequency=... (or value) and fix it: fixed={{{name!r}: 1.0}}."
        )
    for k, entry in enumerate(entries):
        lower, upper = entry.parameter.lower, entry.parameter.upper
        if np.isfinite(lower) or np.isfinite(upper):
            raise ModelError(
                f"parameter {entry.name!r} has bounds [{lower:g}, {upper:g}], which a regression does not keep; use "
                "Parameter() without bounds (damping: put the state into the dictionary of F)."
            )
        equations = [
            model.states[i]
            for i in range(model.n_states)
            if slopes.sparsity().has_nz(i, k)
        ]
        if len(equations) > 1:
            raise ModelError(
                f"parameter {entry.name!r} stands in the equations of {' and '.join(equations)}, but SINDy regresses "
                "each equation on its own; use two names."
            )


def _check_columns(equation: str, names: tuple[str, ...], values: np.ndarray) -> None:
    if not np.all(np.isfinite(values)):
        k = int(np.argwhere(~np.isfinite(values))[0][1])
        what = f"term {names[k - 1]!r}" if k else "a known term"
        raise DataError(
            f"{what} of d{equation}/dt is not finite over the data; check the formula's range."
        )
    if len(values) < len(names):
        raise DataError(
            f"d{equation}/dt has {len(names)} terms but the data give {len(values)} rates; measure more or shorten "
            "the dictionary."
        )


# --- rates from samples


def _rows(data: Measurements, derivative: str) -> tuple[np.ndarray, np.ndarray]:
    """Where each rate holds, (n_states + n_inputs + 1, n_rows), and the rates
    (n_states, n_rows).
    """
    if derivative not in DERIVATIVES:
        raise ModelError(
            f"derivative {derivative!r} is unknown; expected one of {', '.join(DERIVATIVES)}."
            f"{did_you_mean(str(derivative), DERIVATIVES)}"
        )
    parts = [DERIVATIVES[derivative](run, data.hold) for run in data.trajectories]
    at = np.concatenate([np.column_stack(part[:3]) for part in parts])
    return at.T, np.concatenate([part[3] for part in parts]).T


Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # x, u, t, dx


def _midpoint(run: Trajectory, hold: str) -> Rows:
    u = run.u[:-1] if hold == "zero" else (run.u[1:] + run.u[:-1]) / 2
    return (
        (run.x[1:] + run.x[:-1]) / 2,
        u,
        (run.t[1:] + run.t[:-1]) / 2,
        np.diff(run.x, axis=0) / np.diff(run.t)[:, None],
    )


def _finite_difference(run: Trajectory, hold: str) -> Rows:
    _check_length(run, 3, "finite difference")
    return run.x, run.u, run.t, np.asarray(ps.FiniteDifference(order=2)(run.x, run.t))


def _smoothed(run: Trajectory, hold: str) -> Rows:
    _check_length(run, WINDOW, "smoothed")
    steps = np.diff(run.t)
    if np.ptp(steps) > 1e-6 * steps.mean():
        raise DataError(
            f"trajectory {run.name!r}: steps from {steps.min():g} to {steps.max():g}, but derivative='smoothed' needs "
            "equal ones; use 'midpoint' or 'finite difference'."
        )
    method = ps.SmoothedFiniteDifference(
        smoother_kws={"window_length": WINDOW, "polyorder": WINDOW_DEGREE}
    )
    rates = np.asarray(method(run.x, run.t))
    return np.asarray(method.smoothed_x_), run.u, run.t, rates


DERIVATIVES: dict[str, Callable[[Trajectory, str], Rows]] = {
    "midpoint": _midpoint,
    "finite difference": _finite_difference,
    "smoothed": _smoothed,
}


def _check_length(run: Trajectory, least: int, derivative: str) -> None:
    if run.n_samples < least:
        raise DataError(
            f"trajectory {run.name!r} has {run.n_samples} samples, but derivative={derivative!r} needs at least "
            f"{least}; use 'midpoint'."
        )


def _check_number(name: str, value: float, positive: bool | None) -> None:
    """Finite, and at least zero (or above, if ``positive``; any sign if None)."""
    good = isinstance(value, int | float | np.number) and np.isfinite(value)
    if not good or (positive is not None and (value < 0 or (positive and value == 0))):
        expected = {
            None: "a finite number",
            False: "a number of at least 0",
            True: "a number above 0",
        }[positive]
        raise ModelError(f"{name}={value!r}; expected {expected}.")


def _fixed_text(fixed: Mapping[str, float] | None) -> str:
    return (
        ", fixed " + ", ".join(f"{n}={v:g}" for n, v in fixed.items()) if fixed else ""
    )
