"""Records cut into two disjoint halves, in three ways.

No sample is in both halves. Windows are consecutive pieces of a record, each of which
starts at a state of its own; they are numbered through all trajectories.
"""

from dataclasses import dataclass, replace

import numpy as np

import phsi_opt as ph

FIRST_AND_SECOND = "first and second"
ALTERNATING = "alternating"
DEALT = "dealt"
CUTS = (FIRST_AND_SECOND, ALTERNATING, DEALT)
SEED = 1  # of the dealing


@dataclass(frozen=True, eq=False)
class Halves:
    """Two sets of measurements without a common sample."""

    first: ph.Measurements
    second: ph.Measurements


def halved(
    data: ph.Measurements,
    size: int | None,
    cut: str,
    is_windowed: bool = False,
    seed: int = SEED,
) -> Halves:
    """The halves by one of the `CUTS`.

    Args:
        data: One or several trajectories.
        size: Samples of a window; None: each trajectory is one window.
        cut: One of `CUTS`.
        is_windowed: Whether first and second half are cut into windows too.
        seed: By which windows are dealt.
    """
    if cut == FIRST_AND_SECOND:
        halves = first_and_second(data, by_trajectory=size is None)
        if not is_windowed or size is None:
            return halves
        return Halves(windows(halves.first, size), windows(halves.second, size))
    pieces = data if size is None else windows(data, size)
    in_order = np.arange(len(pieces))
    if cut == DEALT:
        in_order = np.random.default_rng(seed).permutation(len(pieces))
    return Halves(_chosen(pieces, in_order[::2]), _chosen(pieces, in_order[1::2]))


def first_and_second(data: ph.Measurements, by_trajectory: bool = False) -> Halves:
    """The first half of every trajectory, and the second; or of the trajectories."""
    if by_trajectory:
        return Halves(*data.split(0.5))
    early: list[ph.Trajectory] = []
    late: list[ph.Trajectory] = []
    for i in range(len(data)):
        first, second = data[i].split(0.5)
        early += first.trajectories
        late += second.trajectories
    return Halves(
        replace(data, trajectories=tuple(early)),
        replace(data, trajectories=tuple(late)),
    )


def windows(data: ph.Measurements, size: int) -> ph.Measurements:
    """Pieces of ``size`` samples without a common one, each a trajectory.

    What is left at the end of a trajectory is left out where it is shorter than half of
    a window.
    """
    pieces = []
    for run in data.trajectories:
        for begin in range(0, run.n_samples - size // 2 + 1, size):
            rows = slice(begin, begin + size)
            piece = replace(
                run,
                name=f"{run.name}, window {begin // size + 1}",
                t=run.t[rows],
                x=run.x[rows],
                u=run.u[rows],
            )
            pieces.append(piece)
    return replace(data, trajectories=tuple(pieces))


def _chosen(pieces: ph.Measurements, numbers: np.ndarray) -> ph.Measurements:
    """The pieces of these numbers, in the order of the record."""
    chosen = tuple(pieces.trajectories[i] for i in sorted(numbers))
    return replace(pieces, trajectories=chosen)
