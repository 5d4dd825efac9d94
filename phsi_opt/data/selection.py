"""Choosing trajectories by name or number, and how many of n make the training data."""

import operator
from collections.abc import Sequence
from numbers import Real
from typing import Any

from phsi_opt.errors import DataError, did_you_mean


def number_of_trajectory(names: Sequence[str], trajectory: str | int) -> int:
    """The number of a trajectory among all names: see `Measurements.trajectory_number`.

    Raises:
        DataError: There is no such trajectory.
    """
    if isinstance(trajectory, str):
        return _number_by_name(names, trajectory)
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


def _number_by_name(names: Sequence[str], name: str) -> int:
    if name not in names:
        hint = did_you_mean(name, names)
        raise DataError(
            f"there is no trajectory {name!r}; expected one of {names}.{hint}"
        )
    return names.index(name)


def slice_of_trajectories(names: Sequence[str], key: slice) -> slice:
    """A slice of trajectories; one that reaches beyond them was meant for samples.

    Raises:
        DataError: It begins, ends or steps beyond the trajectories, or is empty.
    """
    n = len(names)
    for bound in (key.start, key.stop, key.step):
        is_whole = bound is None or hasattr(bound, "__index__")
        if not is_whole or (bound is not None and abs(operator.index(bound)) > n):
            raise DataError(_not_samples(names, key))
    if not names[key]:
        raise DataError(_not_samples(names, key))
    return key


def _not_samples(names: Sequence[str], key: slice) -> str:
    parts = [key.start, key.stop]
    if key.step is not None:
        parts.append(key.step)
    written = ":".join("" if part is None else f"{part!r}" for part in parts)
    return (
        f"data[{written}] picks trajectories, of which there are {len(names)}: "
        f"{list(names)}. For a part of each in time use data.between(begin, end), "
        "for fewer samples data.thinned(n)."
    )


def checked_fraction(fraction: Any) -> float:
    """The share of the training data.

    Raises:
        DataError: It is not a number between 0 and 1.
    """
    if not isinstance(fraction, Real) or not 0 < float(fraction) < 1:
        raise DataError(
            f"fraction={fraction!r} is not between 0 and 1; "
            "give the training data's share, e.g. 0.7."
        )
    return float(fraction)


def size_of_first_part(n: int, fraction: float, at_least: int) -> int:
    """The size of the first of two parts of n things, each of ``at_least`` things."""
    n_first = max(round(fraction * n), at_least)
    return min(n_first, n - at_least)
