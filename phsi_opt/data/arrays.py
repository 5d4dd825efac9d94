"""Arrays in memory as trajectories: whole records, or integration steps that join.

Some sources hand over steps, each with its own start and end, instead of records: those
that continue each other become one trajectory.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from phsi_opt.data.checks import (
    check_same_length,
    check_values,
    from_first,
    read_only_floats,
)
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.data.wording import numbered_names
from phsi_opt.errors import DataError


def trajectories_in_arrays(
    t: Any, x: Any, u: Any, names: Sequence[str] | None
) -> tuple[Trajectory, ...]:
    """The trajectories which `Measurements.from_arrays` is given.

    Args:
        t: Times (n_samples,), or a list of such arrays, one per trajectory.
        x: States (n_samples, n_states), or (n_samples,) for a single state; a list of
            those where ``t`` is a list. Whole numbers too large for a float are
            counted from the first.
        u: Inputs likewise, or None: there are none.
        names: The names of the trajectories; None: "run 1", "run 2", ...

    Raises:
        DataError: The lists differ in length, or an array cannot be used.
    """
    is_list = isinstance(t, list | tuple) and len(t) > 0 and np.ndim(t[0]) > 0
    if not is_list:
        t = [t]
        x = [x]
        u = None if u is None else [u]
    if u is None:
        u = [np.empty((np.size(t_run), 0)) for t_run in t]
    if names is None:
        names = numbered_names("run ", len(t))
    lists = {"t": t, "x": x, "u": u, "names": names}
    check_same_length(lists, "one entry per trajectory")
    first = np.asarray(t[0]).flat[0] if np.size(t[0]) else None
    trajectories = []
    for name, t_run, x_run, u_run in zip(names, t, x, u, strict=True):
        trajectories.append(Trajectory(name, from_first(t_run, first), x_run, u_run))
    return tuple(trajectories)


class Ends(NamedTuple):
    """One quantity at both ends of every pair: (n_pairs,), or (n_pairs, n_channels)."""

    start: Any
    end: Any


class JoinedPairs(NamedTuple):
    """Samples by trajectory: times (n_samples,), states and inputs (n_samples, ...)."""

    t: list[np.ndarray]
    x: list[np.ndarray]
    u: list[np.ndarray]


def joined_pairs(t: Ends, x: Ends, u: Ends, hold: str) -> JoinedPairs:
    """The samples of the trajectories that pairs make, in the order of the pairs.

    A pair continues the pair before it if it starts at the same time, state and input;
    two values that were not measured are the same. With hold="zero" the input at the
    end of a pair acts on nothing: it is not compared, and may be None.

    Args:
        t: Times.
        x: States; a single one may be (n_pairs,).
        u: Inputs; None at both ends: there are none.
        hold: What inputs do between samples.

    Raises:
        DataError: There are no pairs, the shapes differ, an array cannot be used, or a
            pair does not go forward in time.
    """
    is_held = hold == "zero"
    x = _checked_ends(x, "x", 2)
    first = np.asarray(t.start).flat[0] if np.size(t.start) else None
    t = Ends(from_first(t.start, first), from_first(t.end, first))
    t = _checked_ends(t, "t", 1)
    if u == (None, None):
        u = Ends(np.empty((len(t.start), 0)), np.empty((len(t.start), 0)))
    elif u.start is None or (u.end is None and not is_held):
        raise DataError(
            "only one of u_start and u_end is given; expected both. "
            "If u keeps its value: hold='zero'."
        )
    u = _checked_ends(Ends(u.start, u.start if u.end is None else u.end), "u", 2)
    _check_pairs(t, x, u)
    continues = (t.start[1:] == t.end[:-1]) & _meet(x)
    if not is_held:
        continues &= _meet(u)
    runs = np.split(np.arange(len(t.start)), np.flatnonzero(~continues) + 1)
    return JoinedPairs(_joined(t, runs), _joined(x, runs), _joined(u, runs))


def _checked_ends(ends: Ends, label: str, n_axes: int) -> Ends:
    """Both ends of the pairs, as read-only float64 copies."""
    start = read_only_floats(ends.start, n_axes, f"{label}_start")
    end = read_only_floats(ends.end, n_axes, f"{label}_end")
    if start.shape != end.shape:
        raise DataError(
            f"{label}_start has the shape {start.shape} and {label}_end {end.shape}; "
            "expected the same shape."
        )
    return Ends(start, end)


def _check_pairs(t: Ends, x: Ends, u: Ends) -> None:
    starts = {"x_start": x.start, "t_start": t.start, "u_start": u.start}
    check_same_length(starts, "one row per pair")
    if not len(t.start):
        raise DataError(
            "there are no pairs; expected at least one row in x_start and t_start."
        )
    check_values(t.start, "t_start[{}]".format, may_be_missing=False)
    check_values(t.end, "t_end[{}]".format, may_be_missing=False)
    is_late = t.end <= t.start
    if is_late.any():
        k = int(np.argmax(is_late))
        raise DataError(
            f"pair {k}: t_end[{k}]={float(t.end[k])} is not after "
            f"t_start[{k}]={float(t.start[k])}; each pair must go forward in time. "
            "Exchange the two ends or drop the pair."
        )


def _meet(ends: Ends) -> np.ndarray:
    """Whether each pair but the first starts where the one before ended, (n - 1,)."""
    start = ends.start[1:]
    end = ends.end[:-1]
    is_same = (start == end) | (np.isnan(start) & np.isnan(end))
    every_channel: np.ndarray = is_same.all(axis=1)
    return every_channel


def _joined(ends: Ends, runs: list[np.ndarray]) -> list[np.ndarray]:
    """The samples of each trajectory: the starts of its pairs, and the last end."""
    return [np.concatenate([ends.start[rows], ends.end[rows[-1:]]]) for rows in runs]
