"""`identify` from far starts, and beside what users would write themselves.

    python -m problems.benchmarks.identify [--quick]

A full discretisation in CasADi, and single shooting with SciPy's `least_squares`, by
`solve_ivp` and compiled with JAX. Seeds 0 to 999 are for development (``--quick``: one
of them, and nothing is written).
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from typing import Any, cast

import casadi as ca
import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

import phsi_opt as ph
from problems.benchmarks.far_starts import KINDS, NOTHING, UNREST, FarStart, draw_case
from problems.benchmarks.peer_problems import PROBLEMS, Drawn, Problem, drawn
from problems.tools.command_line import flag
from problems.tools.pages import publish, render

FIRST_SEED = 5000
N_STARTS = 3  # of each problem
# How far the frequencies start off, what the model lacks, machines of each kind.
SETTINGS = ((0.5, NOTHING, 20), (0.7, NOTHING, 10), (0.7, UNREST, 5))
# Difference of the deviance up to which a fit is no less likely than its reference:
# what three parameters more would explain by chance.
SAME_OPTIMUM = 3.0
# Root mean square residual over the noise's standard deviation, up to which a fit has
# found the motion.
FOUND = 1.1
MOST_SHOTS = 100  # evaluations of all residuals, without those for slopes
DIFFERENCE = 1e-4  # relative, well above what the integrator rounds
LOST = 1e3  # standard deviations, the residual of a run that cannot be simulated
OURS, CASADI, SCIPY, JAX = "identify", "CasADi", "SciPy", "JAX"
OTHER_DATA = 100_000  # added to a seed: data with which functions are compiled


# --- starts far off


def far_row(kind: str, seed: int, off: float, lacks: str) -> dict[str, object]:
    """One machine, identified from far off."""
    case = draw_case(kind, seed, off, lacks)
    misfit, seconds = _identified(case)
    if lacks == NOTHING:
        reference = _misfit(case, case.data.trajectories[0].x - case.noise)
    else:
        near = replace(case, model=case.model.with_values(case.truth))
        reference = min(_identified(near)[0], misfit)
    start = f"{100 * off:.0f} %"
    row: dict[str, object] = {"start off": start, "the model lacks": lacks}
    row |= {"machine": kind, "right": misfit - reference < SAME_OPTIMUM}
    return row | {"CPU s": seconds}


def _identified(case: FarStart) -> tuple[float, float]:
    """Deviance but for a constant of the record, and processor seconds."""
    began = time.process_time()
    try:
        fit = ph.identify(case.model, case.data)
    except ph.SolveError:
        return np.inf, time.process_time() - began
    return _misfit(case, fit.states[0]), time.process_time() - began


def _misfit(case: FarStart, states: np.ndarray) -> float:
    """The sum over channels of n_values log(mean squared residual)."""
    residual = case.data.trajectories[0].x - states
    seen = np.isfinite(residual).any(axis=0)
    mean = np.nanmean(residual[:, seen] ** 2, axis=0)
    return float(np.sum(np.isfinite(residual[:, seen]).sum(axis=0) * np.log(mean)))


def far_summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A line per setting and kind of machine."""
    by = rows.groupby(["start off", "the model lacks", "machine"], sort=False)
    found = by.agg(
        n=("right", "size"), right=("right", "sum"), seconds=("CPU s", "sum")
    )
    return found.round(1).reset_index()


# --- what users would write


def full_discretisation(problem: Problem, case: Drawn) -> np.ndarray:
    """States (n_runs, n_samples, n_states) by IPOPT with the exact Hessian: all states
    are unknown and joined by one RK4 step per interval.
    """
    n_states = len(problem.is_measured)
    step = _rk4(problem)
    theta = ca.MX.sym("theta", len(problem.truth))
    states, defects, misfits = [], [], []
    for y in case.y:
        x = ca.MX.sym("x", n_states, len(y))
        after = step(x[:, :-1], problem.t[:-1][None, :], theta)
        defects.append(ca.vec(x[:, 1:] - after))
        for k in np.flatnonzero(problem.is_measured):
            residual = (x[int(k), :].T - y[:, k]) / case.sigma[k]
            misfits.append(ca.sumsqr(residual) / 2)
        states.append(ca.vec(x))
    unknowns = ca.vertcat(theta, *states)
    nlp = {"x": unknowns, "f": sum(misfits), "g": ca.vertcat(*defects)}
    quiet: dict[str, Any] = {"print_time": False}
    quiet["ipopt"] = {"print_level": 0, "sb": "yes"}
    start = np.concatenate([case.guess, filled(problem, case).ravel()])
    found = ca.nlpsol("fit", "ipopt", nlp, quiet)(x0=start, lbg=0, ubg=0)
    z = np.array(found["x"]).ravel()
    return z[len(problem.truth) :].reshape(case.y.shape)


