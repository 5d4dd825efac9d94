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
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

MOST_SAMPLES = 800  # of a record that is compared
SAMPLES_PER_PERIOD = 20  # of the fastest motion that matters, where there are as many
LONGEST_DELAY = 0.1  # share of the record
# Share of the variance that a simple system explains; and of the last part, with the
# gains of what is before it.
EXPLAINED = 0.8
BEFORE = 0.7
MOST_UNSURE = 0.1  # standard deviation of the lag or the frequency, as a share of it
LEAST_ERROR = 1e-4  # share of the variance that a simple system leaves, at least
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


class _Best(NamedTuple):
    """The best system of a kind."""

    squares: float
    system: _System
    delay: float
    deviation: float  # standard deviation of the logarithm of its rate, or lag


@dataclass(frozen=True, eq=False)
class _Record:
    """A state and the inputs at even steps."""

    h: float
    y: np.ndarray  # (n,)
    u: np.ndarray  # (n_inputs, n), less what they are at first
    late: np.ndarray  # (n_inputs,) half a sample of the held ones, as lines are early

    @cached_property
    def t(self) -> np.ndarray:
        return np.arange(len(self.y)) * self.h

    def left(self, system: _System, delay: float, n: int | None = None) -> np.ndarray:
        """What the combination leaves that is best for the first n samples, (n,)."""
        forced = system.forced(self.u, self.h)
        later = self._shifted(forced, delay)
        columns = np.array(system.free(self.t) + later).T
        columns /= np.linalg.norm(columns, axis=0) + 1e-300
        gains = np.linalg.lstsq(columns[:n], self.y[:n], rcond=1e-10)[0]
        return np.asarray(self.y - columns @ gains)

    def _shifted(self, forced: np.ndarray, delay: float) -> list[np.ndarray]:
        shifts = zip(forced, delay + self.late, strict=True)
        return [np.interp(self.t - shift, self.t, one) for one, shift in shifts]

    def squares(self, system: _System, delays: np.ndarray) -> np.ndarray:
        """Of what the best combination leaves at each dead time, (n_delays,)."""
        free = np.linalg.qr(np.array(system.free(self.t)).T)[0]
        y = self.y - free @ (free.T @ self.y)
        forced = system.forced(self.u, self.h)
        rows = list(map(partial(self._shifted, forced), delays))
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

    def best(self, kind: str, delays: np.ndarray) -> _Best:
        """Of a grid, refined from its best place."""
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

        vector, slopes = refined(left, start[moves], scale[moves], ends)
        delay = float(vector[n]) if len(vector) > n else 0.0
        left_over = float(np.sum(left(vector) ** 2))
        # With no less error than a simple system has.
        variance = max(left_over / len(self.y), LEAST_ERROR * float(np.var(self.y)))
        products = slopes @ slopes.T + 1e-12 * variance * np.eye(len(slopes))
        spread = variance * np.linalg.inv(products)[0, 0]
        deviation = float(scale[0] * np.sqrt(spread))
        return _Best(left_over, _System(kind, vector[:n]), delay, deviation)


