"""Runs that are exact copies of one another: one measurement, however often given.

Noise differs from run to run, so equal runs were copied. Counted twice they would make
standard errors smaller, and held out they would judge what was fitted to them. Names do
not matter here, and neither does the time at which a run begins.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

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
        f"{_told(copies)}: used only once, because equal runs are not independent "
        "measurements; remove the copies, or give the intended runs"
    )


def check_can_judge(
    train: Measurements,
    held_out: Measurements,
    what: str = "held out",
    known: str = "training data",
) -> None:
    """Refuse runs held out, or kept for the end, that are used before.

    Raises:
        DataError: there are such runs.
    """
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
    seen: dict[tuple[object, ...], list[Trajectory]] = {}
    for run in originals:
        seen.setdefault(_key(run), []).append(run)
    copies = {}
    for run in runs:
        alike = seen.setdefault(_key(run), [])
        found = [other for other in alike if _is_equal(run, other)]
        measured = run.x[np.isfinite(run.x)]
        # At rest, or in a few samples of a coarse sensor, runs are equal by chance.
        if found and len(np.unique(measured)) >= 5:
            copies[run.name] = found[0].name
        elif not originals:
            alike.append(run)
    return copies


def _key(run: Trajectory) -> tuple[object, ...]:
    """What tells most runs apart: their shapes and first states."""
    first = repr((run.x[0] + 0.0).tolist())  # one kind of NaN and of zero
    return run.x.shape, run.u.shape, first


def _is_equal(run: Trajectory, other: Trajectory) -> bool:
    """Whether states and inputs are the same, and the times since both began."""
    apart = np.abs((run.t - run.t[0]) - (other.t - other.t[0]))
    # Times lose some 1e-15 of themselves where a clock is set.
    allowed = 1e-9 * np.ptp(run.t) + 1e-15 * np.abs([run.t, other.t]).max()
    return (
        np.array_equal(run.x, other.x, equal_nan=True)
        and np.array_equal(run.u, other.u)
        and bool(np.all(apart <= allowed))
    )


def _told(copies: Mapping[str, str]) -> str:
    """Which runs are copies of which, with the first few names."""
    names: dict[str, list[str]] = {}
    for name, original in copies.items():
        names.setdefault(original, []).append(repr(name))
    told = []
    for original, group in names.items():
        verb = "is an exact copy" if len(group) == 1 else "are exact copies"
        told.append(f"{some_of(group)} {verb} of {original!r}")
    return some_of(told)