def _rk4(problem: Problem) -> ca.Function:
    """One step for all intervals side by side."""
    x, t = ca.SX.sym("x", len(problem.is_measured)), ca.SX.sym("t")
    theta = ca.SX.sym("theta", len(problem.truth))

    def rate(at: ca.SX, state: ca.SX) -> ca.SX:
        rates = problem.rates(at, ca.vertsplit(state), ca.vertsplit(theta), ca.cos)
        return cast("ca.SX", ca.vertcat(*rates))

    after = _step(rate, t, x, float(problem.t[1] - problem.t[0]))
    return ca.Function("step", [x, t, theta], [after]).map(len(problem.t) - 1)


def _step(rate: Callable[[Any, Any], Any], t: Any, x: Any, h: float) -> Any:
    """A step of Runge and Kutta, of CasADi's and JAX's numbers alike."""
    first = rate(t, x)
    second = rate(t + h / 2, x + h / 2 * first)
    third = rate(t + h / 2, x + h / 2 * second)
    fourth = rate(t + h, x + h * third)
    return x + h / 6 * (first + 2 * second + 2 * third + fourth)


def shooting(problem: Problem, case: Drawn) -> np.ndarray:
    """States that SciPy's least squares finds by `solve_ivp`; slopes by differences,
    those of the starting states of all trajectories together.
    """
    n_theta = len(problem.truth)

    def states(z: np.ndarray) -> np.ndarray:
        whole = np.full(case.y.shape, np.nan)
        begins = z[n_theta:].reshape(len(case.y), -1)
        for run, begin in zip(whole, begins, strict=True):
            x = problem.simulated(begin, z[:n_theta])
            run[: len(x)] = x
        return whole

    def residuals(z: np.ndarray) -> np.ndarray:
        scaled = (states(z) - case.y) / case.sigma
        of_measured = scaled[:, :, np.array(problem.is_measured)]
        return np.clip(np.nan_to_num(of_measured, nan=LOST), -LOST, LOST).ravel()

    n_runs, n_samples, n_states = case.y.shape
    n_each = n_samples * sum(problem.is_measured)
    pattern = lil_matrix((n_runs * n_each, n_theta + n_runs * n_states), dtype=int)
    pattern[:, :n_theta] = 1
    for run in range(n_runs):
        first = n_theta + run * n_states
        rows = slice(run * n_each, (run + 1) * n_each)
        pattern[rows, first : first + n_states] = 1
    options: dict[str, Any] = {"diff_step": DIFFERENCE, "jac_sparsity": pattern}
    return states(_fitted(residuals, problem, case, **options))


def compiled_shooting(problem: Problem, case: Drawn) -> np.ndarray:
    """The same with one RK4 step per interval and exact slopes, compiled with JAX."""
    residuals, slopes, states = _compiled(problem.name)
    y = np.nan_to_num(case.y)
    z = _fitted(
        lambda z: np.nan_to_num(residuals(z, y, case.sigma), nan=LOST),
        problem,
        case,
        jac=lambda z: np.nan_to_num(slopes(z, y, case.sigma)),
    )
    return np.asarray(states(z, y))


