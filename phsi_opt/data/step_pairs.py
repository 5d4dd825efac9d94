"""Integration steps as measurements: pairs of samples that join to trajectories.

Some sources hand over steps, each with its own start and end, instead of records; this
module checks the steps and finds those that continue each other.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.checks import (
    check_same_length,
    check_values,
    from_first,
    read_only_floats,
    with_channel_axis,
)
from phsi_opt.errors import DataError


@dataclass(frozen=True, eq=False)
class PairEnds:
    """One quantity at both ends of every pair, in two arrays of the same shape.

    Attributes:
        start: (n_pairs,) for times, else (n_pairs, n_channels).
        end: The same at the ends of the pairs.
    """

    start: np.ndarray
    end: np.ndarray

    def meet(self) -> np.ndarray:
        """Whether each pair but the first starts where the pair before it ended.

        Two values that were not measured are the same.

        Returns:
            (n_pairs - 1,) of bool, for quantities (n_pairs, n_channels).
        """
        next_start = self.start[1:]
        last_end = self.end[:-1]
        neither_is_measured = np.isnan(next_start) & np.isnan(last_end)
        is_same = (next_start == last_end) | neither_is_measured
        every_channel: np.ndarray = is_same.all(axis=1)
        return every_channel

    def joined(self, runs: list[np.ndarray]) -> list[np.ndarray]:
        """The samples of each trajectory: the starts of its pairs, and the last end.

        Args:
            runs: The numbers of the pairs that make each trajectory.
        """
        trajectories = []
        for rows in runs:
            last_end = self.end[rows[-1:]]
            trajectories.append(np.concatenate([self.start[rows], last_end]))
        return trajectories


def pair_ends(start: Any, end: Any, label: str, n_axes: int) -> PairEnds:
    """Both ends of the pairs, as read-only float64 copies.

    Args:
        start: (n_pairs,), or (n_pairs, n_channels) where ``n_axes`` is 2; then a single
            channel may be (n_pairs,).
        end: The same shape.
        label: "t", "x" or "u"; messages call the arrays t_start and t_end.
        n_axes: The number of axes, 1 or 2.

    Raises:
        DataError: An array cannot be used, or the shapes differ.
    """
    if label == "t":
        begin = np.asarray(start).flat[0] if np.size(start) else None
        start, end = from_first(start, begin), from_first(end, begin)
    first = _end_array(start, f"{label}_start", n_axes)
    last = _end_array(end, f"{label}_end", n_axes)
    if first.shape != last.shape:
        raise DataError(
            f"{label}_start has the shape {first.shape} and {label}_end {last.shape}; "
            "expected the same shape."
        )
    return PairEnds(first, last)


def _end_array(values: Any, title: str, n_axes: int) -> np.ndarray:
    if n_axes == 2:
        values = with_channel_axis(values)
    return read_only_floats(values, n_axes, title)


def input_ends(start: Any, end: Any, n_pairs: int, hold: str) -> PairEnds:
    """The inputs at both ends of the pairs; no columns where there are no inputs.

    With hold="zero" the end may be None: the input keeps its value until there.

    Raises:
        DataError: One end is missing, or `pair_ends` refuses the arrays.
    """
    if start is None and end is None:
        nothing = np.empty((n_pairs, 0))
        return PairEnds(nothing, nothing)
    if start is None or (end is None and hold != "zero"):
        raise DataError(
            "only one of u_start and u_end is given; expected both. "
            "If u keeps its value: hold='zero'."
        )
    if end is None:
        end = start
    return pair_ends(start, end, "u", n_axes=2)


def check_pairs(t: PairEnds, x: PairEnds, u: PairEnds) -> None:
    """Check that the pairs' times, states and inputs belong together.

    Raises:
        DataError: There are no pairs, the numbers of rows differ, or a pair does not go
            forward in time.
    """
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


def runs_of_pairs(t: PairEnds, x: PairEnds, u: PairEnds, hold: str) -> list[np.ndarray]:
    """The numbers of the pairs that make each trajectory, (n_own,), in the order given.

    A pair continues the pair before it if it starts at the same time, state and input.
    With hold="zero" the input at the end of a pair acts on nothing and is not compared.
    """
    meets_in_time = t.start[1:] == t.end[:-1]
    continues = meets_in_time & x.meet()
    if hold != "zero":
        continues &= u.meet()
    n_pairs = len(t.start)
    first_rows = np.flatnonzero(~continues) + 1
    return np.split(np.arange(n_pairs), first_rows)
