"""A trajectory with fewer samples: one for every n."""

import operator
from dataclasses import replace
from typing import Any

import numpy as np

from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError, did_you_mean

WAYS_OF_THINNING = ("mean", "picking")


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