@cache
def _compiled(name: str) -> tuple[Callable[..., Any], ...]:
    """Residuals, their slopes and the states of a problem."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    problem = next(each for each in PROBLEMS if each.name == name)
    measured, n_theta = np.array(problem.is_measured), len(problem.truth)
    times, h = jnp.asarray(problem.t), float(problem.t[1] - problem.t[0])

    def states(z: Any, y: Any) -> Any:
        def rate(t: Any, x: Any) -> Any:
            return jnp.stack(problem.rates(t, list(x), list(z[:n_theta]), jnp.cos))

        def advanced(x: Any, t: Any) -> tuple[Any, Any]:
            after = jax.vmap(lambda one: _step(rate, t, one, h))(x)
            return after, after

        starts = z[n_theta:].reshape(len(y), -1)
        _, later = jax.lax.scan(advanced, starts, times[:-1])
        return jnp.concatenate([starts[None], later]).swapaxes(0, 1)

    def residuals(z: Any, y: Any, sigma: Any) -> Any:
        return (((states(z, y) - y) / sigma)[:, :, measured]).ravel()

    return jax.jit(residuals), jax.jit(jax.jacfwd(residuals)), jax.jit(states)


def _fitted(
    residuals: Callable[[np.ndarray], np.ndarray],
    problem: Problem,
    case: Drawn,
    **options: Any,
) -> np.ndarray:
    """Parameters and starting states of least squares."""
    start = np.concatenate([case.guess, filled(problem, case)[:, 0].ravel()])
    options |= {"x_scale": "jac", "max_nfev": MOST_SHOTS}
    return np.asarray(least_squares(residuals, start, **options).x)


def filled(problem: Problem, case: Drawn) -> np.ndarray:
    """Measured values, and the slope of q where p is not measured."""
    filled = case.y.copy()
    for k in np.flatnonzero(~np.array(problem.is_measured)):
        filled[:, :, k] = np.gradient(case.y[:, :, 0], problem.t, axis=1)
    return filled


# --- beside each other


def peer_row(problem: Problem, seed: int) -> dict[str, object]:
    """One problem from one start, by everything that is installed."""
    case = drawn(problem, seed)
    guess = dict(zip(problem.truth, case.guess.tolist(), strict=True))
    model = problem.model().with_values(guess)
    times = [problem.t] * problem.n_runs
    data = ph.Measurements.from_arrays(times, list(case.y), states=model.states)

    def identified() -> np.ndarray:
        return np.array(ph.identify(model, data).states)

    row: dict[str, object] = {"problem": problem.name, "seed": seed}
    row |= _timed(OURS, case, identified)
    began = time.process_time()
    _ = ph.identify(model, data).std_errors
    row["with errors s"] = time.process_time() - began
    row |= _timed(CASADI, case, lambda: full_discretisation(problem, case))
    if problem.has_shooting:
        row |= _timed(SCIPY, case, lambda: shooting(problem, case))
    if problem.has_shooting and find_spec("jax") is not None:
        compiled_shooting(problem, drawn(problem, seed + OTHER_DATA))
        row |= _timed(JAX, case, lambda: compiled_shooting(problem, case))
    return row


def _timed(
    name: str, case: Drawn, solve: Callable[[], np.ndarray]
) -> dict[str, object]:
    """Processor seconds, and whether the motion was found."""
    began = time.process_time()
    try:
        x = solve()
    except ph.SolveError:
        x = np.full_like(case.y, np.inf)
    seconds = time.process_time() - began
    ratio = np.sqrt(np.nanmean(((x - case.y) / case.sigma) ** 2))
    return {f"{name} s": seconds, f"{name} found": bool(ratio < FOUND)}


def peer_summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A line per problem: medians, ratios and successes."""
    lines = []
    for name, group in rows.groupby("problem", sort=False):
        ours = group[f"{OURS} s"]
        line: dict[str, object] = {"problem": name, "CPU s": f"{ours.median():.3f}"}
        line |= {"with standard errors": f"{group['with errors s'].median():.3f}"}
        line |= {f"{OURS} found": f"{group[f'{OURS} found'].sum()} of {len(group)}"}
        for peer in (CASADI, SCIPY, JAX):
            found = group.get(f"{peer} found", pd.Series(dtype=bool)).dropna()
            line |= {f"{peer} / {OURS}": "not run", f"{peer} found": "not run"}
            if len(found):
                ratio = (group[f"{peer} s"] / ours).median()
                line |= {f"{peer} / {OURS}": f"{ratio:.2f}"}
                line |= {f"{peer} found": f"{int(found.sum())} of {len(found)}"}
        lines.append(line)
    return pd.DataFrame(lines)


def page(far: pd.DataFrame, peers: pd.DataFrame) -> str:
    """The page as Markdown."""
    return render(
        "benchmarks/pages/identify.md",
        far=far_summary(far),
        n_far=len(far),
        n_right=int(far["right"].sum()),
        peers=peer_summary(peers),
        first=peers["seed"].min(),
        found=FOUND,
        most_shots=MOST_SHOTS,
        difference=DIFFERENCE,
    )


def main(quick: bool) -> None:
    """All machines and problems; the page is written unless ``quick``."""
    first = 0 if quick else FIRST_SEED
    far, peers = [], []
    for off, lacks, n in SETTINGS:
        for seed in range(first, first + (1 if quick else n)):
            far += [far_row(kind, seed, off, lacks) for kind in KINDS]
    for problem in PROBLEMS[:2] if quick else PROBLEMS:
        for seed in range(first, first + (1 if quick else N_STARTS)):
            peers.append(peer_row(problem, seed))
            print("...", *peers[-1].values(), flush=True)
    text = page(pd.DataFrame(far), pd.DataFrame(peers))
    publish("identify.md", text, not quick)


if __name__ == "__main__":
    main(flag("quick"))
