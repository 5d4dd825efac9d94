"""The missing force along a record, beside everything that it may depend on."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from scipy.fft import next_fast_len

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model

LONGEST = 2**18  # points to which a trajectory is resampled for its spectrum
MOST_SOLVED = 3e7  # numbers held at once for the standard deviation of the force


@dataclass(frozen=True, eq=False)
class ForceRecord:
    """The missing force and what it may depend on, at the middle of every interval.

    force (n_intervals, n_forced) of ``equations``; states, efforts and losses -R dH/dx
    of the model (n_intervals, n_states); inputs (n_intervals, n_inputs); slopes
    (n_intervals, n_states, n_moving) of dx/dt in the parameters that are free to move,
    each of rms one; run: number of the trajectory.
    """

    fit: Fit
    estimate: ForceEstimate
    trajectories: tuple[str, ...]
    units: Mapping[str, str]
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

    @classmethod
    def of(cls, record: Record) -> "ForceRecord":
        """The missing force of a record with states, efforts, inputs and slopes."""
        estimate = record.estimate
        grid = estimate.grid
        x = estimate.x
        model = record.model.with_values(estimate.rounded)
        states = (x[grid.begin] + x[grid.begin + 1]) / 2
        inputs = (grid.u0 + grid.u1) / 2
        t = grid.t[grid.begin] + grid.h / 2
        n = len(t)
        run = grid.trajectory[grid.begin]
        theta = record.theta
        of_interval = theta[:, run] if len(theta) else ca.DM(0, n)
        point = (states.T, inputs.T, t[None, :], of_interval)
        efforts = model.function(*model.efforts).map(n)(*point)
        frozen = model.frozen()
        known = (*point[:3], ca.DM(0, n))
        with_loss = frozen.rhs().map(n)(*known)
        without_loss = replace(frozen, R={}).rhs().map(n)(*known)
        return cls(
            fit=record.fit,
            estimate=estimate,
            trajectories=record.trajectories,
            units=record.data.units,
            equations=tuple(model.states[row] for row in estimate.prior.rows),
            t=t,
            h=grid.h,
            run=run,
            force=estimate.w,
            states=states,
            efforts=np.array(efforts).T,
            inputs=inputs,
            losses=np.array(with_loss - without_loss).T,
            slopes=_slopes(model, point, n),
        )

    def variable(self, name: str) -> np.ndarray:
        """Values of a state, an effort, an input or the time ``t``."""
        model = self.fit.model
        known = {"t": self.t, **dict(zip(model.efforts, self.efforts.T, strict=True))}
        known |= dict(zip(model.states, self.states.T, strict=True))
        return (known | dict(zip(model.inputs, self.inputs.T, strict=True)))[name]

    def effort_of(self, equation: str) -> np.ndarray:
        """The effort of an equation: the velocity, for a momentum."""
        return self.efforts[:, self.fit.model.states.index(equation)]

    def force_on(self, equation: str) -> np.ndarray:
        """The missing force of an equation."""
        return self.force[:, self.equations.index(equation)]

    def as_estimated(self, equation: str, columns: np.ndarray) -> np.ndarray:
        """What the estimate would show of forces (n_intervals, k) on the equation: less
        what noise and prior hide.

        w_hat = w - C P^-1 w with the force's covariance P before and C after the
        measurements.
        """
        linear, (n_intervals, n_forced) = self.estimate.linear, self.force.shape
        at = np.arange(n_intervals) * n_forced + self.equations.index(equation)
        shown = np.empty_like(columns)
        n_parts = 1 + int(
            linear.n_total * columns.shape[1] / MOST_SOLVED
        )  # so that they fit in memory
        for part in np.array_split(np.arange(columns.shape[1]), n_parts):
            force, right = (
                np.zeros((linear.n_w, len(part))),
                np.zeros((linear.n_total, len(part))),
            )
            force[at] = columns[:, part]
            right[linear.n_x : linear.n_x + linear.n_w] = linear.L.T @ (
                linear.L @ force
            )
            shown[:, part] = (
                columns[:, part] - linear.factor.solve(right)[linear.n_x + at]
            )
        return shown

    def by_parameters(self, equation: str) -> np.ndarray:
        """Slopes of the equation in the parameters that act in it, as the estimate
        would show them.
        """
        columns = self.slopes[:, self.fit.model.states.index(equation)]
        return self.as_estimated(equation, columns[:, np.any(columns != 0, axis=0)])


def _slopes(model: Model, at: tuple[Any, ...], n: int) -> np.ndarray:
    """Slopes of dx/dt in the parameters that do not stand at a bound, of rms one, (n,
    n_states, n_moving).
    """
    rhs = model.rhs()
    x, u, t, theta = (ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(4))
    columns = ca.densify(ca.jacobian(rhs(x, u, t, theta), theta)[:, _moving(model)])
    flat = np.array(
        ca.Function("slopes", [x, u, t, theta], [ca.vec(columns.T)]).map(n)(*at)
    )
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


def spectrum(
    t: np.ndarray, run: np.ndarray, w: np.ndarray, n_points: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (cycles per unit of time) and amplitudes of w (n,) or (n, k): a sine
    of amplitude A has the peak A.

    Trajectories are resampled to even steps, tapered (Hann), and averaged in the mean
    square. There are ``n_points`` frequencies per resolved one; those below one cycle
    per longest trajectory are left out.
    """
    edges = [*np.flatnonzero(np.diff(run, prepend=run[0] - 1)), len(t)]
    spans = [(a, b) for a, b in pairwise(edges) if b - a > 2]
    duration = max((float(t[b - 1] - t[a]) for a, b in spans), default=0.0)
    if duration == 0.0:
        return np.zeros(1), np.zeros((1, *w.shape[1:]))
    step = max(
        min(float(np.median(np.diff(t[a:b]))) for a, b in spans), duration / LONGEST
    )
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
    sampled = (
        np.array([np.interp(even, t, column) for column in columns]).T * taper[:, None]
    )
    amplitude = 2 * np.abs(np.fft.rfft(sampled, n_fft, axis=0)) / taper.sum()
    return amplitude.reshape(-1, *w.shape[1:])


def frequency_unit(units: Mapping[str, str]) -> str:
    """Hz where the time is in seconds, else cycles per unit of time."""
    time = units.get("t", "")
    return "Hz" if time == "s" else f"cycles per {time or 'unit of time'}"


def force_unit(equation: str, units: Mapping[str, str]) -> str:
    """Unit of the missing force of an equation, '' where units are not known."""
    state, time = units.get(equation, ""), units.get("t", "")
    return (
        f"({state})/{time}"
        if state and time and " " in state
        else f"{state}/{time}"
        if state and time
        else ""
    )


def spaced(unit: str) -> str:
    """The unit with a space before it, or nothing."""
    return f" {unit}" if unit else ""