def refined(
    left: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    scale: np.ndarray,
    ends: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Where residuals (n,) are least near a start (k,), by damped Gauss-Newton steps.

    Args:
        left: the residuals.
        start: within the bounds.
        scale: (k,) by which the vector changes much.
        ends: (2, k) lower and upper bounds.

    Returns:
        The place, (k,), and the slopes of the last step there, (k, n), times the scale.
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
    return np.asarray(vector), np.array(slopes)


def first_guess(
    t: np.ndarray, y: np.ndarray, u: np.ndarray, is_held: np.ndarray
) -> FirstGuess | None:
    """That of a state, from samples of one run; None: no simple system explains it.

    Args:
        t: (n,) times.
        y: (n,) the state, measured at all of them.
        u: (n, n_inputs) inputs.
        is_held: (n_inputs,) whether each keeps its value until the next sample.
    """
    if len(t) < 30 or not np.ptp(y):
        return None
    moves = np.ptp(u, axis=0) > 0
    record = _even(t, y, u[:, moves], is_held[moves])
    n = len(record.y)
    total = n * float(np.var(record.y))
    if not total:
        return None
    delays = np.zeros(1)
    kinds = [OSCILLATION]
    if len(record.u) and all(map(_is_wave, record.u)):
        return None  # size and phase do not tell gain, lag and dead time
    if len(record.u):
        kinds = [LAG, INTEGRATING, OSCILLATION]
        steps = np.geomspace(1, max(LONGEST_DELAY * n, 1), 10)
        delays = np.r_[0.0, np.unique(steps.astype(int)) * record.h]
    found = {kind: record.best(kind, delays) for kind in kinds}

    def costs(kind: str) -> float:
        """What it leaves, by Schwarz' price of its numbers."""
        best = found[kind]
        return best.squares * n ** (len(best.system.inner) / n)

    kind = min(kinds, key=costs)
    best = found[kind]
    if best.delay:
        at_once = record.best(kind, delays[:1])
        gain = n / 2 * np.log(at_once.squares / best.squares) - np.log(n) / 2
        if gain < DECISIVE or best.delay < record.h / 2:
            best = at_once
    explained = 1 - best.squares / total
    is_late = best.delay > 0.99 * LONGEST_DELAY * record.t[-1]
    # Where lag and dead time look alike, neither is known, also if none is told.
    if explained < EXPLAINED or is_late or found[kind].deviation > MOST_UNSURE:
        return None
    if record.predicted(best.system, best.delay) < EXPLAINED:
        return None
    length = record.t[-1]
    rate = float(np.exp(best.system.inner[0]))
    if kind == OSCILLATION:
        damping = float(np.exp(best.system.inner[1]))
        if rate * length < 4 * np.pi or damping > MOST_DAMPED:
            return None
        frequency = rate / (2 * np.pi)
        return FirstGuess(explained, best.delay, frequency=frequency, damping=damping)
    # What it would do by itself, without inputs, is no answer to them.
    alone = replace(record, u=record.u[:0], late=record.late[:0])
    if best.squares > (1 - EXPLAINED) * alone.best(kind, delays[:1]).squares:
        return None
    if rate > length / 4:  # its end is not seen: a ramp would do as well
        return None
    lag = rate if rate > record.h / 2 else 0.0
    return FirstGuess(explained, best.delay, lag, integrates=kind != LAG)


def _is_wave(u: np.ndarray) -> bool:
    """Whether an input (n,) is a single sine, which excites a system too little.

    Nearly all of its power is at one frequency (persistent excitation of order two:
    Ljung, System Identification, 1999).
    """
    power = np.abs(np.fft.rfft((u - u.mean()) * np.hanning(len(u)))) ** 2
    line = int(np.argmax(power))
    near = power[max(line - 3, 0) : line + 4]
    return line > 3 and bool(np.sum(near) > 0.95 * np.sum(power))


def _even(t: np.ndarray, y: np.ndarray, u: np.ndarray, is_held: np.ndarray) -> _Record:
    """At even steps, no closer than the fastest motion asks for, of limited number."""
    h = float(np.median(np.diff(t)))
    even = t[0] + h * np.arange(min(np.ptp(t) / h + 0.5, 100 * MOST_SAMPLES))
    columns = np.array([np.interp(even, t, one) for one in (y, *u.T)])
    power = np.cumsum(np.abs(np.fft.rfft(columns[0] - columns[0].mean())[1:]) ** 2)
    fastest = 1 + int(np.searchsorted(power, 0.99 * power[-1]))  # cycles in the record
    every = max(len(even) // max(SAMPLES_PER_PERIOD * fastest, 100), 1)
    n = min(len(even) // every, MOST_SAMPLES)
    means = columns[:, : n * every].reshape(len(columns), n, every).mean(axis=2)
    return _Record(every * h, means[0], means[1:] - means[1:, :1], is_held * h / 2)
