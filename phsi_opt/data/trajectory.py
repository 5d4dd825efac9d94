"""One experiment: times, states and inputs, checked where they enter.

A trajectory knows neither the names nor the units of its channels: all trajectories of
a `Measurements` share those. Here too: arrays as trajectories, whole records or
integration steps, of which those that continue each other become one trajectory.
"""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from phsi_opt.data.channel_noise import resolution
from phsi_opt.data.checks import (
    check_values,
    from_first,
    numbered_names,
    read_only_floats,
)
from phsi_opt.errors import DataError, shown
from phsi_opt.presentation.numbers import number_of


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One experiment. The arrays are read-only float64 copies; times increase strictly.

    The values of x and u are checked by `Measurements`, which knows the channels'
    names.

    Attributes:
        name: A non-empty text of one line, unique within the measurements.
        t: Times, (n_samples,), at least 2.
        x: States, (n_samples, n_states), NaN where not measured.
        u: Inputs, (n_samples, n_inputs), or (n_samples,) for a single input.
        origin: The date at which t is 0, if the times were dates; otherwise None.
        remark: What its reader noticed, such as a clock that begins anew.
        past: Times and inputs before t[0], (n, 1 + n_inputs), as far as they are known:
            delayed inputs come from there.

    Raises:
        DataError: The name is not a text, an array is not real or has another shape, or
            the times do not increase.
    """

    name: str
    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    origin: dt.datetime | None = None
    remark: str = ""
    past: np.ndarray = field(default_factory=partial(np.empty, (0, 0)))

    def __post_init__(self) -> None:
        is_text = isinstance(self.name, str) and self.name
        if not is_text or not self.name.isprintable():
            raise DataError(
                f"trajectory name {shown(self.name)} is not a text of one line; "
                "give each trajectory a non-empty name."
            )
        title = f"trajectory {self.name!r}"
        for label, n_axes in (("t", 1), ("x", 2), ("u", 2)):
            array = read_only_floats(getattr(self, label), n_axes, f"{title}: {label}")
            object.__setattr__(self, label, array)
        past = self.past if len(self.past) else np.empty((0, 1 + self.u.shape[1]))
        object.__setattr__(self, "past", read_only_floats(past, 2, f"{title}: past"))
        for label in ("x", "u"):
            n_rows = len(getattr(self, label))
            if n_rows != self.n_samples:
                raise DataError(
                    f"{title}: {label} has {n_rows} rows and t has {self.n_samples}; "
                    "expected one row per time. Check that the arrays belong together "
                    "and are not transposed."
                )
        if self.n_samples < 2:
            raise DataError(
                f"{title} has {number_of(self.n_samples, 'sample')}; "
                "expected at least 2. Leave the trajectory out."
            )
        check_values(self.t, f"{title}: t[{{}}]".format, may_be_missing=False)
        for before in np.flatnonzero(np.diff(self.t) <= 0)[:1]:
            after = before + 1
            raise DataError(
                f"{title}: t[{after}]={float(self.t[after])} does not "
                f"exceed t[{before}]={float(self.t[before])}; times must increase. "
                "Give each run as arrays of its own; correct or leave out a sample "
                "whose time is wrong."
            )

    @property
    def title(self) -> str:
        """How sentences name it; "run 3" where its name is a number."""
        return f"run {self.name}" if self.name.isdigit() else self.name

    @property
    def n_samples(self) -> int:
        """The number of samples."""
        return len(self.t)

    def __repr__(self) -> str:
        """Name, number of samples and the span of time."""
        span = f"t = {self.t[0]:g} to {self.t[-1]:g}"
        return f"Trajectory({self.name!r}, {self.n_samples} samples, {span})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Through the constructor, because unpickled arrays would be writeable."""
        arrays = (self.t, self.x, self.u)
        return type(self), (self.name, *arrays, self.origin, self.remark, self.past)


def run_numbers(runs: Sequence[Trajectory]) -> np.ndarray:
    """The number of the trajectory of each sample of all of them, (n_samples,)."""
    return np.repeat(np.arange(len(runs)), [run.n_samples for run in runs])


def check_channels(
    run: Trajectory, states: tuple[str, ...], inputs: tuple[str, ...]
) -> None:
    """Check the columns of a trajectory against the names of the channels."""
    for kind, names, values in (("state", states, run.x), ("input", inputs, run.u)):
        n_columns = values.shape[1]
        if n_columns != len(names):
            raise DataError(
                f"trajectory {run.name!r} has {number_of(n_columns, f'{kind} column')};"
                f" expected {len(names)}, one for each of {list(names)}. "
                "Name every column of the array."
            )

        def place_of(i: int, k: int, kind: str = kind, names: Any = names) -> str:
            channel = f"trajectory {run.name!r}: {kind} {names[k]!r}"
            return f"{channel} at sample {i} (t={run.t[i]})"

        check_values(values, place_of, may_be_missing=kind == "state")
    if not np.isfinite(run.x).any():
        raise DataError(
            f"trajectory {run.name!r} has no measured value in any of the states "
            f"{list(states)}; expected at least one measured state. "
            "Map a state to its column or leave the trajectory out."
        )


# ---- inputs between samples ----------------------------------------------------------


