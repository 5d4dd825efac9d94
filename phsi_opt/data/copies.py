"""Runs that are copies of one another: one measurement, however often given.

Noise differs from run to run, so runs with the same noise were copied, also if each of
them was rounded in another way. Counted twice they would make standard errors smaller,
and held out they would judge what was fitted to them. Names do not matter here, and
neither does the time at which a run begins.

Independent noise of standard deviation s leaves a difference of s sqrt(2) between two
runs. They are copies where it is less than half of that in every channel, and noise is
most of what neighbouring samples scatter in some channel: the scatter of a fast motion
is the same in every repetition of an experiment.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import TypeVar

import numpy as np

from phsi_opt.criteria import MOST_OF_IT
from phsi_opt.data.channel_noise import robust_deviation, scatter_of
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, some_of

AnyMeasurements = TypeVar("AnyMeasurements", bound=Measurements)


def copies_in(data: Measurements) -> dict[str, str]:
    """The run of which each copy is one, by the copy's name; the first is no copy."""
    return _copies(data.trajectories, ())


def counted_once(data: AnyMeasurements, copies: Mapping[str, str]) -> AnyMeasurements:
    """The measurements without copies; themselves where there are none."""
    if not copies:
        return data
    runs = [run for run in data.trajectories if run.name not in copies]
    return replace(data, trajectories=tuple(runs))


def sentence_about(copies: Mapping[str, str]) -> str:
    """What a user should know of copies; "" where there are none."""
    if not copies:
        return ""
    return (
        f"{_told(copies)}: used only once, because runs with the same noise are not "
        "independent measurements; remove the copies, or give the intended runs"
    )


def check_can_judge(
    train: Measurements,
    held_out: Measurements,
    what: str = "held out",
    known: str = "training data",
) -> None:
    """Refuse runs held out, or kept for the end, that are used before."""
    copies = _copies(held_out.trajectories, train.trajectories)
    if copies:
        raise DataError(
            f"{what}: {_told(copies)} of the {known}, so they are not an "
            "independent test; expected runs that are not used for fitting. Remove "
            "them from one of the two."
        )


def _copies(
    runs: Sequence[Trajectory], originals: Sequence[Trajectory]
) -> dict[str, str]:
    """Copies of originals, or of runs before them where there are no originals."""
    groups: dict[tuple[object, ...], list[_Channels]] = {}
    for channels in _with_scatters(originals):
        groups.setdefault(channels.key, []).append(channels)
    copies = {}
    for own in _with_scatters(runs) if len(runs) > 1 or originals else ():
        run = own.run
        alike = groups.setdefault(own.key, [])
        found = next(filter(own.is_copy_of, own.near(alike)), None)
        measured = run.x[np.isfinite(run.x)]
        # At rest, or in a few samples of a coarse sensor, runs are equal by chance.
        if found and len(np.unique(measured)) >= 5:
            copies[run.name] = found.run.name
        elif not originals:
            alike.append(own)
    return copies


def _with_scatters(runs: Sequence[Trajectory]) -> "list[_Channels]":
    """The runs, and how their neighbouring samples scatter."""
    if not runs:
        return []
    numbers = np.repeat(np.arange(len(runs)), [run.n_samples for run in runs])
    t = np.concatenate([run.t for run in runs])
    channels = np.vstack([np.hstack([run.x, run.u]) for run in runs]).T
    scatters = []
    for values in channels:
        number, residuals = scatter_of(t, values, numbers)
        begins = np.searchsorted(number, np.arange(1, len(runs)))
        scatters.append(np.split(residuals, begins))
    of_runs = zip(*scatters, strict=True)
    return list(map(_Channels, runs, of_runs))


@dataclass(frozen=True, eq=False)
class _Channels:
    """The states and inputs of a run."""

    run: Trajectory
    # Of neighbouring samples, residuals for each channel.
    scatters: tuple[np.ndarray, ...]

    @property
    def is_short(self) -> bool:
        """Whether the scatter of neighbouring samples does not tell the noise."""
        return self.run.n_samples < 30

    @property
    def key(self) -> tuple[object, ...]:
        """What copies share, that is which samples there are; of few the first."""
        x = self.run.x
        first = repr((x[0] + 0.0).tolist())  # one kind of NaN and of zero
        what = (x.shape, self.run.u.shape, np.isfinite(x).tobytes())
        return *what, self.is_short and first

    @cached_property
    def values(self) -> np.ndarray:
        """(n_samples, n_channels), zero where not measured."""
        return np.nan_to_num(np.hstack([self.run.x, self.run.u]))

    @cached_property
    def mean(self) -> np.ndarray:
        """(n_channels,)."""
        return np.asarray(self.values.mean(axis=0))

    @cached_property
    def allowed(self) -> np.ndarray:
        """Root mean square difference of a copy, at most, (n_channels,)."""
        if self.is_short:
            return np.zeros(len(self.scatters))
        noise = np.array(list(map(robust_deviation, self.scatters)))
        return np.nan_to_num(noise) / np.sqrt(2)

    @cached_property
    def is_noisy(self) -> bool:
        """Whether noise is most of the scatter of a state."""
        # Residuals of white noise have a correlation of -0.8 with the next ones, those
        # of a motion with four samples in a cycle or more a positive one.
        states = self.scatters[: self.run.x.shape[1]]
        for size, residuals in zip(self.allowed, states, strict=False):
            cut = np.clip(residuals, -4 * size, 4 * size)  # steps are no noise
            if size > 0 and np.sum(cut[1:] * cut[:-1]) < -MOST_OF_IT * np.sum(cut**2):
                return True
        return False

    def near(self, others: Sequence["_Channels"]) -> Iterator["_Channels"]:
        """Those of which it may be a copy, by their means."""
        if not others:
            return iter(())
        means = np.array([one.mean for one in others])
        return compress(
            others, np.all(np.abs(means - self.mean) <= self.allowed, axis=1)
        )

    def is_copy_of(self, other: "_Channels") -> bool:
        """Whether both are one measurement, with the same times since it began."""
        apart = np.sqrt(np.mean((self.values - other.values) ** 2, axis=0))
        is_equal = not apart.any()
        is_near = bool(np.all(apart <= self.allowed))
        is_copy = is_equal or (is_near and self.is_noisy)
        return is_copy and _have_same_times(self.run, other.run)


def _have_same_times(run: Trajectory, other: Trajectory) -> bool:
    apart = np.abs((run.t - run.t[0]) - (other.t - other.t[0]))
    # Times lose some 1e-15 of themselves where a clock is set.
    allowed = 1e-9 * np.ptp(run.t) + 1e-15 * np.abs([run.t, other.t]).max()
    return bool(np.all(apart <= allowed))


def _told(copies: Mapping[str, str]) -> str:
    names: dict[str, list[str]] = {}
    for name, original in copies.items():
        names.setdefault(original, []).append(repr(name))
    told = []
    for original, group in names.items():
        verb = "is a copy" if len(group) == 1 else "are copies"
        told.append(f"{some_of(group)} {verb} of {original!r}")
    return some_of(told)
