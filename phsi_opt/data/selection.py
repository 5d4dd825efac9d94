"""Parts of measurements: trajectories by name, samples in time, one for every n."""

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any, Self

import numpy as np

from phsi_opt.arguments import is_count, require_known
from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError


class Selections:
    """The parts of `Measurements`, each of which is one."""

    trajectories: tuple[Trajectory, ...]
    inputs: tuple[str, ...]
    hold: Hold
    noise: Mapping[str, float] | None

    def _of(self, runs: Iterable[Trajectory], **further: Any) -> Self:
        """The same with other trajectories."""
        whole: Any = self  # a `Measurements`
        part: Self = replace(whole, trajectories=tuple(runs), **further)
        return part

    def __getitem__(self, key: int | slice | str) -> Self:
        """The measurements of one trajectory (by number or name) or of a slice.

        Raises:
            DataError: There is no such trajectory, or samples seem to be meant.
        """
        if isinstance(key, slice):
            _check_slice([run.name for run in self.trajectories], key)
            return self._of(self.trajectories[key])
        return self._of([self.trajectories[self.trajectory_number(key)]])

    def trajectory_number(self, trajectory: str | int) -> int:
        """The number of a trajectory, counted from 0, by its name or its number.

        Negative numbers count from the end, as in a list.

        Raises:
            DataError: There is no such trajectory.
        """
        names = [run.name for run in self.trajectories]
        if isinstance(trajectory, str):
            said = f"there is no trajectory {trajectory!r}"
            require_known(trajectory, names, said, DataError)
            return names.index(trajectory)
        if not hasattr(trajectory, "__index__"):
            raise DataError(
                f"trajectory {trajectory!r} is unknown; expected a name of {names} "
                "or a number, counted from 0. Samples are chosen by "
                "data.between(begin, end)."
            )
        number = operator.index(trajectory)
        if not -len(names) <= number < len(names):
            raise DataError(
                f"there is no trajectory {number}; there are {len(names)}, "
                f"counted from 0: {names}."
            )
        return number % len(names)

    def split(self, fraction: float = 0.7) -> tuple[Self, Self]:
        """Training and test data: the first trajectories, and the others.

        A single trajectory is cut in time instead: its first round(fraction *
        n_samples) samples, and the samples after them. Nothing is drawn at random: the
        order of the file decides. Each part has at least one trajectory, or two
        samples, and no sample is in both.

        Args:
            fraction: The share of the training data, between 0 and 1.

        Raises:
            DataError: The fraction is not between 0 and 1, or a single trajectory has
                fewer than 4 samples.
        """
        if not isinstance(fraction, Real) or not 0 < float(fraction) < 1:
            raise DataError(
                f"fraction={fraction!r} is not between 0 and 1; "
                "give the training data's share, e.g. 0.7."
            )
        if len(self.trajectories) > 1:
            n_train = _size_of_first(len(self.trajectories), fraction, at_least=1)
            return self[:n_train], self[n_train:]
        (run,) = self.trajectories
        if run.n_samples < 4:
            raise DataError(
                f"trajectory {run.name!r} has {run.n_samples} samples; "
                "a split in time needs at least 4."
            )
        n_train = _size_of_first(run.n_samples, fraction, at_least=2)
        train = part_of(run, slice(n_train))
        test = part_of(run, slice(n_train, None))
        return self._of([train]), self._of([test])

    def between(self, begin: float | None, end: float | None) -> Self:
        """The samples with begin <= t <= end of every trajectory.

        Clocks are kept: a force that follows the time, and an input, act when they did.

        Args:
            begin: The first time, in the unit of the times; None: from the start.
            end: The last time; None: to the end.

        Raises:
            DataError: The times are not in order, or a trajectory has fewer than 2
                samples between them.
        """
        said = f"between({begin!r}, {end!r})"
        for value in (begin, end):
            is_number = isinstance(value, Real) and not isinstance(value, bool)
            if value is not None and (not is_number or np.isnan(value)):
                raise DataError(
                    f"{said}: {value!r} is no time; expected numbers in the unit of "
                    "the times, or None."
                )
        if begin is not None and end is not None and not begin < end:
            raise DataError(f"{said}: the first time must be less than the last.")
        first = -np.inf if begin is None else float(begin)
        last = np.inf if end is None else float(end)
        return self._of(_between(run, first, last) for run in self.trajectories)

    def thinned(self, n: int, by: str = "mean") -> Self:
        """Fewer samples: one for every n of each trajectory.

        With ``by="mean"`` a sample is the mean of n neighbouring ones, at the mean of
        their times: what is faster than the new sampling rate is averaged out instead
        of appearing as something slower (aliasing). A state is missing where one of its
        n samples is. Noise that is given becomes smaller by sqrt(n), as if the errors
        of samples were independent. An input that is held (``hold="zero"``) is averaged
        over the time from each new sample to the next.

        With ``by="picking"`` every n-th sample is kept as it is, from the first. Use it
        where the signals are smooth at the new rate, or states have gaps; what inputs
        did between the samples that are kept is lost.

        Samples at the end that do not fill a group of n are left out by the mean.

        Args:
            n: How many samples make one.
            by: "mean" or "picking".

        Raises:
            DataError: n is no positive number, or a trajectory would have fewer than 2
                samples.
        """
        require_known(by, ("mean", "picking"), f"by={by!r} is unknown", DataError)
        if not is_count(n):
            raise DataError(
                f"thinned({n!r}): expected how many samples make one, such as 10."
            )
        size = int(n)
        hold = hold_of_each(self.hold, self.inputs)
        runs = [_thinned_run(run, size, by, hold) for run in self.trajectories]
        noise = self.noise
        if noise is not None and by == "mean":
            noise = {name: sigma / np.sqrt(size) for name, sigma in noise.items()}
        return self._of(runs, noise=noise)


def _check_slice(names: Sequence[str], key: slice) -> None:
    """Refuse a slice beyond the trajectories, which was meant for samples."""
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


def _size_of_first(n: int, fraction: float, at_least: int) -> int:
    """The size of the first of two parts of n things, each of ``at_least`` things."""
    n_first = max(round(fraction * n), at_least)
    return min(n_first, n - at_least)


def _between(run: Trajectory, first: float, last: float) -> Trajectory:
    """The samples of a trajectory with first <= t <= last, their times as they are."""
    rows = np.searchsorted(run.t, first), np.searchsorted(run.t, last, side="right")
    n_samples = max(int(rows[1] - rows[0]), 0)
    if n_samples < 2:
        raise DataError(
            f"trajectory {run.name!r} has {n_samples} samples between {first:g} and "
            f"{last:g}; expected at least 2. Its times go from {run.t[0]:g} to "
            f"{run.t[-1]:g}; choose others, or other trajectories first: data[name]."
        )
    return part_of(run, slice(*rows))


def _thinned_run(run: Trajectory, n: int, by: str, hold: np.ndarray) -> Trajectory:
    """A trajectory with one sample for every n, and its inputs' (n_inputs,) holds."""
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
