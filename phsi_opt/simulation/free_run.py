"""The free run of a model at the samples of a record, stepped inside CasADi.

It is fast enough for thousands of records.

Every interval between two samples is a step of Dormand and Prince's explicit scheme of
order five. Steps whose error estimate is too large (at a kink, say) are cut in parts
and the run repeated; it is accepted when half the steps change it by less than
`TOLERANCE`. What cannot be made accurate in this way (a very stiff, broken off or
chaotic run) is left to SciPy (`simulate`), which is also the independent check of this
file.
"""

from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import RK45

from phsi_opt.data.checks import LARGEST_VALUE, Hold, hold_of_each
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.simulation.simulate import (
    BufferedFunction,
    SampledInputs,
    checked_arguments,
    simulate,
)
from phsi_opt.statistics import TINY

# Change of the run with twice the steps, in standard deviations of each state along the
# run.
TOLERANCE = 1e-6
MOST_STEPS_PER_GAP = 150  # per interval on average, beyond which SciPy is faster
LARGEST_FACTOR = 8  # parts of a step in one round
# Steps per call of the compiled loop: large against the cost of a call, small against
# that of building it.
CHUNK = 500
# Least spread of a state that errors are compared with, as a share of its own size, and
# squared of the largest state's: rounding is not an error.
AT_REST = 1e-6


def free_run(
    model: Model, t: Any, x0: Any, u: Any = None, hold: Hold = "linear"
) -> np.ndarray:
    """Solve dx/dt = model(x, u, t) from x0 at t[0], accurate to about `TOLERANCE`.

    Args:
        model: with the present values of its parameters.
        t: (n_samples,) strictly increasing times.
        x0: (n_states,) starting state.
        u: (n_samples, n_inputs) inputs at t; None if the model has no inputs.
        hold: between the samples of u, as in `simulate`.

    Returns:
        (n_samples, n_states).

    Raises:
        DataError: wrong shapes, times or numbers, as in `simulate`.
        SolveError: the solution cannot be continued.
    """
    times, start, inputs = checked_arguments(model, t, x0, u)
    of_each = hold_of_each(hold, model.inputs)
    theta = tuple(model.theta.tolist())
    runs = _runs_of(model.rhs(), theta, get_ident())
    found = runs.run(times, start, inputs, of_each)
    return simulate(model, t, x0, u, hold=hold) if found is None else found


def rates(model: Model) -> ca.Function:
    """CasADi function (x, u, t) -> dx, which is dx/dt at the present parameters."""
    return _rates(model.rhs(), model.theta)


def _rates(rhs: ca.Function, theta: Any) -> ca.Function:
    given = argument_symbols(rhs)[:3]
    return ca.Function("rates", given, [rhs(*given, theta)], ["x", "u", "t"], ["dx"])


@lru_cache(maxsize=4)
def _runs_of(rhs: ca.Function, theta: tuple[float, ...], thread: int) -> "Runs":
    """Of (x, u, t, theta) -> dx/dt with values of the parameters.

    Built once for the trajectories of a record, and of the one held out; once for every
    thread, whose runs are written over by the next.
    """
    return Runs(_rates(rhs, np.array(theta)))


def _step(rhs: ca.Function) -> ca.Function:
    """One step of Dormand and Prince's scheme of order five, with its error estimate.

    Its coefficients are SciPy's (J. R. Dormand and P. J. Prince 1980, "A family of
    embedded Runge-Kutta formulae", Journal of Computational and Applied Mathematics 6,
    19-26).

    Args:
        rhs: CasADi function (x, u, t) -> dx/dt; the inputs change linearly.

    Returns:
        CasADi function (x, column) -> x after the step, size of the estimated error;
        the column holds the time, the length of the step, the inputs and their slopes.
    """
    n_inputs = rhs.size1_in(1)
    x = ca.SX.sym("x", rhs.size1_in(0))
    column = ca.SX.sym("column", 2 + 2 * n_inputs)
    t, h = column[0], column[1]
    u, slope = column[2 : 2 + n_inputs], column[2 + n_inputs :]
    rates: list[ca.SX] = []

    def change(weights: np.ndarray) -> ca.SX:
        """Length times the sum of weight * rate, without the weights that are zero."""
        terms = [
            w * rate for w, rate in zip(weights.tolist(), rates, strict=False) if w
        ]
        return h * sum(terms, ca.SX.zeros(x.numel()))

    for weights, c in zip([*RK45.A, RK45.B], [*RK45.C, 1.0], strict=True):
        after = x + change(weights)
        rates.append(rhs(after, u + c * h * slope, t + c * h))
    error = ca.fabs(change(RK45.E))
    return ca.Function("step", [x, column], [after, error], {"cse": True})


