"""Starting values: states by smoothing, linear coefficients by a convex program, frequencies by a scan.

The loss with the midpoint rule is convex in the coefficients that enter linearly while R is fixed, so CVXPY solves it
to its global optimum. A frequency is a needle that no local solver finds: it is scanned, with the amplitudes (linear
once the frequency is fixed) solved at every step of the scan.
"""

import warnings
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import cvxpy as cp
import numpy as np

from phsi_opt.errors import DataError, SolveError
from phsi_opt.expressions import names_of
from phsi_opt.fit import Fit
from phsi_opt.grid import Grid, defect_jacobian, defects, output_slopes, outputs
from phsi_opt.guesses import corners
from phsi_opt.losses import ForcePrior, Point, complete, rate_size
from phsi_opt.measurements import Measurements
from phsi_opt.missing import ForceEstimate, Known, estimate_force
from phsi_opt.model import Model, place_of
from phsi_opt.noise import difference_noise
from phsi_opt.terms import Scan
from phsi_opt.theta import Theta

SCHEME = "midpoint"  # one evaluation of the right-hand side: linear where the model is
ROUNDER = (1.0, 4.0, 16.0, 64.0)  # factors on the width of corners that are too sharp
N_STARTS = 3  # frequencies of the scan that are tried
SHALLOW = 1e-6  # slope of a sensor below which it says nothing about its state
CLEANEST = (
    1e-5  # least noise that is assumed, as a share of the spread of a channel: weights stay within double precision
)


def initial_noise(data: Measurements, given: np.ndarray | None = None) -> np.ndarray:
    """Noise per state to start from: the given one, else from differences of the data; 1 where nothing was measured."""
    guess = difference_noise(data) if given is None else given
    y = np.concatenate([run.x for run in data.trajectories])
    seen = [name in data.measured for name in data.states]
    if not any(np.nanmax(y[:, k]) > np.nanmin(y[:, k]) for k in range(len(seen)) if seen[k]):
        raise DataError(
            f"every measured value of {', '.join(data.measured)} is the same ({np.nanmax(y):g}): nothing moves, so "
            "nothing can be identified. Check the columns, or measure while the system moves."
        )
    spread = np.array([np.nanstd(y[:, k]) if seen[k] else 1.0 for k in range(len(seen))])
    spread = np.where(spread > 0, spread, np.maximum(np.abs(np.nan_to_num(y)).max(axis=0), 1e-12))
    guess = np.where(np.isfinite(guess), guess, 0.1 * spread)
    return np.where([name in data.measured for name in data.states], np.maximum(guess, least_noise(y)), 1.0)


def least_noise(y: np.ndarray) -> np.ndarray:
    """Least noise that is assumed per channel of y (n_samples, n_states): without any, weights would be infinite."""
    seen = np.isfinite(y).any(axis=0)
    spread = np.array([np.nanstd(y[:, k]) if seen[k] else 1.0 for k in range(y.shape[1])])
    size = np.maximum(np.abs(np.nan_to_num(y)).max(axis=0), 1e-12)
    return CLEANEST * np.where(spread > 1e-12 * size, spread, size)


def first_point(model: Model, grid: Grid, theta: np.ndarray | None = None) -> Point:
    """Measured states interpolated, others zero, with the size of every state taken from the data."""
    grid = unsensed(model, grid)
    x, scale, measured = np.nan_to_num(grid.y), np.full(model.n_states, np.nan), grid.measured
    runs = list(pairwise([*grid.first.tolist(), grid.n_nodes]))
    for k in range(model.n_states):
        for begin, end in runs if not measured[:, k].all() else []:
            node, seen = np.arange(begin, end), begin + np.flatnonzero(measured[begin:end, k])
            if len(seen):
                x[node, k] = np.interp(grid.t[node], grid.t[seen], grid.y[seen, k])
        if measured[:, k].any():
            spread = np.nanstd(grid.y[:, k])
            scale[k] = spread if spread > 0 else max(abs(float(np.nanmean(grid.y[:, k]))), 1e-12)
    theta = np.array([model.values[name] for name in model.free]) if theta is None else theta
    scale = _unmeasured_scale(model, grid, theta, x, scale)
    return Point(theta, x, theta_scale(model, grid, theta, x, scale), scale)


def point_at(model: Model, grid: Grid, unknown: Theta, theta: np.ndarray, x: np.ndarray) -> Point:
    """The point of theta (in the order of ``unknown``) and the states x at the nodes, with the size of each."""
    measured = first_point(model, grid).x_scale
    x_scale = np.where(grid.measured.any(axis=0), measured, np.maximum(np.std(x, axis=0), 1e-12))
    sizes = theta_scale(model, grid, unknown.means(theta), x, x_scale)
    return Point(theta, x, unknown.spread(sizes), x_scale)


