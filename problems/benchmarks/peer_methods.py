"""What users would write themselves: full discretisation and single shooting.

Both minimise squared residuals over the noise, which they are told. Both take the
measured values as states to start from, and differences of them for a velocity that is
not measured.
"""

from typing import Any, cast

import casadi as ca
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from problems.benchmarks.peer_cases import Drawn, Problem

MOST_SHOTS = 100  # evaluations of all residuals, without those for slopes
DIFFERENCE = 1e-4  # relative, well above what the integrator rounds
LOST = 1e3  # standard deviations, the residual of a run that cannot be simulated


def full_discretisation(problem: Problem, case: Drawn) -> np.ndarray:
    """States that IPOPT finds, (n_runs, n_samples, n_states).

    All states are unknown and joined by one RK4 step per interval; exact Hessian.
    """
    n_states = len(problem.is_measured)
    step = _rk4(problem)
    theta = ca.MX.sym("theta", len(problem.truth))
    states = []
    defects = []
    misfits = []
    for y in case.y:
        x = ca.MX.sym("x", n_states, len(y))
        after = step(x[:, :-1], problem.t[:-1][None, :], theta)
        defects.append(ca.vec(x[:, 1:] - after))
        for k in np.flatnonzero(problem.is_measured):
            residual = (x[int(k), :].T - y[:, k]) / case.sigma[k]
            misfits.append(ca.sumsqr(residual) / 2)
        states.append(ca.vec(x))
    nlp = {
        "x": ca.vertcat(theta, *states),
        "f": sum(misfits),
        "g": ca.vertcat(*defects),
    }
    quiet: dict[str, Any] = {
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes"},
    }
    start = np.concatenate([case.guess, filled(problem, case).ravel()])
    found = ca.nlpsol("fit", "ipopt", nlp, quiet)(x0=start, lbg=0, ubg=0)
    z = np.array(found["x"]).ravel()
    return z[len(problem.truth) :].reshape(case.y.shape)


def _rk4(problem: Problem) -> ca.Function:
    """One step for all intervals side by side."""
    x = ca.SX.sym("x", len(problem.is_measured))
    t = ca.SX.sym("t")
    theta = ca.SX.sym("theta", len(problem.truth))
    h = float(problem.t[1] - problem.t[0])

    def rate(at: ca.SX, state: ca.SX) -> ca.SX:
        rates = problem.rates(at, ca.vertsplit(state), ca.vertsplit(theta), ca.cos)
        return cast("ca.SX", ca.vertcat(*rates))

    first = rate(t, x)
    second = rate(t + h / 2, x + h / 2 * first)
    third = rate(t + h / 2, x + h / 2 * second)
    fourth = rate(t + h, x + h * third)
    after = x + h / 6 * (first + 2 * second + 2 * third + fourth)
    step = ca.Function("step", [x, t, theta], [after])
    return step.map(len(problem.t) - 1)


def single_shooting(problem: Problem, case: Drawn) -> np.ndarray:
    """States that SciPy's least squares finds, (n_runs, n_samples, n_states).

    Parameters and starting states are unknown; slopes by differences, those of the
    starting states of all trajectories together.
    """
    n_theta = len(problem.truth)
    start = np.concatenate([case.guess, filled(problem, case)[:, 0].ravel()])

    def states(z: np.ndarray) -> np.ndarray:
        begins = z[n_theta:].reshape(len(case.y), -1)
        return np.array([_or_lost(problem, each, z[:n_theta]) for each in begins])

    def residuals(z: np.ndarray) -> np.ndarray:
        scaled = (states(z) - case.y) / case.sigma
        of_measured = scaled[:, :, np.array(problem.is_measured)]
        return np.clip(np.nan_to_num(of_measured, nan=LOST), -LOST, LOST).ravel()

    pattern = _pattern(problem, case)
    found = least_squares(
        residuals,
        start,
        x_scale="jac",
        diff_step=DIFFERENCE,
        jac_sparsity=pattern,
        max_nfev=MOST_SHOTS,
    )
    return states(found.x)


def _or_lost(problem: Problem, start: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Simulated states, NaN from where the integration gave up."""
    x = problem.simulated(start, theta)
    whole = np.full((len(problem.t), len(start)), np.nan)
    whole[: len(x)] = x
    return whole


def _pattern(problem: Problem, case: Drawn) -> lil_matrix:
    """Which residuals follow which unknowns."""
    n_runs, n_samples, n_states = case.y.shape
    n_theta = len(problem.truth)
    n_each = n_samples * sum(problem.is_measured)
    pattern = lil_matrix((n_runs * n_each, n_theta + n_runs * n_states), dtype=int)
    pattern[:, :n_theta] = 1
    for run in range(n_runs):
        first = n_theta + run * n_states
        rows = slice(run * n_each, (run + 1) * n_each)
        pattern[rows, first : first + n_states] = 1
    return pattern


def filled(problem: Problem, case: Drawn) -> np.ndarray:
    """Measured values, and the slope of q where p is not measured."""
    filled = case.y.copy()
    for k in np.flatnonzero(~np.array(problem.is_measured)):
        filled[:, :, k] = np.gradient(case.y[:, :, 0], problem.t, axis=1)
    return filled
