"""First guesses from data alone: dead time, lag, natural frequency and damping.

A measured state is compared with the response of the simplest linear systems to the
inputs, all with a dead time d::

    lag                y = K / (1 + tau s) exp(-d s) u
    integrating lag    y = K / (s (1 + tau s)) exp(-d s) u
    oscillation        y = K / (1 + 2 zeta s/w + s^2/w^2) exp(-d s) u

with free responses from any start. Gains, offset and free responses are linear and
follow by least squares (variable projection: Golub and Pereyra, SIAM Journal on
Numerical Analysis 10, 1973); the few other numbers are searched on a grid, whose best
place is refined. Output errors are minimised, so noise causes no bias.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

MOST_SAMPLES = 800  # of a record that is compared
SAMPLES_PER_PERIOD = 20  # of the fastest motion that matters, where there are as many
LONGEST_DELAY = 0.1  # share of the record
# Share of the variance that a simple system explains; and of the last part, with the
# gains of what is before it.
EXPLAINED = 0.8
BEFORE = 0.7
MOST_DAMPED = 0.9  # of what is told as an oscillation, which has two periods
# Log likelihood ratio, less its price, from which a dead time is there.
DECISIVE = 5.0
LAG, INTEGRATING, OSCILLATION = "lag", "integrating lag", "oscillation"


@dataclass(frozen=True)
class FirstGuess:
    """The simplest linear system that a state responds like; NaN: it has none."""

    explained: float  # share of the variance
    dead_time: float = 0.0
    lag: float = np.nan
    frequency: float = np.nan  # natural, in cycles per unit of time
    damping: float = np.nan  # ratio zeta
    integrates: bool = False


@dataclass(frozen=True, eq=False)
class _System:
    """One kind of system with the numbers that are not linear, but the dead time."""

    kind: str
    inner: np.ndarray  # logarithms of tau, or of w and zeta

    @property
    def pole(self) -> complex:
        """That which is not zero; of an oscillation the one with the positive turn."""
        if self.kind == OSCILLATION:
            w, zeta = np.exp(self.inner)
            return complex(-zeta * w, w * np.sqrt(1 - zeta**2))
        return complex(-1 / np.exp(self.inner[0]))

    def free(self, t: np.ndarray) -> list[np.ndarray]:
        """Its responses without inputs, and the offset."""
        decay = np.exp(self.pole * t)
        if self.kind == OSCILLATION:
            return [np.ones_like(t), decay.real, decay.imag]
        return [np.ones_like(t), decay.real] + [t] * (self.kind == INTEGRATING)

    def forced(self, u: np.ndarray, h: float) -> np.ndarray:
        """Its responses to inputs (n_inputs, n) from rest, up to a factor each.

        Exact for inputs that are straight between samples.
        """
        n = u.shape[1]
        turn = self.pole * h
        mean = (np.exp(turn) - 1) / turn
        late = (mean - 1) / turn
        kernel = np.exp(turn * np.arange(n)) * (late + (mean - late) * np.exp(-turn))
        kernel[0] = late
        found = np.fft.ifft(np.fft.fft(kernel, 2 * n) * np.fft.fft(u, 2 * n))[:, :n]
        if self.kind == OSCILLATION:
            return np.asarray(found.imag)
        if self.kind == LAG:
            return np.asarray(found.real)
        return np.cumsum(u + np.roll(u, 1, axis=1), axis=1) / 2 - found.real


@dataclass(frozen=True, eq=False)
class _Record:
    """A state and the inputs at even steps."""

    h: float
    y: np.ndarray  # (n,)
    u: np.ndarray  # (n_inputs, n), less what they are at first

    @cached_property
    def t(self) -> np.ndarray:
        return np.arange(len(self.y)) * self.h

    def left(self, system: _System, delay: float, n: int | None = None) -> np.ndarray:
        """What the combination leaves that is best for the first n samples, (n,)."""
        forced = system.forced(self.u, self.h)
        later = [np.interp(self.t - delay, self.t, one) for one in forced]
        columns = np.array(system.free(self.t) + later).T
        columns /= np.linalg.norm(columns, axis=0) + 1e-300
        gains = np.linalg.lstsq(columns[:n], self.y[:n], rcond=1e-10)[0]
        return np.asarray(self.y - columns @ gains)

    def squares(self, system: _System, delays: np.ndarray) -> np.ndarray:
        """Of what the best combination leaves at each dead time, (n_delays,)."""
        free = np.linalg.qr(np.array(system.free(self.t)).T)[0]
        y = self.y - free @ (free.T @ self.y)
        forced = system.forced(self.u, self.h)
        rows = [[np.interp(self.t - d, self.t, one) for one in forced] for d in delays]
        columns = np.array(rows).reshape(len(delays), len(forced), len(self.t))
        columns -= columns @ free @ free.T
        columns /= np.linalg.norm(columns, axis=2, keepdims=True) + 1e-300
        products = columns @ columns.transpose(0, 2, 1)
        by_y = columns @ y
        gains = np.linalg.pinv(products, 1e-10, hermitian=True) @ by_y[:, :, None]
        return np.asarray(y @ y - np.sum(by_y * gains[:, :, 0], axis=1))

    def predicted(self, system: _System, delay: float) -> float:
        """Share of the variance of the last part, by the gains of what is before."""
        n = int(BEFORE * len(self.y))
        last = self.left(system, delay, n)[n:]
        return 1 - float(np.mean(last**2)) / float(np.var(self.y))

    def best(self, kind: str, delays: np.ndarray) -> tuple[float, _System, float]:
        """Sum of squares, system and delay: of a grid, refined from its best place."""
        length = self.t[-1]
        if kind == OSCILLATION:  # from a period in the record to three samples in one
            slowest = 2 * np.pi / length
            fastest = 2 * np.pi / (3 * self.h)
            n = int(np.clip(8 * np.log2(fastest / slowest), 8, 60))
            rates, ratios = np.meshgrid(np.geomspace(slowest, fastest, n), [0.02, 0.2])
            grid = np.log(np.c_[rates.ravel(), ratios.ravel()])
            lower = [np.log(slowest / 2), np.log(1e-4)]
            upper = [np.log(fastest), -0.01]
        else:
            grid = np.log(np.geomspace(self.h / 2, length / 2, 14))[:, None]
            lower = [np.log(self.h / 10)]
            upper = [np.log(length)]
        least = np.inf
        for inner in grid:
            system = _System(kind, inner)
            half = np.pi / np.exp(inner[0]) if kind == OSCILLATION else np.inf
            some = delays[delays < half]  # further ones are another sign
            squares = self.squares(system, some)
            if squares.min() < least:
                least = float(squares.min())
                found = system, float(some[np.argmin(squares)])
        n = len(found[0].inner)
        lower.append(0.0)
        upper.append(LONGEST_DELAY * length)
        scale = np.r_[np.full(n, 0.1), self.h]
        start = np.r_[found[0].inner, found[1]]
        moves = slice(None) if len(delays) > 1 else slice(n)
        ends = np.array([lower, upper])[:, moves]

        def left(vector: np.ndarray) -> np.ndarray:
            delay = float(vector[n]) if len(vector) > n else 0.0
            return self.left(_System(kind, vector[:n]), delay)

        vector = refined(left, start[moves], scale[moves], ends)
        delay = float(vector[n]) if len(vector) > n else 0.0
        return float(np.sum(left(vector) ** 2)), _System(kind, vector[:n]), delay


def refined(
    left: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    scale: np.ndarray,
    ends: np.ndarray,
) -> np.ndarray:
    """Where residuals (n,) are least near a start (k,), by damped Gauss-Newton steps.

    Args:
        left: the residuals.
        start: within the bounds.
        scale: (k,) by which the vector changes much.
        ends: (2, k) lower and upper bounds.
    """
    vector = np.clip(start, *ends)
    here = left(vector)
    damping = 0.01
    for _ in range(20):
        slopes = []
        for place, size in enumerate(scale / 1000):
            aside = vector.copy()
            aside[place] += size if vector[place] + size < ends[1, place] else -size
            slopes.append((left(aside) - here) * scale[place] / (aside - vector)[place])
        products = np.array(slopes) @ np.array(slopes).T
        damped = products + np.diag(damping * np.diag(products) + 1e-300)
        step = -scale * np.linalg.solve(damped, np.array(slopes) @ here)
        trial = np.clip(vector + step, *ends)
        there = left(trial)
        gain = 1 - (there @ there) / (here @ here)
        damping *= 0.1 if gain > 0 else 10.0
        if gain > 0:
            vector, here = trial, there
        if 0 <= gain < 1e-6 or damping > 1e3:
            break
    return np.asarray(vector)


def first_guess(t: np.ndarray, y: np.ndarray, u: np.ndarray) -> FirstGuess | None:
    """That of a state, from samples of one run; None: no simple system explains it.

    Args:
        t: (n,) times.
        y: (n,) the state, measured at all of them.
        u: (n, n_inputs) inputs.
    """
    if len(t) < 30 or not np.ptp(y):
        return None
    record = _even(t, y, u[:, np.ptp(u, axis=0) > 0])
    n = len(record.y)
    total = n * float(np.var(record.y))
    if not total:
        return None
    delays = np.zeros(1)
    kinds = [OSCILLATION]
    if len(record.u):
        kinds = [LAG, INTEGRATING, OSCILLATION]
        steps = np.geomspace(1, max(LONGEST_DELAY * n, 1), 10)
        delays = np.r_[0.0, np.unique(steps.astype(int)) * record.h]
    found = {kind: record.best(kind, delays) for kind in kinds}

    def costs(kind: str) -> float:
        """What it leaves, by Schwarz' price of its numbers."""
        squares, system, _ = found[kind]
        return squares * n ** (len(system.inner) / n)

    kind = min(kinds, key=costs)
    squares, system, delay = found[kind]
    if delay:
        at_once = record.best(kind, delays[:1])
        gain = n / 2 * np.log(at_once[0] / squares) - np.log(n) / 2
        if gain < DECISIVE or delay < record.h / 2:
            squares, system, delay = at_once
    is_at_end = delay > 0.99 * LONGEST_DELAY * record.t[-1]
    explained = 1 - squares / total
    if explained < EXPLAINED or is_at_end:
        return None
    if record.predicted(system, delay) < EXPLAINED:
        return None
    if kind == OSCILLATION:
        w, zeta = np.exp(system.inner)
        if w * record.t[-1] < 4 * np.pi or zeta > MOST_DAMPED:
            return None
        return FirstGuess(explained, delay, frequency=w / (2 * np.pi), damping=zeta)
    return FirstGuess(explained, delay, np.exp(system.inner[0]), integrates=kind != LAG)


def _even(t: np.ndarray, y: np.ndarray, u: np.ndarray) -> _Record:
    """At even steps, no closer than the fastest motion asks for, of limited number."""
    h = float(np.median(np.diff(t)))
    even = t[0] + h * np.arange(min(np.ptp(t) / h + 0.5, 100 * MOST_SAMPLES))
    columns = np.array([np.interp(even, t, one) for one in (y, *u.T)])
    power = np.cumsum(np.abs(np.fft.rfft(columns[0] - columns[0].mean())[1:]) ** 2)
    fastest = 1 + int(np.searchsorted(power, 0.99 * power[-1]))  # cycles in the record
    every = max(len(even) // max(SAMPLES_PER_PERIOD * fastest, 100), 1)
    n = min(len(even) // every, MOST_SAMPLES)
    means = columns[:, : n * every].reshape(len(columns), n, every).mean(axis=2)
    return _Record(every * h, means[0], means[1:] - means[1:, :1])
