"""Choosing a part of measurements: trajectories by name or number, samples in time."""

import operator
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np

from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError, did_you_mean


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
