"""Arrays in memory as trajectories: one trajectory, or lists of several."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from phsi_opt.data.checks import check_same_length, from_first, with_channel_axis
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.data.wording import numbered_names


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
    if not _is_list_of_arrays(t):
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
    first = np.asarray(t[0]).flat[0] if np.size(t[0]) else None
    for name, t_run, x_run, u_run in zip(names, t, x, u, strict=True):
        states = with_channel_axis(x_run)
        inputs = with_channel_axis(u_run)
        times = from_first(t_run, first)
        trajectories.append(Trajectory(name, times, states, inputs))
    return tuple(trajectories)


def _is_list_of_arrays(t: Any) -> bool:
    return isinstance(t, list | tuple) and len(t) > 0 and np.ndim(t[0]) > 0