class Runs:
    """Runs of one right-hand side; built once, run along any record.

    Args:
        rhs: CasADi function (x, u, t) -> dx/dt.
    """

    def __init__(self, rhs: ca.Function) -> None:
        self.loop = BufferedFunction(_step(rhs).mapaccum(CHUNK))

    def run(
        self,
        t: np.ndarray,
        x0: np.ndarray,
        u: np.ndarray,
        hold: np.ndarray,
        tolerance: float = TOLERANCE,
    ) -> np.ndarray | None:
        """The states from x0; None where explicit steps cannot make them accurate.

        Args:
            t: (n_samples,) strictly increasing times.
            x0: (n_states,) starting state.
            u: (n_samples, n_inputs).
            hold: (n_inputs,) what each input does between its samples.
            tolerance: as `TOLERANCE`.

        Returns:
            (n_samples, n_states).
        """
        inputs = SampledInputs.of(t, u, hold)
        steps = _first_steps(t)
        aim = tolerance
        for _ in range(14):
            run = self._along(inputs, x0, steps)
            parts = _parts(run, aim)
            if np.all(parts == 1):
                fine = self._along(inputs, x0, _cut(steps, 2 * parts))
                change = fine.change_from(run)
                if change < tolerance:
                    return fine.x
                if change > 0.1:  # no number of steps will do
                    return None
                # Below what would be in proportion; from far off not at once.
                aim *= max(0.3 * tolerance / change, 1e-3)
                parts = _parts(run, aim)
            # This run, and one with half its steps.
            if 3 * parts.sum() > MOST_STEPS_PER_GAP * len(t):
                return None
            steps = _cut(steps, parts)
        return None

    def _along(self, inputs: SampledInputs, x0: np.ndarray, steps: "_Steps") -> "_Run":
        """The run in the given steps; NaN from where it leaves the range of numbers."""
        columns = _columns(inputs, steps)
        n_steps = len(steps.h)
        x = np.full((n_steps, len(x0)), np.nan)
        errors = x.copy()
        at = x0
        for first in range(0, n_steps, CHUNK):
            after, error = self.loop(at, columns[first : first + CHUNK])
            at = after[-1].copy()
            size = min(CHUNK, n_steps - first)
            chunk = slice(first, first + size)
            x[chunk] = after[:size]
            errors[chunk] = error[:size]
            if not np.all(np.isfinite(at)):
                break
        ends = np.flatnonzero(np.diff(steps.interval))
        at_samples = np.append(ends, n_steps - 1)
        return _Run(np.vstack([x0, x[at_samples]]), errors)


@dataclass(frozen=True, eq=False)
class _Steps:
    """The steps of a run, all arrays (n_steps,).

    Args:
        interval: between samples that each step is in.
        since: its time since the sample before.
        h: its length.
    """

    interval: np.ndarray
    since: np.ndarray
    h: np.ndarray


def _columns(inputs: SampledInputs, steps: _Steps) -> np.ndarray:
    """Time, length, inputs and their slopes of every step, a row each.

    Steps of length zero fill the chunk.
    """
    n_steps = len(steps.h)
    begin = inputs.t[steps.interval] + steps.since
    slope = inputs.slope[steps.interval]
    u = inputs.u[steps.interval] + slope * steps.since[:, None]
    if inputs.smooth is not None:
        first, last = inputs.smooth.lines(begin, begin + steps.h)
        u = np.where(inputs.is_smooth, first, u)
        slope = np.where(inputs.is_smooth, (last - first) / steps.h[:, None], slope)
    columns = np.column_stack([begin, steps.h, u, slope])
    return np.pad(columns, ((0, -n_steps % CHUNK), (0, 0)))


@dataclass(frozen=True, eq=False)
class _Run:
    """States at the samples, (n_samples, n_states), and the error of every step.

    The errors are estimates, (n_steps, n_states).
    """

    x: np.ndarray
    errors: np.ndarray

    @property
    def is_finite(self) -> bool:
        """Whether the run stayed in the range of numbers."""
        values = np.vstack([self.x, self.errors])
        return bool(np.all(np.abs(values) < LARGEST_VALUE))

    @property
    def scale(self) -> np.ndarray:
        """Spread of every state, (n_states,); of one that rests a share of its size."""
        size = np.max(np.abs(self.x), axis=0)
        least = max(AT_REST**2 * np.max(size), TINY)
        return np.maximum(np.std(self.x, axis=0), np.maximum(AT_REST * size, least))

    @property
    def error(self) -> np.ndarray:
        """Largest error of every step, (n_steps,), in spreads of the states."""
        return np.max(self.errors / self.scale, axis=1)

    def change_from(self, other: "_Run") -> float:
        """Largest difference at a sample, in spreads of the states."""
        if not self.is_finite:
            return np.inf
        return float(np.max(np.abs(self.x - other.x) / self.scale))


def _first_steps(t: np.ndarray) -> _Steps:
    """A step per interval; in a gap of the record as many as the samples that it would
    have held.
    """
    h = np.diff(t)
    samples = np.rint(h / np.median(h))
    parts = samples.clip(1, MOST_STEPS_PER_GAP).astype(int)
    whole = _Steps(np.arange(len(h)), np.zeros(len(h)), h)
    return _cut(whole, parts)


def _parts(run: _Run, aim: float) -> np.ndarray:
    """Into how many parts to cut each step, (n_steps,), for an estimated error of at
    most ``aim`` in each.
    """
    if not run.is_finite:
        return np.full(len(run.errors), LARGEST_FACTOR // 2)
    factor = (run.error / aim) ** 0.2  # the error is of order five
    parts = np.ceil(np.clip(factor, 1, LARGEST_FACTOR)).astype(int)
    is_cut = parts > 1
    # At a kink the order is lower than five, and few steps are cheap to cut.
    return np.where(is_cut, LARGEST_FACTOR, 1) if np.mean(is_cut) < 0.03 else parts


def _cut(steps: _Steps, parts: np.ndarray) -> _Steps:
    """Each step cut into equal parts."""
    first = np.repeat(np.cumsum(parts) - parts, parts)
    h = np.repeat(steps.h / parts, parts)
    place = np.arange(len(h)) - first
    since = np.repeat(steps.since, parts) + place * h
    return _Steps(np.repeat(steps.interval, parts), since, h)
