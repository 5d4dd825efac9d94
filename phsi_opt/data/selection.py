"""Parts of measurements: trajectories by name, samples in time, one for every n."""

import operator
from collections.abc import Sequence
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError, did_you_mean

WAYS_OF_THINNING = ("mean", "picking")


def number_of_trajectory(names: Sequence[str], trajectory: str | int) -> int:
    """The number of a trajectory among all names: see `Measurements.trajectory_number`.

    Raises:
        DataError: There is no such trajectory.
    """
    if isinstance(trajectory, str):
        if trajectory in names:
            return names.index(trajectory)
        hint = did_you_mean(trajectory, names)
        raise DataError(
            f"there is no trajectory {trajectory!r}; expected one of {names}.{hint}"
        )
    if not hasattr(trajectory, "__index__"):
        raise DataError(
            f"trajectory {trajectory!r} is unknown; expected a name of {names} "
            "or a number, counted from 0. Samples are chosen by data.between(begin, "
            "end)."
        )
    number = operator.index(trajectory)
    n_trajectories = len(names)
    if not -n_trajectories <= number < n_trajectories:
        raise DataError(
            f"there is no trajectory {number}; there are {n_trajectories}, "
            f"counted from 0: {names}."
        )
    return number % n_trajectories


def check_slice(names: Sequence[str], key: slice) -> None:
    """Refuse a slice beyond the trajectories, which was meant for samples.

    Raises:
        DataError: It begins, ends or steps beyond the trajectories, or is empty.
    """
    bounds = [key.start, key.stop, key.step]
    for bound in bounds:
        is_whole = bound is None or hasattr(bound, "__index__")
        if not is_whole or abs(operator.index(bound or 0)) > len(names):
            break
    else:
        if names[key]:
            return
    if key.step is None:
        del bounds[-1]
    written = ":".join("" if bound is None else repr(bound) for bound in bounds)
    raise DataError(
        f"data[{written}] picks trajectories, of which there are {len(names)}: "
        f"{list(names)}. For a part of each in time use data.between(begin, end), "
        "for fewer samples data.thinned(n)."
    )


def check_fraction(fraction: Any) -> None:
    """Refuse a share of the training data that is not between 0 and 1.

    Raises:
        DataError: It is none.
    """
    if not isinstance(fraction, Real) or not 0 < float(fraction) < 1:
        raise DataError(
            f"fraction={fraction!r} is not between 0 and 1; "
            "give the training data's share, e.g. 0.7."
        )


def size_of_first_part(n: int, fraction: float, at_least: int) -> int:
    """The size of the first of two parts of n things, each of ``at_least`` things."""
    n_first = max(round(fraction * n), at_least)
    return min(n_first, n - at_least)


def check_interval(begin: Any, end: Any) -> None:
    """Refuse what is no part of the time; None is an open end.

    Raises:
        DataError: An end is no number, or they are not in order.
    """
    for value in (begin, end):
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if value is not None and (not is_number or np.isnan(value)):
            raise DataError(
                f"between({begin!r}, {end!r}): {value!r} is no time; expected numbers "
                "in the unit of the times, or None."
            )
    if begin is not None and end is not None and not begin < end:
        raise DataError(
            f"between({begin!r}, {end!r}): the first time must be less than the last."
        )


def part_between(run: Trajectory, begin: float | None, end: float | None) -> Trajectory:
    """The samples of a trajectory with begin <= t <= end, their times as they are.

    Raises:
        DataError: There are fewer than 2.
    """
    first = -np.inf if begin is None else float(begin)
    last = np.inf if end is None else float(end)
    rows = np.searchsorted(run.t, first), np.searchsorted(run.t, last, side="right")
    n_samples = max(int(rows[1] - rows[0]), 0)
    if n_samples < 2:
        raise DataError(
            f"trajectory {run.name!r} has {n_samples} samples between {first:g} and "
            f"{last:g}; expected at least 2. Its times go from {run.t[0]:g} to "
            f"{run.t[-1]:g}; choose others, or other trajectories first: data[name]."
        )
    return part_of(run, slice(*rows))


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


def thinned_run(run: Trajectory, n: int, by: str, hold: np.ndarray) -> Trajectory:
    """A trajectory with one sample for every n: see `Measurements.thinned`.

    Args:
        run: The trajectory.
        n: The number of samples that make one.
        by: "picking" keeps every n-th, from the first, "mean" the means of n.
        hold: (n_inputs,) what each input does between samples.

    Raises:
        DataError: Fewer than 2 samples would be left.
    """
    is_picked = by == "picking"
    n_left = 1 + (run.n_samples - 1) // n if is_picked else run.n_samples // n
    if n_left < 2:
        raise DataError(
            f"trajectory {run.name!r} has {run.n_samples} samples, too few for "
            f"thinned({n}): {n_left} would be left; expected at least 2."
        )
    if is_picked or n == 1:
        return part_of(run, slice(None, None, n))

    def means(values: np.ndarray) -> np.ndarray:
        groups = values[: n_left * n].reshape(n_left, n, *values.shape[1:])
        mean: np.ndarray = groups.mean(axis=1)
        return mean

    t = means(run.t)
    u = np.where(hold == "zero", _held_means(run, t), means(run.u))
    return replace(run, t=t, x=means(run.x), u=u)


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
