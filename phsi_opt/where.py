"""Where a model fails: times, region of the states, frequencies of the missing force, and what it follows.

The missing force is an estimate along the record (`missing`). Whether it follows a variable is judged on stretches of
time that were left out: a function of that variable is fitted to the other stretches and has to predict the force on
these, so that nothing is earned by flexibility. The estimate is smooth where the record is noisy, dry friction has lost
its corners; so a function is looked at as the same estimate would show it.

What to keep in mind: parameters of the model were fitted without the effect and have imitated what they could of it.
Dry friction comes as friction less the damping that stood in for it, a cubic spring as the cubic less a linear one. So
the model's parameters move along here: what other values of them would explain is counted apart, under 'parameters'.
Size and sign of the force in the tables are those of the difference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
from scipy.fft import next_fast_len
from scipy.sparse.linalg import spsolve
from scipy.stats import rankdata

from phsi_opt.fit import Fit
from phsi_opt.missing import ForceEstimate, force_deviation, positions
from phsi_opt.model import FirstOrder, Model

N_FOLDS, N_STRETCHES = 5, 40  # the record is cut into stretches; every fifth is left out in turn
N_KNOTS, N_PAIR_KNOTS, N_TIME_KNOTS = 12, 7, 6  # of piecewise linear functions of one variable, of two, of the time
RIDGE = 1e-3  # weight of the smallness of coefficients, in samples per knot
MOST_PAIRS = 6  # pairs of states that are looked at
SCANNED = 3000  # intervals (drawn at random where there are more) on which a frequency is refined
LONGEST = 2**18  # points to which a trajectory is resampled for its spectrum
N_WINDOWS, N_BINS = 10, 8  # parts of a trajectory, and of the range of a state, in which the force's size is taken
STRONG = 1.3  # a part stands out when the force's size in it exceeds that of the whole record by this factor
SEEN = 1.0  # size of the force over its standard deviation below which nothing is said about it
CLEAR, SECOND, ADDS, TIED = 0.3, 0.2, 0.1, 0.05  # shares: a clear pattern; a second cause; worth a row; alike
MOST_SOLVED = 3e7  # numbers held at once for the standard deviation of the force


@dataclass(frozen=True, eq=False)
class Along:
    """The missing force and what it may depend on, at the middle of every interval.

    force (n_intervals, n_forced) of ``equations``; states, efforts and losses -R dH/dx of the model (n_intervals,
    n_states); inputs (n_intervals, n_inputs); slopes (n_intervals, n_states, n_moving) of dx/dt in the parameters that
    are free to move, each of rms one; run: number of the trajectory.
    """

    fit: Fit
    estimate: ForceEstimate
    equations: tuple[str, ...]
    t: np.ndarray
    h: np.ndarray
    run: np.ndarray
    force: np.ndarray
    states: np.ndarray
    efforts: np.ndarray
    inputs: np.ndarray
    losses: np.ndarray
    slopes: np.ndarray

    def variable(self, name: str) -> np.ndarray:
        """Values of a state, an effort, an input or the time ``t``."""
        model = self.fit.model
        known = {"t": self.t, **dict(zip(model.efforts, self.efforts.T, strict=True))}
        known |= dict(zip(model.states, self.states.T, strict=True))
        return (known | dict(zip(model.inputs, self.inputs.T, strict=True)))[name]

    def own(self, equation: str) -> np.ndarray:
        """The effort of an equation: the velocity, for a momentum."""
        return self.efforts[:, self.fit.model.states.index(equation)]

    def of(self, equation: str) -> np.ndarray:
        """The missing force of an equation."""
        return self.force[:, self.equations.index(equation)]

    def seen(self, equation: str, columns: np.ndarray) -> np.ndarray:
        """What the estimate would show of forces (n_intervals, k) on the equation: less what noise and prior hide.

        w_hat = w - C P^-1 w with the force's covariance P before and C after the measurements.
        """
        linear, (n_intervals, n_forced) = self.estimate.linear, self.force.shape
        at = np.arange(n_intervals) * n_forced + self.equations.index(equation)
        shown = np.empty_like(columns)
        n_parts = 1 + int(linear.n_total * columns.shape[1] / MOST_SOLVED)  # so that they fit in memory
        for part in np.array_split(np.arange(columns.shape[1]), n_parts):
            force, right = np.zeros((linear.n_w, len(part))), np.zeros((linear.n_total, len(part)))
            force[at] = columns[:, part]
            right[linear.n_x : linear.n_x + linear.n_w] = linear.L.T @ (linear.L @ force)
            shown[:, part] = columns[:, part] - linear.factor.solve(right)[linear.n_x + at]
        return shown

    def imitated(self, equation: str) -> np.ndarray:
        """Slopes of the equation in the parameters that act in it, as the estimate would show them."""
        columns = self.slopes[:, self.fit.model.states.index(equation)]
        return self.seen(equation, columns[:, np.any(columns != 0, axis=0)])


def along(fit: Fit, estimate: ForceEstimate, runs: Sequence[str] = ()) -> Along:
    """Lay out the missing force with states, efforts and inputs; ``runs`` names the trajectories.

    Names matter only where trajectories have parameters of their own.
    """
    grid, model, x = estimate.grid, fit.model, estimate.x
    middle = (x[grid.begin] + x[grid.begin + 1]) / 2
    u, t = (grid.u0 + grid.u1) / 2, grid.t[grid.begin] + grid.h / 2
    run = grid.trajectory[grid.begin]
    own = [fit.by_trajectory.get(name, {}) for name in runs] or [{}] * (int(run[-1]) + 1)
    theta = np.array([[{**fit.values, **values}[name] for values in own] for name in model.free])
    at = (middle.T, u.T, t[None, :], theta[:, run] if len(theta) else ca.DM(0, len(t)))
    efforts = np.array(model.function(*model.efforts).map(len(t))(*at)).T
    frozen, none = model.frozen(), ca.DM(0, len(t))
    with_loss, without = (m.rhs().map(len(t))(*at[:3], none) for m in (frozen, replace(frozen, R={})))
    equations = tuple(model.states[row] for row in estimate.prior.rows)
    return Along(
        fit=fit, estimate=estimate, equations=equations, t=t, h=grid.h, run=run,
        force=estimate.w, states=middle, efforts=efforts, losses=np.array(with_loss - without).T, inputs=u,
        slopes=_slopes(model, at, len(t)),
    )  # fmt: skip


def _slopes(model: Model, at: tuple[Any, ...], n: int) -> np.ndarray:
    """Slopes of dx/dt in the parameters that do not stand at a bound, of rms one, (n, n_states, n_moving)."""
    rhs = model.rhs()
    x, u, t, theta = (ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(4))
    columns = ca.densify(ca.jacobian(rhs(x, u, t, theta), theta)[:, _moving(model)])
    flat = np.array(ca.Function("slopes", [x, u, t, theta], [ca.vec(columns.T)]).map(n)(*at))
    slopes = np.nan_to_num(flat.T.reshape(n, model.n_states, -1))
    size = np.sqrt(np.mean(slopes**2, axis=0))
    return np.asarray(slopes / np.where(size > 0, size, 1.0))


def _moving(model: Model) -> list[int]:
    """Places in theta of the parameters that do not stand at a bound."""

    def moves(name: str) -> bool:
        p, value = model.entries[name].parameter, model.values[name]
        finite = [bound for bound in (p.lower, p.upper) if np.isfinite(bound)]
        return all(abs(value - bound) > 1e-6 * max(1.0, abs(bound)) for bound in finite)

    return [i for i, name in enumerate(model.free) if moves(name)]


def located(fit: Fit, estimate: ForceEstimate, runs: Sequence[str] = ()) -> pd.DataFrame:
    """Where the missing force of every equation is strong, strongest first; a row per equation that may lack one.

    Columns: equation; trajectory (its name from ``runs``, else its number) and time_window where it is strongest;
    state_region where it is strong; frequency (cycles per unit of time; 0 for a force that is mostly constant);
    strength (rms); times_noise (strength over the typical standard deviation of the estimate: below 1 it is not sure).
    """
    path, times = along(fit, estimate, runs), _times_noise(estimate)
    rows = []
    for k, name in enumerate(path.equations):
        w = path.force[:, k]
        strength = _rms(w)
        run, window = _window(path, w)
        trajectory = runs[run] if len(runs) else run
        rows.append(
            (name, trajectory, window, region_of(path, w, fit.model.states), _frequency(path, w), strength, times[k])
        )
    columns = ["equation", "trajectory", "time_window", "state_region", "frequency", "strength", "times_noise"]
    return pd.DataFrame(rows, columns=columns).sort_values("strength", ascending=False, ignore_index=True)


def _times_noise(estimate: ForceEstimate) -> np.ndarray:
    """Size of the force over its typical (median) standard deviation, per equation.

    Both are those of the last sizes of force and noise: while the force's size still falls towards zero, the stored
    force is that of a larger size, and would seem certain.
    """
    linear, typical = estimate.linear, np.median(deviation_of(estimate), axis=0)
    force = spsolve(linear.L, linear.innovations).reshape(estimate.w.shape)
    return np.asarray(np.sqrt(np.mean(force**2, axis=0)) / np.maximum(typical, 1e-300))


def deviation_of(estimate: ForceEstimate) -> np.ndarray:
    """Standard deviation of the force, (n_intervals, n_forced), at as many intervals as fit in memory, else between."""
    return force_deviation(estimate, int(np.clip(MOST_SOLVED / estimate.linear.n_total, 16, 400)))


def _rms(w: np.ndarray) -> float:
    return float(np.sqrt(np.mean(w**2)))


def _sizes(w: np.ndarray, part: np.ndarray, n_parts: int) -> np.ndarray:
    """Root mean square of w in every part; 0 for an empty one."""
    count = np.bincount(part, minlength=n_parts)
    return np.sqrt(np.bincount(part, w**2, n_parts) / np.maximum(count, 1))


def _window(path: Along, w: np.ndarray) -> tuple[int, str]:
    """Number of the trajectory, and the tenth of it, where the force is strongest."""
    count = np.bincount(path.run)
    place = np.arange(len(w)) - (np.cumsum(count) - count)[path.run]
    part = path.run * N_WINDOWS + place * N_WINDOWS // count[path.run]
    size = _sizes(w, part, len(count) * N_WINDOWS)
    best = int(np.argmax(size))
    if size[best] > STRONG * _rms(w):
        inside, note = np.flatnonzero(part == best), ""
    else:
        inside, note = np.flatnonzero(path.run == best // N_WINDOWS), " (throughout)"
    first, last = inside[0], inside[-1]
    begin, end = path.t[first] - path.h[first] / 2, path.t[last] + path.h[last] / 2
    return best // N_WINDOWS, f"{begin:.3g} to {end:.3g}{note}"


def region_of(path: Along, w: np.ndarray, names: Sequence[str]) -> str:
    """Ranges of the variables in which the force is strong; 'everywhere' where none stands out."""
    found = []
    for name in names:
        z = path.variable(name)
        low, high = np.quantile(z, [0.01, 0.99])
        edges = np.unique(np.linspace(low, high, N_BINS + 1))
        if len(edges) < 2:
            continue
        part = np.clip(np.searchsorted(edges, z) - 1, 0, len(edges) - 2)
        enough = np.bincount(part, minlength=len(edges) - 1) > 0.02 * len(w)
        strong = enough & (_sizes(w, part, len(edges) - 1) > STRONG * _rms(w))
        if 1 <= np.count_nonzero(np.diff(np.r_[False, strong].astype(int)) == 1) <= 2 and not strong.all():
            found.append(f"{name} {_stretches(edges, strong)}")
    return ", ".join(found) or "everywhere"


def _stretches(edges: np.ndarray, strong: np.ndarray) -> str:
    """Neighbouring strong bins joined: '-1 to -0.6 or 0.7 to 1'."""
    change = np.diff(np.r_[False, strong, False].astype(int))
    begins, ends = edges[np.flatnonzero(change == 1)], edges[np.flatnonzero(change == -1)]
    return " or ".join(f"{low:.3g} to {high:.3g}" for low, high in zip(begins, ends, strict=True))


def _frequency(path: Along, w: np.ndarray) -> float:
    """Frequency at which the force is strongest, in cycles per unit of time; 0 where most of it is constant."""
    if np.mean(w) ** 2 > np.mean(w**2) / 2:
        return 0.0
    f, amplitude = spectrum(path.t, path.run, w - np.mean(w))
    return float(f[np.argmax(amplitude)]) if amplitude.any() else 0.0


def spectrum(t: np.ndarray, run: np.ndarray, w: np.ndarray, n_points: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (cycles per unit of time) and amplitudes of w (n,) or (n, k): a sine of amplitude A has the peak A.

    Trajectories are resampled to even steps, tapered (Hann), and averaged in the mean square. There are ``n_points``
    frequencies per resolved one; those below one cycle per longest trajectory are left out.
    """
    edges = [*np.flatnonzero(np.diff(run, prepend=run[0] - 1)), len(t)]
    spans = [(a, b) for a, b in pairwise(edges) if b - a > 2]
    duration = max((float(t[b - 1] - t[a]) for a, b in spans), default=0.0)
    if duration == 0.0:
        return np.zeros(1), np.zeros((1, *w.shape[1:]))
    step = max(min(float(np.median(np.diff(t[a:b]))) for a, b in spans), duration / LONGEST)
    n_fft = next_fast_len(n_points * int(duration / step + 2), real=True)
    power = np.zeros((n_fft // 2 + 1, *w.shape[1:]))
    for a, b in spans:
        power += (b - a) / len(t) * _amplitude(t[a:b], w[a:b], step, n_fft) ** 2
    f = np.fft.rfftfreq(n_fft, step)
    kept = f >= 0.999 / duration
    return f[kept], np.sqrt(power[kept])


def _amplitude(t: np.ndarray, w: np.ndarray, step: float, n_fft: int) -> np.ndarray:
    even = np.arange(t[0], t[-1] + step / 2, step)
    taper = np.hanning(len(even) + 2)[1:-1]
    columns = w.reshape(len(t), -1).T
    sampled = np.array([np.interp(even, t, column) for column in columns]).T * taper[:, None]
    amplitude = 2 * np.abs(np.fft.rfft(sampled, n_fft, axis=0)) / taper.sum()
    return amplitude.reshape(-1, *w.shape[1:])


def uncertain(estimate: ForceEstimate, n_draws: int = 24, seed: int = 0) -> np.ndarray:
    """Draws of the estimate's error, (n_intervals, n_forced, n_draws), with its correlation in time.

    They are solutions of the linearised problem for random noise and random innovations of the prior, whose covariance
    is that of the force given the measurements.
    """
    linear, rng = estimate.linear, np.random.default_rng(seed)
    right = np.zeros((linear.n_total, n_draws))
    right[: linear.n_x] = linear.seen_of.T @ rng.normal(size=(linear.seen_of.shape[0], n_draws))
    w = slice(linear.n_x, linear.n_x + linear.n_w)
    right[w] = linear.L.T @ rng.normal(size=(linear.L.shape[0], n_draws))
    return np.asarray(linear.factor.solve(right)[w]).reshape(*estimate.w.shape, n_draws)


# What the force follows


def depends_on(fit: Fit, estimate: ForceEstimate, runs: Sequence[str] = ()) -> pd.DataFrame:
    """What every missing force follows, best first: equation, variable, share, explained.

    ``variable`` is a state, an effort that is not a monotone function of a state, an input, the time ``t`` (slow
    changes, and a wave with its second harmonic, of one phase in all trajectories), or a pair of states ('q, p').
    ``share`` is the part of the force's variance, beside what the model's own parameters would explain, that a
    piecewise linear function of the variable predicts on stretches of time that were left out; 0 where it predicts
    worse than the mean. Two rows stand behind the variables that add a tenth to them: 'constant' and 'parameters', with
    the parts of the mean square that the mean alone, and other values of the model's parameters alone, predict.
    ``explained`` is the rms of what is predicted, of the mean and the parameters as well.
    """
    path = along(fit, estimate, runs)
    return pd.concat([_dependence(path, name) for name in path.equations], ignore_index=True)


def _dependence(path: Along, equation: str) -> pd.DataFrame:
    w, fold, base = path.of(equation), _folds(path.run), path.imitated(equation)
    total, mean = float(np.sum(w**2)), path.seen(equation, np.ones((len(w), 1)))
    constant = _left_out([mean], w, fold)
    rows = [("constant", _share(constant, total), constant, ADDS)]
    left, fixed = constant, [mean]
    if base.shape[1]:
        parameters = _left_out([base], w, fold)
        rows.append(("parameters", _share(parameters, total), parameters, ADDS))
        if (both := _left_out([mean, base], w, fold)) < left:
            left, fixed = both, [mean, base]
    rows.sort(key=lambda row: row[2])
    for variable in variables(path, equation):
        if variable == "t":
            error = _left_out_of_time(path, fixed, w, fold)
        else:
            error = _left_out([*fixed, path.seen(equation, _functions(path, variable))], w, fold)
        error = min(error, left)
        rows.append((variable, _share(error, left), error, (left - error) / max(total, 1e-300)))
    frame = pd.DataFrame(rows, columns=["variable", "share", "error", "adds"])
    frame.insert(0, "equation", equation)
    frame["explained"] = np.sqrt(np.maximum(total - frame.pop("error"), 0.0) / len(w))
    return frame.sort_values("adds", ascending=False, kind="stable").drop(columns="adds")


def variables(path: Along, equation: str) -> list[str]:
    """Names of what the force of an equation may follow; its own effort and position come first."""
    model = path.fit.model
    single = [name for name in model.states if np.ptp(path.variable(name)) > 0]
    ranks = [_ranks(path.variable(name)) for name in single]
    for name in model.efforts:
        rank = _ranks(path.variable(name))
        if np.ptp(path.variable(name)) > 0 and not any(abs(rank @ other) > 0.9999 for other in ranks):
            single.append(name)
            ranks.append(rank)
    moving = [name for name in model.inputs if np.ptp(path.variable(name)) > 0]
    states = [name for name in single if name in model.states]
    pairs = [f"{a}, {b}" for i, a in enumerate(states) for b in states[i + 1 :]]
    own = [pair for pair in pairs if equation in pair.split(", ")]
    return [*single, *moving, "t", *(own + [p for p in pairs if p not in own])[:MOST_PAIRS]]


def _ranks(z: np.ndarray) -> np.ndarray:
    """Centred ranks of length 1, of at most 2000 of the values: their product is the rank correlation."""
    rank = rankdata(z[:: max(1, len(z) // 2000)])
    rank = rank - rank.mean()
    return np.asarray(rank / max(float(np.linalg.norm(rank)), 1e-300))


def _folds(run: np.ndarray) -> np.ndarray:
    """Which of the folds leaves each interval out: stretches of each trajectory, dealt in turn."""
    count = np.bincount(run)
    n_stretches = np.clip(np.round(N_STRETCHES * count / len(run)), 1, np.maximum(count, 1)).astype(int)
    place = np.arange(len(run)) - (np.cumsum(count) - count)[run]
    before = np.cumsum(n_stretches) - n_stretches
    return np.asarray((before[run] + place * n_stretches[run] // count[run]) % N_FOLDS)


def _left_out(columns: Sequence[np.ndarray], w: np.ndarray, fold: np.ndarray) -> float:
    """Sum of squares that a least-squares fit to the other stretches leaves on those left out."""
    joined = np.hstack(columns)
    parts = [(joined[fold == f], w[fold == f]) for f in np.unique(fold)]
    grams, slopes = [part.T @ part for part, _ in parts], [part.T @ y for part, y in parts]
    error = 0.0
    for i, (part, y) in enumerate(parts):
        c = _solved(sum(grams) - grams[i], sum(slopes) - slopes[i])
        error += float(np.sum((y - part @ c) ** 2))
    return error


def _solved(gram: np.ndarray, slope: np.ndarray) -> np.ndarray:
    weight = RIDGE * np.trace(gram) / max(len(gram), 1) + 1e-300
    return np.asarray(np.linalg.solve(gram + weight * np.eye(len(gram)), slope))


def _share(error: float, total: float) -> float:
    return max(0.0, 1 - error / total) if total > 0 else 0.0


def cleaned(path: Along, equation: str, variable: str) -> np.ndarray:
    """The force less what the model's parameters explain beside functions of the variable: what to plot against it."""
    w, functions, base = path.of(equation), _functions(path, variable), path.imitated(equation)
    functions = path.seen(equation, functions)
    beside = base - functions @ np.linalg.lstsq(functions, base, rcond=1e-6)[0]
    joint = np.hstack([functions, beside])
    c = np.linalg.lstsq(joint, w, rcond=1e-6)[0]
    return np.asarray(w - beside @ c[functions.shape[1] :])


def _functions(path: Along, variable: str) -> np.ndarray:
    names = variable.split(", ")
    if len(names) == 1:
        return _hats(path.variable(variable), N_KNOTS)
    return _pair(path.variable(names[0]), path.variable(names[1]))


def _left_out_of_time(path: Along, fixed: Sequence[np.ndarray], w: np.ndarray, fold: np.ndarray) -> float:
    """As `_left_out`, with functions of the time whose frequency is found anew for every fold."""
    error = 0.0
    for f in np.unique(fold):
        kept, columns = fold != f, np.hstack([*fixed, _of_time(path, w, fold != f)])
        c = _solved(columns[kept].T @ columns[kept], columns[kept].T @ w[kept])
        error += float(np.sum((w[~kept] - columns[~kept] @ c) ** 2))
    return error


def _knots(z: np.ndarray, n_knots: int) -> np.ndarray:
    """Half way between even spacing and even occupation; the extreme hundredths share the outer knots."""
    share = np.linspace(0.01, 0.99, n_knots)
    quantiles = np.quantile(z, share)
    return np.asarray(np.unique((quantiles + np.linspace(quantiles[0], quantiles[-1], n_knots)) / 2))


def _hats(z: np.ndarray, n_knots: int) -> np.ndarray:
    """Piecewise linear functions of z, constant beyond the outer knots, as columns that sum to one."""
    knots = _knots(z, n_knots)
    if len(knots) < 2:
        return np.ones((len(z), 1))
    right = np.clip(np.searchsorted(knots, z), 1, len(knots) - 1)
    fraction = np.clip((z - knots[right - 1]) / (knots[right] - knots[right - 1]), 0, 1)
    columns = np.zeros((len(z), len(knots)))
    columns[np.arange(len(z)), right - 1] = 1 - fraction
    columns[np.arange(len(z)), right] += fraction
    return columns


def _pair(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of piecewise linear functions of two variables."""
    of_a, of_b = _hats(a, N_PAIR_KNOTS), _hats(b, N_PAIR_KNOTS)
    return np.asarray((of_a[:, :, None] * of_b[:, None, :]).reshape(len(a), -1))


def _of_time(path: Along, w: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Slow functions of the time, and the wave (with its second harmonic) that fits best where ``kept``."""
    phase = 2 * np.pi * _wave(path, w, kept) * (path.t - path.t[0])
    waves = [f(n * phase) for n in (1, 2) for f in (np.sin, np.cos)]
    return np.column_stack([_hats(path.t, N_TIME_KNOTS), *waves])


def _wave(path: Along, w: np.ndarray, kept: np.ndarray) -> float:
    """Frequency of the wave that fits best where ``kept``, in cycles per unit of time, one phase in all runs."""
    left = np.where(kept, w - w[kept].mean(), 0.0)
    f, amplitude = spectrum(path.t, path.run, left)
    peaks = f[np.argsort(-amplitude * _is_peak(amplitude))[:3]]
    rng, places = np.random.default_rng(0), np.flatnonzero(kept)
    chosen = places if len(places) <= SCANNED else np.sort(rng.choice(places, SCANNED, replace=False))
    t, y = path.t[chosen] - path.t[0], left[chosen]
    width = 4 * (f[1] - f[0]) if len(f) > 1 else 0.0  # one resolved frequency
    for reach in (1.0, 0.1):  # about the peaks, then about the best
        tried = np.concatenate([peak + reach * width * np.linspace(-1, 1, 21) for peak in peaks])
        tried = tried[tried > 0] if (tried > 0).any() else peaks
        peaks = tried[[int(np.argmax(_fall(t, y, tried)))]]
    return float(peaks[0])


def _is_peak(a: np.ndarray) -> np.ndarray:
    padded = np.r_[0.0, a, 0.0]
    return np.asarray((a >= padded[:-2]) & (a >= padded[2:]))


def _fall(t: np.ndarray, y: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Fall of the sum of squares of y by a wave of each frequency."""
    phase = 2 * np.pi * np.outer(f, t)
    s, c = np.sin(phase), np.cos(phase)
    ss, cc, sc = np.sum(s * s, axis=1), np.sum(c * c, axis=1), np.sum(s * c, axis=1)
    a, b = s @ y, c @ y
    determinant = np.maximum(ss * cc - sc**2, 1e-9 * ss * cc + 1e-300)
    return np.asarray((a**2 * cc - 2 * a * b * sc + b**2 * ss) / determinant)


# Power


@dataclass(frozen=True, eq=False)
class Power:
    """What the missing force does with energy, as `power` found; ``sentences`` has one per equation.

    ``table`` has a row per equation: equation, mean_power (force times effort, averaged over the time; negative: taken
    out), parameters, constant, dissipated, conserved, inputs, time and unexplained. These shares are parts of the
    force's mean square on stretches of time left out, each what its cause adds to the stronger ones; they sum to one.
    """

    table: pd.DataFrame
    sentences: tuple[str, ...]


CAUSES = ("constant", "dissipated", "conserved", "inputs", "time")  # of two that are alike, the first is named
SHARES = ("parameters", *CAUSES)


def power(fit: Fit, estimate: ForceEstimate, runs: Sequence[str] = (), units: Mapping[str, str] | None = None) -> Power:
    """Whether the missing force w_i dissipates power w_i dH/dx_i, conserves it, or depends on inputs or the time.

    The force is explained by functions of five kinds: a constant; odd functions of its own effort dH/dx_i (dissipated);
    functions of the states that it exchanges energy with, the positions for a momentum (conserved: what goes in
    comes back on the same way); functions of the inputs; functions of the time. The model's own parameters move along.
    The kind that predicts the left-out stretches best comes first; others follow while they add a fifth.
    """
    path, rows, said = along(fit, estimate, runs), [], []
    for name in path.equations:
        causes = _Causes.of(path, name, units or {})
        shares = causes.in_turn()
        mean_power = float(np.sum(path.of(name) * path.own(name) * path.h) / np.sum(path.h))
        each = [shares.get(kind, 0.0) for kind in SHARES]
        rows.append((name, mean_power, *each, 1 - sum(each)))
        said.append(causes.sentence(shares))
    return Power(pd.DataFrame(rows, columns=["equation", "mean_power", *SHARES, "unexplained"]), tuple(said))


@dataclass(frozen=True, eq=False)
class _Causes:
    """Functions of every kind that may explain the force of one equation, and what each explains alone."""

    path: Along
    equation: str
    units: Mapping[str, str]
    fold: np.ndarray
    columns: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, path: Along, equation: str, units: Mapping[str, str]) -> "_Causes":
        bases = {"constant": np.ones((len(path.t), 1)), "dissipated": _odd(path.own(equation))}
        if partners := _partners(path, equation):
            bases["conserved"] = _sum_of(path, partners)
        if path.inputs.shape[1]:
            bases["inputs"] = _sum_of(path, path.fit.model.inputs)
        columns = {kind: path.seen(equation, base) for kind, base in bases.items()}
        columns["parameters"] = path.imitated(equation)
        return cls(path, equation, units, _folds(path.run), columns)

    def share(self, kinds: Sequence[str]) -> float:
        """Part of the force's mean square that functions of these kinds predict together on stretches left out."""
        w, fixed = self.path.of(self.equation), [self.columns[kind] for kind in kinds if kind != "time"]
        timed = "time" in kinds
        error = _left_out_of_time(self.path, fixed, w, self.fold) if timed else _left_out(fixed, w, self.fold)
        return _share(error, float(np.sum(w**2)))

    @cached_property
    def alone(self) -> dict[str, float]:
        """What each kind adds to other values of the model's parameters."""
        known = self.share(("parameters",))
        kinds = [kind for kind in CAUSES if kind in self.columns or kind == "time"]
        return {kind: self.share(("parameters", kind)) - known for kind in kinds}

    def in_turn(self) -> dict[str, float]:
        """What each kind adds to the stronger ones, while that is worth naming."""
        shares = {"parameters": self.share(("parameters",))}
        found, least = {kind: shares["parameters"] + adds for kind, adds in self.alone.items()}, 0.0
        while True:
            known = sum(shares.values())
            found = {kind: share for kind, share in found.items() if share > known + least}
            if not found:
                return shares
            kind = next(k for k in found if found[k] >= max(found.values()) - TIED / 2)
            shares[kind], least = found[kind] - known, SECOND
            found = {k: self.share((*shares, k)) for k in self.alone if k not in shares}

    def sentence(self, shares: Mapping[str, float]) -> str:
        """What the force does, in words, with the share of each cause."""
        if sum(shares.values()) < CLEAR:
            return "no clear pattern"
        named = [kind for kind, share in shares.items() if share > (ADDS if kind in CAUSES else 0.5)]
        said = ", and ".join(f"{self._words(kind)} ({100 * shares[kind]:.0f} %)" for kind in named)
        return (said + self._tie(shares)) or "no clear pattern"

    def _tie(self, shares: Mapping[str, float]) -> str:
        first = next((kind for kind in shares if kind in CAUSES), "constant")
        if first == "constant" or shares[first] <= ADDS:
            return ""
        alike = [k for k, adds in self.alone.items() if k not in shares and adds > self.alone[first] - TIED]
        return f"; not told apart from one that {' or '.join(self._words(k) for k in alike)}" if alike else ""

    def _words(self, kind: str) -> str:
        if kind == "parameters":
            return "is what other values of the model's own parameters would give"
        if kind == "constant":
            return f"is constant at {self.path.of(self.equation).mean():.3g}"
        if kind == "conserved":
            return self._exchange_words()
        if kind == "inputs":
            return f"follows {_listed(self.path.fit.model.inputs, 'input')}"
        return self._time_words() if kind == "time" else self._loss_words()

    def _exchange_words(self) -> str:
        names, momentum = _partners(self.path, self.equation), _is_momentum(self.path.fit.model, self.equation)
        return f"stores and returns energy (it follows {_listed(names, 'position' if momentum else 'state')})"

    def _loss_words(self) -> str:
        model, effort = self.path.fit.model, self.path.own(self.equation)
        if isinstance(model, FirstOrder):
            return f"follows {self.equation} itself"
        name = f"the {'velocity' if _is_momentum(model, self.equation) else 'effort'} dH_d{self.equation}"
        c = np.linalg.lstsq(self.columns["dissipated"], self.path.of(self.equation), rcond=None)[0]
        fitted = _odd(effort) @ c
        if _direction(fitted, effort) < -CLEAR:
            return f"takes energy out (it opposes {name})"
        if _direction(fitted + self.path.losses[:, model.states.index(self.equation)], effort) < -CLEAR:
            return f"changes how energy is lost (it follows {name}, by another law than the model's damping)"
        return f"feeds energy in (it pushes along {name})"

    def _time_words(self) -> str:
        period = period_of(self.path, self.equation)
        if period is None:
            return "depends on time: it changes slowly"
        return f"depends on time: period {period:.3g}{spaced(self.units.get('t', ''))}"


def period_of(path: Along, equation: str) -> float | None:
    """Period of the wave in a force that depends on time; None where slow changes are larger."""
    w = path.of(equation)
    everywhere = np.ones(len(w), dtype=bool)
    columns = _of_time(path, w, everywhere)
    c = np.linalg.lstsq(columns, w, rcond=None)[0]
    if np.var(columns[:, :-4] @ c[:-4]) > np.var(columns[:, -4:] @ c[-4:]):
        return None
    return 1 / _wave(path, w, everywhere)


def _direction(force: np.ndarray, effort: np.ndarray) -> float:
    """Mean power of a force over the product of rms force and rms effort: -1 for damping, 0 for none on the whole."""
    return float(force @ effort / max(float(np.linalg.norm(force) * np.linalg.norm(effort)), 1e-300))


def plane_of(path: Along, equation: str) -> tuple[str, ...]:
    """Variables of a map of the force: position and velocity of a momentum, else the best two states (or the one).

    Another pair of states takes their place where the force follows only that pair.
    """
    model, found = path.fit.model, _dependence(path, equation)
    best, own = leading(found, equation), [name for name in found["variable"] if name in model.states][:2]
    if _is_momentum(model, equation):
        (q,) = (model.states[i] for i in positions(model) if model.S[i][model.states.index(equation)])
        own = [q, f"dH_d{equation}"]
    if best is None or "," not in best["variable"] or best["share"] < CLEAR:
        return tuple(own)
    pair = best["variable"].split(", ")
    return tuple(own if equation in pair and own[0] in pair else pair)


def _is_momentum(model: Model, equation: str) -> bool:
    return any(model.S[i][model.states.index(equation)] != 0 for i in positions(model))


def _partners(path: Along, equation: str) -> tuple[str, ...]:
    """States that the equation exchanges energy with: all positions for a momentum, otherwise those in its row of S."""
    model = path.fit.model
    row = np.flatnonzero(np.array(model.S)[model.states.index(equation)])
    found = positions(model) if _is_momentum(model, equation) else row
    return tuple(model.states[int(j)] for j in found)


def _odd(effort: np.ndarray) -> np.ndarray:
    """Piecewise linear odd functions of the effort; they jump at zero."""
    return np.asarray(np.sign(effort)[:, None] * _hats(np.abs(effort), N_KNOTS // 2))


def _sum_of(path: Along, names: Sequence[str]) -> np.ndarray:
    """Functions of each variable; of two variables also those of both."""
    columns = [_hats(path.variable(name), N_KNOTS) for name in names]
    if len(names) == 2:
        columns.append(_pair(path.variable(names[0]), path.variable(names[1])))
    return np.hstack(columns)


def _listed(names: Sequence[str], what: str) -> str:
    return f"the {what}{'s' if len(names) > 1 else ''} {', '.join(names)}"


# In words


def sentences(
    fit: Fit, estimate: ForceEstimate, runs: Sequence[str] = (), units: Mapping[str, str] | None = None
) -> list[str]:
    """Plain sentences on where the model fails, an equation each, strongest first; ``units`` as in `Measurements`."""
    known, table = units or {}, located(fit, estimate, runs)
    energy = power(fit, estimate, runs, known)
    words = dict(zip(energy.table["equation"], energy.sentences, strict=True))
    found = depends_on(fit, estimate, runs)
    return [_sentence(row, words[row["equation"]], found, known) for _, row in table.iterrows()]


def _sentence(row: pd.Series, words: str, found: pd.DataFrame, units: Mapping[str, str]) -> str:
    name, times = row["equation"], row["times_noise"]
    size = f"{row['strength']:.3g}{spaced(force_unit(name, units))}"
    if times < SEEN:
        return f"d{name}/dt: no missing force is sure (rms {size}, {times:.2g} times its standard deviation)."
    pattern = f"It {words}." if words != "no clear pattern" else "No single cause explains it."
    if (best := leading(found, name)) is not None and best["share"] >= CLEAR:
        pattern += f" Best predicted from {best['variable']} ({100 * best['share']:.0f} %)."
    sure = f"{times:.2g} times its standard deviation"
    return f"d{name}/dt lacks a force of rms {size}, {sure}; {_place(row, units)}. {pattern}"


def leading(found: pd.DataFrame, equation: str) -> pd.Series | None:
    """The row of `depends_on` to name: the best variable, a single one where a pair of states is hardly better."""
    listed = found[(found["equation"] == equation) & ~found["variable"].isin(["constant", "parameters"])]
    good = listed[listed["share"] > listed["share"].max() - ADDS]
    alone = good[~good["variable"].str.contains(",")]
    return (alone if len(alone) else good).iloc[0] if len(good) else None


def _place(row: pd.Series, units: Mapping[str, str]) -> str:
    """Trajectory, times, region and frequency of one row of `located`, in words."""
    run = row["trajectory"] if isinstance(row["trajectory"], str) else f"trajectory {row['trajectory']}"
    window, region, unit = row["time_window"], row["state_region"], spaced(units.get("t", ""))
    place = "about as strong all the time" if "throughout" in window else f"strongest in {run}, t = {window}{unit}"
    place += "" if region == "everywhere" else f"{';' if 'throughout' in window else ','} strong where {region}"
    return place + (f"; mostly at {row['frequency']:.3g} {frequency_unit(units)}" if row["frequency"] > 0 else "")


def frequency_unit(units: Mapping[str, str]) -> str:
    """Hz where the time is in seconds, else cycles per unit of time."""
    time = units.get("t", "")
    return "Hz" if time == "s" else f"cycles per {time or 'unit of time'}"


def force_unit(equation: str, units: Mapping[str, str]) -> str:
    """Unit of the missing force of an equation, '' where units are not known."""
    state, time = units.get(equation, ""), units.get("t", "")
    return f"({state})/{time}" if state and time and " " in state else f"{state}/{time}" if state and time else ""


def spaced(unit: str) -> str:
    """The unit with a space before it, or nothing."""
    return f" {unit}" if unit else ""
