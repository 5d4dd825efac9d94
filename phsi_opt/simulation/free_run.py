"""The free run of a model at the samples of a record, stepped inside CasADi: fast
enough for thousands of records.

Every interval between two samples is a step of Dormand and Prince's explicit scheme of
order five. Steps whose error estimate is too large (at a kink, say) are cut in parts
and the run repeated; it is accepted when half the steps change it by less than
`TOLERANCE`. What cannot be made accurate in this way (a very stiff, broken off or
chaotic run) is left to SciPy (`simulate`), which is also the independent check of this
file.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.simulation.simulate import simulate
from phsi_opt.statistics import TINY

# change of the run with twice the steps, in standard deviations of each state along the
# run
TOLERANCE = 1e-6
MOST_STEPS = 150  # per interval on average, beyond which SciPy is faster
LEAST_BUDGET = 20_000  # steps that a short record may take in any case
ROUNDS = 14  # of cutting steps
LARGEST_FACTOR = 8  # parts of a step in one round
FEW = 0.03  # share of the steps: so few are at kinks
CHAOTIC = 0.1  # change by twice the steps from which on no number of steps will do
UNSTABLE = 4  # parts of every step after a run that left the range of numbers
LARGEST = 1e100  # squares of larger values leave the range of numbers
# steps per call of the compiled loop: large against the cost of a call, small against
# that of building it
CHUNK = 500
# Dormand and Prince (1980): the last row of STAGES is the step of order five, WEIGHTS_4
# that of order four.
NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
STAGES = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
WEIGHTS_4 = (
    5179 / 57600,
    0.0,
    7571 / 16695,
    393 / 640,
    -92097 / 339200,
    187 / 2100,
    1 / 40,
)


def free_run(
    model: Model, t: Any, x0: Any, u: Any = None, hold: str = "linear"
) -> np.ndarray:
    """Solve dx/dt = model(x, u, t) from x0 at t[0]; returns (n_samples, n_states),
    accurate to about `TOLERANCE`.

    Args:
        t: (n_samples,) strictly increasing times.
        x0: (n_states,) starting state.
        u: (n_samples, n_inputs) inputs at t; None if the model has no inputs.
        hold: between the samples of u, "linear" or "zero" (zero-order hold).

    Raises `DataError` for wrong shapes and `SolveError` if the solution cannot be
    continued, both as `simulate` does.
    """
    times, start = np.asarray(t, dtype=float), np.asarray(x0, dtype=float)
    inputs = np.zeros((times.size, 0)) if u is None else np.asarray(u, dtype=float)
    usable = _is_usable(model, times, start, inputs, hold)
    found = Runs(rates(model)).run(times, start, inputs, hold) if usable else None
    # Arguments that cannot be used go to SciPy too: `simulate` says what is wrong with
    # them.
    return simulate(model, t, x0, u, hold=hold) if found is None else found


def rates(model: Model) -> ca.Function:
    """CasADi function (x, u, t) -> dx/dt with the present values of the parameters."""
    x, u, t = (
        ca.SX.sym("x", model.n_states),
        ca.SX.sym("u", model.n_inputs),
        ca.SX.sym("t"),
    )
    return ca.Function(
        "rates",
        [x, u, t],
        [model.rhs()(x, u, t, [model.values[name] for name in model.free])],
    )


def _is_usable(
    model: Model, t: np.ndarray, x0: np.ndarray, u: np.ndarray, hold: str
) -> bool:
    shapes = (
        t.ndim == 1
        and t.size > 1
        and x0.shape == (model.n_states,)
        and u.shape == (t.size, model.n_inputs)
    )
    finite = all(bool(np.all(np.isfinite(values))) for values in (t, x0, u))
    return (
        shapes
        and finite
        and bool(np.all(np.diff(t) > 0))
        and hold in ("linear", "zero")
    )


class Runs:
    """Runs of one right-hand side, a CasADi function (x, u, t) -> dx/dt; built once,
    run along any record.

    Only the errors of the first ``watched`` states count (None: of all).
    """

    def __init__(self, rhs: ca.Function, watched: int | None = None) -> None:
        self.n_watched = watched or rhs.size1_in(0)
        self.loop = _step(rhs, self.n_watched).mapaccum(CHUNK)

    def run(
        self,
        t: np.ndarray,
        x0: np.ndarray,
        u: np.ndarray,
        hold: str,
        tolerance: float = TOLERANCE,
    ) -> np.ndarray | None:
        """The states (n_samples, n_states) from x0; None where they cannot be made
        accurate with explicit steps.

        ``tolerance`` as `TOLERANCE`.
        """
        record = _Record(
            t,
            u,
            np.diff(u, axis=0) / np.diff(t)[:, None]
            if hold == "linear"
            else np.zeros_like(u[1:]),
        )
        steps, aim = _first_steps(t), tolerance
        budget = max(MOST_STEPS * len(t), LEAST_BUDGET)
        for _ in range(ROUNDS):
            run = self._along(record, x0, steps)
            parts = _parts(run, aim)
            if np.all(parts == 1):
                fine = self._along(record, x0, _cut(steps, 2 * parts))
                change = fine.change_from(run)
                if change < tolerance:
                    return fine.x
                if change > CHAOTIC:
                    return None
                aim *= float(np.clip(0.3 * tolerance / change, 1e-3, 0.3))
                parts = _parts(run, aim)
            if 3 * parts.sum() > budget:
                return None
            steps = _cut(steps, parts)
        return None

    def _along(self, record: "_Record", x0: np.ndarray, steps: "_Steps") -> "_Run":
        """The run in the given steps; NaN from where it leaves the range of numbers."""
        columns, n_steps = record.columns(steps), len(steps.h)
        x, e = (
            np.full((n_steps, len(x0)), np.nan),
            np.full((n_steps, self.n_watched), np.nan),
        )
        at: Any = x0
        for first in range(0, n_steps, CHUNK):
            done, errors = self.loop(at, columns[:, first : first + CHUNK])
            at, size = done[:, -1], min(CHUNK, n_steps - first)
            x[first : first + size], e[first : first + size] = (
                done.full().T[:size],
                errors.full().T[:size],
            )
            if not at.is_regular():
                break
        last = np.append(np.flatnonzero(np.diff(steps.interval)), n_steps - 1)
        return _Run(np.vstack([x0, x[last]]), e)


@dataclass(frozen=True, eq=False)
class _Steps:
    """For every step: the interval between samples that it is in, its time since the
    sample before, its length.
    """

    interval: np.ndarray
    since: np.ndarray
    h: np.ndarray


@dataclass(frozen=True, eq=False)
class _Record:
    """Times and inputs at the samples, and the slope of the inputs in every interval."""

    t: np.ndarray
    u: np.ndarray
    slope: np.ndarray

    def columns(self, steps: _Steps) -> np.ndarray:
        """Time, length, inputs and their slopes of every step, a column each; steps of
        length zero fill the chunk.
        """
        n_steps, m = len(steps.h), self.u.shape[1]
        columns = np.zeros((2 + 2 * m, -(-n_steps // CHUNK) * CHUNK))
        slope = self.slope[steps.interval]
        columns[0, :n_steps], columns[1, :n_steps] = (
            self.t[steps.interval] + steps.since,
            steps.h,
        )
        columns[2 : 2 + m, :n_steps] = (
            self.u[steps.interval] + slope * steps.since[:, None]
        ).T
        columns[2 + m :, :n_steps] = slope.T
        return columns


@dataclass(frozen=True, eq=False)
class _Run:
    """States at the samples, (n_samples, n_states), and the estimated error of every
    step, (n_steps, n_watched).
    """

    x: np.ndarray
    errors: np.ndarray

    @property
    def watched(self) -> np.ndarray:
        """The states whose errors count."""
        return self.x[:, : self.errors.shape[1]]

    @property
    def is_finite(self) -> bool:
        return bool(
            np.all(np.abs(self.x) < LARGEST) and np.all(np.abs(self.errors) < LARGEST)
        )

    @property
    def scale(self) -> np.ndarray:
        """Spread of every watched state; for one that rests a small share of its size:
        rounding is not an error.
        """
        x = self.watched
        size = np.max(np.abs(x), axis=0)
        return np.maximum(
            np.maximum(np.std(x, axis=0), 1e-6 * size),
            max(1e-12 * np.max(size), TINY),
        )

    @property
    def error(self) -> np.ndarray:
        """Largest error of every step, (n_steps,), in spreads of the states."""
        return np.asarray(np.max(self.errors / self.scale, axis=1))

    def change_from(self, other: "_Run") -> float:
        """Largest difference at a sample, in spreads of the states."""
        if not self.is_finite:
            return np.inf
        return float(np.max(np.abs(self.watched - other.watched) / self.scale))


def _first_steps(t: np.ndarray) -> _Steps:
    """A step per interval; in a gap of the record as many as the samples that it would
    have held.
    """
    h = np.diff(t)
    parts = np.ceil(h / np.median(h) - 1e-6).clip(1, MOST_STEPS).astype(int)
    return _cut(_Steps(np.arange(len(h)), np.zeros(len(h)), h), parts)


def _parts(run: _Run, aim: float) -> np.ndarray:
    """Into how many steps each step is to be cut for an estimated error, of order five,
    of at most ``aim`` in each.
    """
    if not run.is_finite:
        return np.full(len(run.errors), UNSTABLE)
    parts = np.ceil(np.clip((run.error / aim) ** 0.2, 1, LARGEST_FACTOR)).astype(int)
    # At a kink the order is lower than five, and few steps are cheap to cut.
    return np.where(parts > 1, LARGEST_FACTOR, 1) if np.mean(parts > 1) < FEW else parts


def _cut(steps: _Steps, parts: np.ndarray) -> _Steps:
    """Each step cut into equal parts."""
    before = np.repeat(np.cumsum(parts) - parts, parts)
    h = np.repeat(steps.h / parts, parts)
    since = np.repeat(steps.since, parts) + (np.arange(len(h)) - before) * h
    return _Steps(np.repeat(steps.interval, parts), since, h)


def _step(rhs: ca.Function, n_watched: int) -> ca.Function:
    """CasADi function (x, [t, h, u, du/dt]) -> x after the step, |estimated error of
    the first states|.
    """
    m = rhs.size1_in(1)
    x, column = ca.SX.sym("x", rhs.size1_in(0)), ca.SX.sym("column", 2 + 2 * m)
    t, h, u, slope = column[0], column[1], column[2 : 2 + m], column[2 + m :]
    found: list[ca.SX] = []
    for weights, c in zip(STAGES, NODES, strict=True):
        found.append(rhs(_moved(x, h, weights, found), u + c * h * slope, t + c * h))
    after = _moved(x, h, STAGES[-1], found[:-1])
    error = ca.fabs(after - _moved(x, h, WEIGHTS_4, found))[:n_watched]
    return ca.Function("step", [x, column], [after, error], {"cse": True})


def _moved(x: ca.SX, h: ca.SX, weights: tuple[float, ...], found: list[ca.SX]) -> ca.SX:
    return sum(
        (h * w * rate for w, rate in zip(weights, found, strict=True) if w), start=x
    )
