"""A part of a trajectory in time, and a trajectory with fewer samples."""

import operator
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError, did_you_mean

WAYS_OF_THINNING = ("mean", "picking")


@dataclass(frozen=True)
class Interval:
    """A part of the time, both ends with it."""

    begin: float
    end: float


def checked_interval(begin: Any, end: Any) -> Interval:
    """The part of the time that a user asks for; None is an open end.

    Raises:
        DataError: An end is no number, or they are not in order.
    """
    first = -np.inf if begin is None else begin
    last = np.inf if end is None else end
    for value in (first, last):
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if not is_number or np.isnan(float(value)):
            raise DataError(
                f"between({begin!r}, {end!r}): {value!r} is no time; expected numbers "
                "in the unit of the times, or None."
            )
    if not first < last:
        raise DataError(
            f"between({begin!r}, {end!r}): the first time must be less than the last."
        )
    return Interval(float(first), float(last))


def part_between(run: Trajectory, interval: Interval) -> Trajectory:
    """The samples of a trajectory within an interval, their times as they are.

    Raises:
        DataError: There are fewer than 2.
    """
    first = int(np.searchsorted(run.t, interval.begin, side="left"))
    after = int(np.searchsorted(run.t, interval.end, side="right"))
    if after - first < 2:
        raise DataError(
            f"trajectory {run.name!r} has {max(after - first, 0)} samples between "
            f"{interval.begin:g} and {interval.end:g}; expected at least 2. "
            f"Its times go from {run.t[0]:g} to {run.t[-1]:g}; choose others, or other "
            "trajectories first: data[name]."
        )
    return part_of(run, slice(first, after))


def checked_group_size(n: Any, by: Any) -> int:
    """How many samples make one, where the way is known.

    Raises:
        DataError: n is no positive integer, or the way is unknown.
    """
    if by not in WAYS_OF_THINNING:
        hint = did_you_mean(by, WAYS_OF_THINNING)
        raise DataError(f"by={by!r} is unknown; expected 'mean' or 'picking'.{hint}")
    is_integer = hasattr(n, "__index__") and not isinstance(n, bool)
    if not is_integer or operator.index(n) < 1:
        raise DataError(
            f"thinned({n!r}): expected how many samples make one, such as 10."
        )
    return operator.index(n)


def every_nth(run: Trajectory, n: int, hold: str) -> Trajectory:
    """Every n-th sample as it is, from the first; inputs too, however they are held.

    Raises:
        DataError: Fewer than 2 samples are left.
    """
    _check_enough(run, n, 1 + (run.n_samples - 1) // n)
    return part_of(run, slice(None, None, n))


def mean_of_groups(run: Trajectory, n: int, hold: str) -> Trajectory:
    """Means of n neighbouring samples, at the means of their times.

    Args:
        run: The trajectory.
        n: The number of samples of a group.
        hold: What inputs do between samples; held ones ("zero") are averaged over the
            time from one mean to the next.

    Raises:
        DataError: There are fewer than 2 groups.
    """
    if n == 1:
        return run
    n_groups = run.n_samples // n
    _check_enough(run, n, n_groups)
    t = _means(run.t[:, np.newaxis], n_groups, n)[:, 0]
    x = _means(run.x, n_groups, n)
    u = _held_means(run, t) if hold == "zero" else _means(run.u, n_groups, n)
    return replace(run, t=t, x=x, u=u)


def _check_enough(run: Trajectory, n: int, n_left: int) -> None:
    if n_left < 2:
        raise DataError(
            f"trajectory {run.name!r} has {run.n_samples} samples, too few for "
            f"thinned({n}): {n_left} would be left; expected at least 2."
        )


def _means(values: np.ndarray, n_groups: int, n: int) -> np.ndarray:
    """Means (n_groups, n_channels) of neighbouring rows; NaN where one is NaN."""
    groups = values[: n_groups * n].reshape(n_groups, n, values.shape[1])
    means: np.ndarray = groups.mean(axis=1)
    return means


def _held_means(run: Trajectory, t: np.ndarray) -> np.ndarray:
    """Means (n_groups, n_inputs) of held inputs from each time to the next.

    The last one is held as long as its trajectory has samples.
    """
    steps = np.diff(run.t)[:, np.newaxis]
    passed = np.cumsum(run.u[:-1] * steps, axis=0)
    integral = np.vstack([np.zeros(run.u.shape[1]), passed])  # at every sample
    ends = np.append(t, run.t[-1])
    means = np.empty((len(t), run.u.shape[1]))
    for i in range(run.u.shape[1]):
        at_ends = np.interp(ends, run.t, integral[:, i])
        means[:, i] = np.diff(at_ends) / np.diff(ends)
    return means
