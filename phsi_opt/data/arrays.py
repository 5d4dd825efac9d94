"""Arrays in memory as trajectories: whole records, or integration steps that join.

Some sources hand over steps, each with its own start and end, instead of records: those
that continue each other become one trajectory.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from phsi_opt.data.checks import (
    Hold,
    check_same_length,
    check_values,
    from_first,
    hold_of_each,
    numbered_names,
    read_only_floats,
)
from phsi_opt.data.trajectory import Trajectory
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
    trajectories = []
    for name, t_run, x_run, u_run in zip(names, t, x, u, strict=True):
        trajectories.append(Trajectory(name, from_first(t_run, t[0]), x_run, u_run))
    return tuple(trajectories)


Both = tuple[Any, Any]  # one quantity at the starts and at the ends of all pairs


def joined_pairs(
    t: Both, x: Both, u: Both, inputs: Sequence[str] | None, hold: Hold
) -> tuple[list[np.ndarray], ...]:
    """Times, states and inputs of the trajectories that pairs make, in their order.

    A pair continues the pair before it if it starts at the same time, state and input;
    two values that were not measured are the same. A held input ("zero") acts on
    nothing at the end of a pair: it is not compared, and may be None if all are held.

    Args:
        t: Times, (n_pairs,).
        x: States, (n_pairs, n_states); a single one may be (n_pairs,).
        u: Inputs likewise; None at both ends: there are none.
        inputs: Their names; None: "u1", "u2", ...
        hold: What they do between samples.

    Raises:
        DataError: There are no pairs, the shapes differ, an array cannot be used, or a
            pair does not go forward in time.
    """
    if u[0] is None and u[1] is None:
        u = (np.empty((np.size(t[0]), 0)),) * 2
    n_inputs = np.shape(u[0])[1] if np.ndim(u[0]) == 2 else 1
    names = numbered_names("u", n_inputs) if inputs is None else inputs
    is_held = hold_of_each(hold, names) == "zero"
    if u[1] is None and is_held.all():
        u = (u[0], u[0])
    if u[0] is None or u[1] is None:
        raise DataError(
            "only one of u_start and u_end is given; expected both. "
            "If u keeps its value: hold='zero'."
        )
    sides = []
    for k, side in enumerate(("start", "end")):
        told = {"x": x[k], "t": from_first(t[k], t[0]), "u": u[k]}
        arrays = {}
        for label, values in told.items():
            title = f"{label}_{side}"
            arrays[title] = read_only_floats(values, 1 if label == "t" else 2, title)
        sides.append(arrays)
    _check_pairs(*sides)
    start, end = (np.column_stack(list(one.values())) for one in sides)
    same = (start[1:] == end[:-1]) | (np.isnan(start[1:]) & np.isnan(end[:-1]))
    if n_inputs == len(names):  # else refused with the names
        same[:, same.shape[1] - n_inputs :] |= is_held
    runs = np.split(np.arange(len(start)), np.flatnonzero(~same.all(axis=1)) + 1)
    samples = [np.vstack([start[rows], end[rows[-1:]]]) for rows in runs]
    k = sides[0]["x_start"].shape[1]
    return (
        [one[:, k] for one in samples],
        [one[:, :k] for one in samples],
        [one[:, k + 1 :] for one in samples],
    )


def _check_pairs(
    starts: Mapping[str, np.ndarray], ends: Mapping[str, np.ndarray]
) -> None:
    for (name, start), (other, end) in zip(starts.items(), ends.items(), strict=True):
        if start.shape != end.shape:
            raise DataError(
                f"{name} has the shape {start.shape} and {other} {end.shape}; "
                "expected the same shape."
            )
    check_same_length(starts, "one row per pair")
    t = starts["t_start"]
    t_end = ends["t_end"]
    if not len(t):
        raise DataError(
            "there are no pairs; expected at least one row in x_start and t_start."
        )
    check_values(t, "t_start[{}]".format, may_be_missing=False)
    check_values(t_end, "t_end[{}]".format, may_be_missing=False)
    for k in np.flatnonzero(t_end <= t)[:1]:
        raise DataError(
            f"pair {k}: t_end[{k}]={float(t_end[k])} is not after "
            f"t_start[{k}]={float(t[k])}; each pair must go forward in time. "
            "Exchange the two ends or drop the pair."
        )
