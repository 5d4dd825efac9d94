"""Single shooting as users of JAX write it: RK4 compiled, Levenberg-Marquardt.

Imported only where JAX is installed (extra ``peers``).
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from problems.benchmarks.peer_cases import PROBLEMS, Drawn, Problem
from problems.benchmarks.peer_methods import filled

jax.config.update("jax_enable_x64", True)

MOST_STEPS = 200
FIRST_DAMPING = 1e-3  # share of the diagonal
SMALLER = 0.1
LARGER = 10.0
MOST_DAMPING = 1e12
SETTLED = 1e-10  # relative fall of the sum of squares

# (theta, starts, y, sigma) -> residuals (n_runs, n_values), their slopes by theta and
# by each run's own start.
Slopes = Callable[..., tuple[Any, Any, Any]]


def shooting_with_jax(problem: Problem, case: Drawn) -> np.ndarray:
    """States that Levenberg-Marquardt finds, (n_runs, n_samples, n_states).

    Parameters and starting states are unknown. Compiled once per problem: a first call
    pays for that.
    """
    theta = case.guess
    starts = filled(problem, case)[:, 0]
    y = np.nan_to_num(case.y)
    residuals, slopes, states = _compiled(problem.name)
    damping = FIRST_DAMPING
    value = _squares(residuals(theta, starts, y, case.sigma))
    for _ in range(MOST_STEPS):
        gradient, curvature = _normal(*slopes(theta, starts, y, case.sigma))
        before = value
        while damping < MOST_DAMPING:
            damped = curvature + damping * np.diag(np.diag(curvature))
            change = np.linalg.solve(damped, -gradient)
            new_theta = theta + change[: len(theta)]
            new_starts = starts + change[len(theta) :].reshape(starts.shape)
            trial = _squares(residuals(new_theta, new_starts, y, case.sigma))
            if trial < value:
                theta, starts, value = new_theta, new_starts, trial
                damping *= SMALLER
                break
            damping *= LARGER
        if before - value <= SETTLED * before:
            break
    return np.asarray(states(theta, starts))


def _squares(residual: Any) -> float:
    value = float(np.sum(np.asarray(residual) ** 2))
    return value if np.isfinite(value) else np.inf


def _normal(
    residual: Any, by_theta: Any, by_start: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss-Newton matrix of all unknowns; runs share theta alone."""
    r, of_theta, of_start = (np.asarray(a) for a in (residual, by_theta, by_start))
    n_runs, _, n_theta = of_theta.shape
    n_states = of_start.shape[2]
    n = n_theta + n_runs * n_states
    gradient = np.zeros(n)
    matrix = np.zeros((n, n))
    gradient[:n_theta] = np.einsum("rvp,rv->p", of_theta, r)
    matrix[:n_theta, :n_theta] = np.einsum("rvp,rvq->pq", of_theta, of_theta)
    gradient[n_theta:] = np.einsum("rvn,rv->rn", of_start, r).ravel()
    border = np.einsum("rvn,rvp->rnp", of_start, of_theta)
    blocks = np.einsum("rvn,rvm->rnm", of_start, of_start)
    for run in range(n_runs):
        own = slice(n_theta + run * n_states, n_theta + (run + 1) * n_states)
        matrix[own, own] = blocks[run]
        matrix[own, :n_theta] = border[run]
        matrix[:n_theta, own] = border[run].T
    return gradient, matrix


@cache
def _compiled(name: str) -> tuple[Callable[..., Any], Slopes, Callable[..., Any]]:
    """Residuals, slopes and states of a problem's runs, side by side."""
    problem = next(each for each in PROBLEMS if each.name == name)
    measured = np.flatnonzero(problem.is_measured)
    times = jnp.asarray(problem.t)
    h = float(problem.t[1] - problem.t[0])

    def rate(t: Any, x: Any, theta: Any) -> Any:
        return jnp.stack(problem.rates(t, list(x), list(theta), jnp.cos))

    def simulated(theta: Any, start: Any) -> Any:
        def step(x: Any, t: Any) -> tuple[Any, Any]:
            first = rate(t, x, theta)
            second = rate(t + h / 2, x + h / 2 * first, theta)
            third = rate(t + h / 2, x + h / 2 * second, theta)
            fourth = rate(t + h, x + h * third, theta)
            after = x + h / 6 * (first + 2 * second + 2 * third + fourth)
            return after, after

        _, later = jax.lax.scan(step, start, times[:-1])
        return jnp.concatenate([start[None], later])

    def residual(theta: Any, start: Any, y: Any, sigma: Any) -> Any:
        scaled = (simulated(theta, start) - y) / sigma
        return scaled[:, measured].ravel()

    def with_slopes(theta: Any, start: Any, y: Any, sigma: Any) -> tuple[Any, Any, Any]:
        of_theta, of_start = jax.jacfwd(residual, (0, 1))(theta, start, y, sigma)
        return residual(theta, start, y, sigma), of_theta, of_start

    by_run = (None, 0, 0, None)
    return (
        jax.jit(jax.vmap(residual, by_run)),
        jax.jit(jax.vmap(with_slopes, by_run)),
        jax.jit(jax.vmap(simulated, (None, 0))),
    )
