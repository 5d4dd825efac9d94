"""A model as linear regressions of its rates, one per equation.

dx_i/dt = known_i + Theta_i xi_i. What is not linear, has bounds or stands in two
equations is refused here. How the regressions are solved is in `sindy`.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import InputCurve
from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import aligned_once


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