def from_fit(model: Model, start: Fit) -> np.ndarray:
    """The model's parameters at the values of a fit, where it has them."""
    return np.array([start.values.get(name, model.values[name]) for name in model.free])


def unsensed(model: Model, grid: Grid) -> Grid:
    """The grid with the states that the sensors, with the parameters' present values, show as what was measured."""
    if not model.sensor:
        return grid
    theta, x = np.array([model.values[name] for name in model.free]), grid.y.copy()
    with np.errstate(all="ignore"):
        for _ in range(10):  # Newton's method for every channel alone
            missed = grid.y - np.array(outputs(model, grid, np.nan_to_num(x).T, theta)).T
            slope = np.einsum("aii->ai", output_slopes(model, grid, np.nan_to_num(x), theta)[0])
            step = missed / np.where(np.abs(slope) > SHALLOW, slope, np.nan)
            x = x + np.where(np.isfinite(step), step, 0.0)
    return replace(grid, y=x)


def _unmeasured_scale(model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Size of a state that nobody measured: what the measured rates say through the model, else one."""
    if np.all(np.isfinite(scale)):
        return scale
    known = np.isfinite(scale)
    rate = np.sqrt(np.mean(np.square(_smooth_rates(grid, x)), axis=0))
    slopes = np.abs(_state_slopes(model, grid, theta, x))
    result = scale.copy()
    for k in np.flatnonzero(~known):
        ratios = [rate[i] / slopes[i, k] for i in np.flatnonzero(known) if slopes[i, k] > 0]
        result[k] = min(ratios) if ratios else 1.0
    return result


def _smooth_rates(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Rates over longer stretches, where the noise of a sample no longer dominates."""
    stride = max(1, grid.n_nodes // 200)
    same = grid.trajectory[:-stride] == grid.trajectory[stride:]
    span = (grid.t[stride:] - grid.t[:-stride])[same]
    return (x[stride:] - x[:-stride])[same] / span[:, None] if same.any() else grid.rates(x)


def _state_slopes(model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
    rhs = model.rhs()
    jacobian = rhs.jacobian()
    rows = np.linspace(0, grid.n_nodes - 1, 25).astype(int)
    # Away from the origin, where a higher-order term has no slope.
    shifted = x + np.where(np.all(x == 0, axis=0), 1.0, 0.0)
    slopes = [np.array(jacobian(shifted[i], grid.u[i], grid.t[i], theta, 0)[0]) for i in rows]
    return np.sqrt(np.mean(np.nan_to_num(np.square(slopes)), axis=0))


def theta_scale(model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray, x_scale: np.ndarray) -> np.ndarray:
    """Size of each parameter: the change that moves some equation by the size of its own rate. Follows the units."""
    if not len(theta):
        return np.ones(0)
    rate = np.sqrt(np.mean(np.square(_smooth_rates(grid, x)), axis=0))
    rate = np.where(rate > 0, rate, x_scale)
    jacobian = np.array(defect_jacobian(model, grid, SCHEME)(x.T, theta))
    slopes = jacobian.reshape(grid.n_intervals, -1, len(theta))
    n_finite = np.maximum(np.isfinite(slopes).sum(axis=0), 1)
    per_equation = np.sqrt(np.nansum(slopes**2, axis=0) / n_finite) / rate[:, None]
    strength = np.nan_to_num(per_equation.max(axis=0))
    if model.sensor:  # a sensor's parameter moves what is shown, by the size of the state
        strength = np.maximum(strength, _sensor_strength(model, grid, theta, x) @ (1 / x_scale))
    fallback = np.where(np.abs(theta) > 0, np.abs(theta), 1.0)
    scale = np.where(strength > 0, 1 / np.maximum(strength, 1e-300), fallback)
    # A parameter far from its start in units of its effect would meet the solver as a huge number.
    return np.maximum(scale, 1e-3 * np.abs(theta))


def _sensor_strength(model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Root mean square over the nodes of the slope of what is shown in each parameter, (n_free, n_states)."""
    slopes, rows = model.output().jacobian(), np.linspace(0, grid.n_nodes - 1, 50).astype(int)
    found = [np.array(slopes(x[i], grid.u[i], grid.t[i], theta, 0)[3]) for i in rows]
    return np.sqrt(np.mean(np.square(found), axis=0)).T


def smoothed(
    model: Model, grid: Grid, sigma: np.ndarray, integrator: str, known_noise: Known, theta: np.ndarray | None = None,
    *, rounds: int = 3, prior: ForcePrior | None = None,
) -> ForceEstimate:  # fmt: skip
    """States, also unmeasured ones, by the missing-force program at the model's present values.

    ``theta``: other values, (n_free, n_trajectories) where trajectories have parameters of their own. Where a corner of
    dry friction is too sharp for the search, it is rounded.
    """
    point = first_point(model, grid)
    point = point if theta is None else replace(point, theta=theta)
    widths = {name: model.values[name] for name in corners(model)}
    for factor in ROUNDER if widths else (1.0,):
        rounded = {} if factor == 1 else {name: factor * width for name, width in widths.items()}
        try:
            found = estimate_force(
                model.with_values(rounded), grid, point, sigma, rounds=rounds, known_noise=known_noise, prior=prior,
                integrator=integrator,
            )  # fmt: skip
            return replace(found, rounded=rounded)
        except SolveError as error:
            failure = error
    raise failure


def starting_values(model: Model, grid: Grid, l1: dict[str, float]) -> list[np.ndarray]:
    """Starting points of theta (best first) for data whose states are all known (``grid.y``)."""
    grid = complete(model, grid)
    theta = np.array([model.values[name] for name in model.free])
    groups = _linear_groups(model, grid)
    scans = _scans(model)
    theta = _convex_rounds(model, grid, theta, groups, l1, rounds=1)
    starts = [theta]
    for name, amplitudes, variable in scans:
        scanned = []
        for start in starts:
            for omega in _candidate_frequencies(model, grid, start, groups, name, amplitudes, variable):
                moved = _moved(start, model.free.index(name), omega)
                # The start carries what the polynomials explained before the wave was there; begin again beside it.
                scanned.append(_convex_rounds(model, grid, moved, groups, l1, rounds=2))
        starts = sorted(scanned, key=lambda s: _squared_defects(model, grid, s))[:N_STARTS]
    return starts


def _linear_groups(model: Model, grid: Grid) -> list[list[int]]:
    """Groups of parameters that enter the right-hand side linearly while the others are fixed: H and F, then R."""
    rhs = model.rhs()
    arguments = [ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(rhs.n_in())]
    theta, dx = arguments[-1], rhs(*arguments)
    entries = [model.entries[name] for name in model.free]
    has_start = [e.parameter.value is not None and not e.prunable for e in entries]
    groups = []
    for slots in (("H", "F"), ("R",)):
        members: list[int] = []
        inside = [i for i, e in enumerate(entries) if e.slot in slots and not has_start[i]]
        # Coefficients first: a frequency beside them would make its amplitudes look curved.
        for tried in ([i for i in inside if entries[i].prunable], [i for i in inside if not entries[i].prunable]):
            both = members + tried
            curved = _curved(dx, theta, both)
            members = [i for i, bent in zip(both, curved, strict=True) if not bent or i in members]
        groups.append(sorted(members))
    return [group for group in groups if group]


def _curved(dx: ca.SX, theta: ca.SX, members: list[int]) -> list[bool]:
    if not members:
        return []
    chosen = theta[members]
    slopes = ca.jacobian(dx, chosen)
    return [ca.depends_on(slopes[:, i], chosen) for i in range(len(members))]


def _convex_rounds(
    model: Model, grid: Grid, theta: np.ndarray, groups: list[list[int]], l1: dict[str, float], rounds: int
) -> np.ndarray:
    for _ in range(rounds):
        for group in groups:
            theta = convex(model, grid, theta, group, l1)
    return theta


def convex(
    model: Model, grid: Grid, theta: np.ndarray, group: list[int], l1: dict[str, float], scheme: str = SCHEME,
) -> np.ndarray:  # fmt: skip
    """The PHSI loss over the coefficients ``group``, others fixed, as a convex program; exact where it is convex."""
    jacobian = np.array(defect_jacobian(model, grid, scheme)(grid.y.T, theta))[:, group]
    d = np.array(defects(model, grid, scheme, ca.DM(grid.y.T), theta)).T.ravel()
    usable = np.isfinite(jacobian).all(axis=1) & np.isfinite(d)
    weight = np.sqrt(1 / (rate_size(grid) * grid.n_intervals))
    entries = [model.entries[model.free[i]] for i in group]
    scale = 1 / np.maximum(np.linalg.norm(weight * jacobian[usable], axis=0), 1e-12)
    A, b = weight * jacobian[usable] * scale, weight * (jacobian[usable] @ theta[group] - d[usable])
    q, r = np.linalg.qr(A)
    z = cp.Variable(len(group))
    lam = np.array([l1.get(e.slot, 0.0) if e.prunable else 0.0 for e in entries]) / rate_size(grid)
    objective = cp.sum_squares(r @ z - q.T @ b) + cp.sum(cp.multiply(lam * scale, cp.abs(z)))
    limits = [(z[i] >= e.parameter.lower / scale[i]) for i, e in enumerate(entries) if np.isfinite(e.parameter.lower)]
    limits += [(z[i] <= e.parameter.upper / scale[i]) for i, e in enumerate(entries) if np.isfinite(e.parameter.upper)]
    with warnings.catch_warnings():  # a start need not be accurate to the last digit
        warnings.simplefilter("ignore", UserWarning)
        cp.Problem(cp.Minimize(objective), limits).solve(
            solver=cp.CLARABEL, tol_gap_abs=1e-14, tol_gap_rel=1e-12, tol_feas=1e-12
        )
    result = theta.copy()
    if z.value is not None and np.all(np.isfinite(z.value)):
        bounds = np.array([(e.parameter.lower, e.parameter.upper) for e in entries])
        result[group] = np.clip(z.value * scale, bounds[:, 0], bounds[:, 1])
    return result


def _scans(model: Model) -> list[tuple[str, list[str], str]]:
    """Frequencies to scan: name, names of the amplitudes that share it, variable."""
    found: dict[str, tuple[str, list[str], str]] = {}
    for slot, equation, term in model.placed():
        for inner, parameter in term.inner.items():
            if isinstance(parameter.guess, Scan) and parameter.value is None and term.coefficient is not None:
                place = place_of(slot, equation)
                name = term.inner_name(inner, place)
                found.setdefault(name, (name, [], parameter.guess.variable))[1].append(term.coefficient_name(place))
    return list(found.values())


def frequencies(grid: Grid, variable: np.ndarray) -> np.ndarray:
    """Frequencies worth trying: half a period over the record up to the Nyquist frequency, half a resolution apart."""
    span = float(np.ptp(variable))
    steps = np.abs(np.diff(variable)[np.diff(grid.trajectory) == 0])
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else span
    lowest = np.pi / span
    return np.arange(lowest, max(0.9 * np.pi / step, 2 * lowest), lowest / 2)[:4000]


def _candidate_frequencies(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    groups: list[list[int]],
    name: str,
    amplitudes: list[str],
    variable: str,
) -> list[float]:
    """Peaks of two scans: beside all other terms, and beside those alone that do not contain the variable.

    Over a short record a polynomial in the time imitates a slow wave, so beside it only fast waves stand out.
    """
    beside_all = [i for group in groups for i in group]
    along = {
        term.coefficient_name(place_of(slot, equation))
        for slot, equation, term in model.placed()
        if slot == "F" and variable in names_of(term.body)
    }
    inner = [i for i in beside_all if model.free[i] not in along]
    found = []
    for others in [beside_all] if inner == beside_all else [inner, beside_all]:
        found += _best_frequencies(model, grid, theta, others, name, amplitudes, variable)[: N_STARTS - 1]
    return list(dict.fromkeys(found))


def _squared_defects(model: Model, grid: Grid, theta: np.ndarray) -> float:
    return float(np.nansum(np.square(np.array(defects(model, grid, SCHEME, ca.DM(grid.y.T), theta)))))


def _best_frequencies(
    model: Model, grid: Grid, theta: np.ndarray, beside: list[int], name: str, amplitudes: list[str], variable: str
) -> list[float]:
    """The frequencies with the deepest local minima of the squared defects, amplitudes and all linear terms free."""
    order = list(model.free)
    own = [order.index(a) for a in amplitudes]
    others = [i for i in beside if i not in own]
    start = theta.copy()
    start[[i for i, n in enumerate(order) if model.entries[n].prunable and i not in others]] = 0.0
    d = np.array(defects(model, grid, SCHEME, ca.DM(grid.y.T), start)).T.ravel()
    base = np.array(defect_jacobian(model, grid, SCHEME)(grid.y.T, start))[:, others]
    keep, _ = np.linalg.qr(base) if others else (np.zeros((len(d), 0)), None)
    d = d - keep @ (keep.T @ d)
    along = np.array(
        model.function(variable).map(grid.n_nodes)(
            grid.y.T, grid.u.T, grid.t[None, :], ca.repmat(start, 1, grid.n_nodes)
        )
    ).ravel()
    grid_omega = frequencies(grid, along)
    columns = defect_jacobian(model, grid, SCHEME, own)
    drop = np.array(
        [_explained(d, keep, np.array(columns(grid.y.T, _moved(start, order.index(name), w)))) for w in grid_omega]
    )
    padded = np.r_[-np.inf, drop, -np.inf]
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    return [float(grid_omega[i]) for i in peaks[np.argsort(-drop[peaks])][:N_STARTS]]


def _moved(theta: np.ndarray, index: int, value: float) -> np.ndarray:
    result = theta.copy()
    result[index] = value
    return result


def _explained(d: np.ndarray, keep: np.ndarray, columns: np.ndarray) -> float:
    """How much of |d|^2 the columns explain beyond the space ``keep``."""
    columns = columns - keep @ (keep.T @ columns)
    solution = np.linalg.lstsq(columns, d, rcond=1e-8)[0]
    return float(np.sum((columns @ solution) ** 2))


def with_states(grid: Grid, x: np.ndarray) -> Grid:
    """The grid as if x had been measured at every node."""
    return replace(grid, y=x)