def is_stepped(runs: Sequence[np.ndarray]) -> bool:
    """Whether a signal is constant between isolated jumps.

    A jump is a change from one sample to the next by more than the two changes before
    it and the two after it together, and by more than half of the standard deviation;
    of any size where most neighbours are equal and changes have, on average, more than
    1.5 steps of the resolution: a continuous signal passes through every step.
    The constant stretches between jumps explain 97 % of the variance of the runs: of
    steps measured with a noise of a tenth 99 %, of a wave of a third beside a step
    90 %, of ramps, noise and what a coarse sensor shows less.
    """
    window = np.ones(5)  # two changes before a change and two after it
    long = [run for run in runs if len(run) > len(window)]
    total = sum(len(run) * float(np.var(run)) for run in long)
    least = np.sqrt(total / max(sum(map(len, long)), 1)) / 2
    changes = np.abs(np.concatenate([np.zeros(0), *map(np.diff, long)]))
    moved = changes[changes > 0]
    if 0 < len(moved) < len(changes) / 2:
        is_several = np.mean(moved) > 1.5 * resolution(long)
        least = 0.0 if is_several else least
    within = 0.0
    for run in long:
        size = np.abs(np.diff(run))
        others = np.convolve(size, window, mode="same") - size
        # Rounding of the sums is no change.
        is_jump = (size > least) & (size > others * (1 + 1e-9))
        for stretch in np.split(run, np.flatnonzero(is_jump) + 1):
            within += len(stretch) * float(np.var(stretch))
    return within < (1 - 0.97) * total


@dataclass(frozen=True, eq=False)
class InputCurve:
    """An input at any time; before its first sample, and after the last, it is held.

    Smooth between the samples (``hold="cubic"``) it is the spline through them, with
    two continuous derivatives, and at both ends a third ("not a knot"): two samples
    make a line, three a parabola. A straight line from sample to sample is too low at
    every crest: of a wave of w h radians per sample it keeps the share 1 - (w h)^2/12,
    and a fit takes what is lost for friction or for a softer spring.

    Args:
        t: (n_samples,) strictly increasing times.
        u: (n_samples,) the input there.
        hold: what it does between them.
    """

    t: np.ndarray
    u: np.ndarray
    hold: str

    @cached_property
    def instant(self) -> float:
        """A time shorter than any other, and longer than rounding."""
        rounding = 8 * float(np.spacing(np.max(np.abs(self.t))))
        return max(1e-9 * float(np.min(np.diff(self.t), initial=1.0)), rounding)

    @cached_property
    def _value(self) -> Any:
        from scipy.interpolate import CubicSpline, PPoly  # slow to import

        t, u = self.t, self.u
        rise = np.diff(u) / np.diff(t) * (self.hold == "linear")
        between = np.array([rise, u[:-1]])
        if self.hold == "cubic" and len(t) > 1:
            between = CubicSpline(t, u).c
        coefficients = np.pad(between, ((0, 0), (1, 1)))
        coefficients[-1, [0, -1]] = u[[0, -1]]
        return PPoly(coefficients, np.r_[t[0] - 1.0, t, t[-1] + 1.0])

    @cached_property
    def _areas(self) -> tuple[Any, Any]:
        return self._value.antiderivative(1), self._value.antiderivative(2)

    def after(self, times: np.ndarray, order: int = 0) -> np.ndarray:
        """Its value an instant later, behind a jump; or its slope, of order one."""
        return np.asarray(self._value(times + self.instant, order))

    def around(self, times: np.ndarray, order: int = 0) -> np.ndarray:
        """The mean of both sides of a jump."""
        before = self._value(times - self.instant, order)
        return np.asarray((before + self.after(times, order)) / 2)

    def lines(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The straight line that acts in each stretch of time like the input.

        A step of an integrator takes its input from a line. That with the mean and the
        first moment of the input moves a mass as far, and leaves it as fast, as the
        input does. It need not meet the line of the next stretch.

        Returns:
            (4, n) values at the begin and at the end, and how fast both of them change
            as the stretch is moved in time.
        """
        h = end - begin
        area, areas = ((one(begin), one(end)) for one in self._areas)
        mean = (area[1] - area[0]) / h
        moment = h * (area[0] + area[1]) / 2 - (areas[1] - areas[0])
        rise = 6 * moment / h**2
        first, last = self.around(begin), self.around(end)
        of_mean = (last - first) / h
        of_rise = 3 * (first + last - 2 * mean) / h
        ends = (mean - rise, mean + rise, of_mean - of_rise, of_mean + of_rise)
        return np.array(ends)


# ---- arrays --------------------------------------------------------------------------


def trajectories_in_arrays(
    t: Any, x: Any, u: Any, names: Sequence[str] | None
) -> tuple[Trajectory, ...]:
    """The trajectories of `Measurements.from_arrays`; None: no inputs, numbered names.

    Whole times too large for a float are counted from the first.
    """
    is_list = isinstance(t, list | tuple) and len(t) > 0 and np.iterable(t[0])
    if not is_list:
        t, x, u = [t], [x], None if u is None else [u]
    if names is None:
        names = numbered_names("run ", len(t))
    if u is None:
        u = []
        for name, t_run in zip(names, t, strict=False):
            times = read_only_floats(t_run, 1, f"trajectory {name!r}: t")
            u.append(np.empty((len(times), 0)))
    lengths = {}
    for what, values in {"t": t, "x": x, "u": u, "names": names}.items():
        is_sized = np.iterable(values) and hasattr(values, "__len__")
        lengths[what] = len(values) if is_sized else None
    if len(set(lengths.values())) > 1:
        raise DataError(
            f"the lengths differ: {lengths}; expected one entry per trajectory. "
            "Check that the lists belong together."
        )
    return tuple(
        Trajectory(name, from_first(t_run, t[0]), x_run, u_run)
        for name, t_run, x_run, u_run in zip(names, t, x, u, strict=True)
    )
