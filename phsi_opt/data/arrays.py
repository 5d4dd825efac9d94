"""Arrays in memory as trajectories: whole records, or integration steps that join.

Some sources hand over steps, each with its own start and end, instead of records: those
that continue each other become one trajectory.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from phsi_opt.data.checks import (
    Hold,
    check_same_length,
    check_values,
    from_first,
    hold_of_each,
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


def joined_pairs(
    t: Ends, x: Ends, u: Ends, inputs: Sequence[str] | None, hold: Hold
) -> JoinedPairs:
    """The samples of the trajectories that pairs make, in the order of the pairs.

    A pair continues the pair before it if it starts at the same time, state and input;
    two values that were not measured are the same. A held input ("zero") acts on
    nothing at the end of a pair: it is not compared, and may be None if all are held.

    Args:
        t: Times.
        x: States; a single one may be (n_pairs,).
        u: Inputs; None at both ends: there are none.
        inputs: Their names; None: "u1", "u2", ...
        hold: What they do between samples.

    Raises:
        DataError: There are no pairs, the shapes differ, an array cannot be used, or a
            pair does not go forward in time.
    """
    x = _checked_ends(x, "x", 2)
    first = np.asarray(t.start).flat[0] if np.size(t.start) else None
    t = Ends(from_first(t.start, first), from_first(t.end, first))
    t = _checked_ends(t, "t", 1)
    if u.start is None and u.end is None:
        u = Ends(np.empty((len(t.start), 0)), None)
    n_inputs = np.shape(u.start)[1] if np.ndim(u.start) == 2 else 1
    names = numbered_names("u", n_inputs) if inputs is None else inputs
    is_held = hold_of_each(hold, names) == "zero"
    if u.start is None or (u.end is None and not is_held.all()):
        raise DataError(
            "only one of u_start and u_end is given; expected both. "
            "If u keeps its value: hold='zero'."
        )
    u = _checked_ends(Ends(u.start, u.start if u.end is None else u.end), "u", 2)
    _check_pairs(t, x, u)
    continues = (t.start[1:] == t.end[:-1]) & np.all(_meet(x), axis=1)
    if n_inputs == len(names):  # else refused with the names
        continues &= np.all(_meet(u) | is_held, axis=1)
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
    """Whether pairs start where those before them ended, (n_pairs - 1, n_channels)."""
    start = ends.start[1:]
    end = ends.end[:-1]
    is_same: np.ndarray = (start == end) | (np.isnan(start) & np.isnan(end))
    return is_same


def _joined(ends: Ends, runs: list[np.ndarray]) -> list[np.ndarray]:
    """The samples of each trajectory: the starts of its pairs, and the last end."""
    return [np.concatenate([ends.start[rows], ends.end[rows[-1:]]]) for rows in runs]
