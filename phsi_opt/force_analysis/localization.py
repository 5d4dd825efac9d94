"""Where a model fails: trajectory, times, states and frequency of the missing force.

Each is found by the size of the force in parts of the record; a part stands out where
the force is clearly larger there than in the whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import (
    MOST_STRONG_RANGES,
    MOSTLY_CONSTANT,
    OUTSTANDING_FORCE,
    VISITED_BIN,
)
from phsi_opt.force_analysis.cross_validation import place_in_run
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.spectrum import spectrum
from phsi_opt.presentation.durations import RANGE_OF_TIMES
from phsi_opt.presentation.table_making import printed_table

if TYPE_CHECKING:
    import pandas as pd

N_WINDOWS = 10  # parts of a trajectory in which the force's size is taken
N_RANGE_BINS = 8  # parts of the range of a state in which the force's size is taken
# Quantiles of a state between which its range is cut: a few outliers do not widen it.
RANGE_QUANTILES = (0.01, 0.99)
EVERYWHERE = "everywhere"  # the region where none stands out
THROUGHOUT = (
    " (throughout)"  # behind the times of a force that no window has for itself
)


def window_of(times: str) -> tuple[float, float] | None:
    """Begin and end of a window in words; None where it is the whole record."""
    found = RANGE_OF_TIMES.search(times)
    if found is None or THROUGHOUT in times:
        return None
    return float(found[1]), float(found[2])


def located(force: ForceRecord) -> "pd.DataFrame":
    """Where the missing force of every equation is strong, strongest first.

    Returns:
        A row per equation that may lack a force: equation; trajectory (its name) and
        time_window where it is strongest; state_region where it is strong; frequency
        (cycles per unit of time; 0 for a force that is mostly constant); strength
        (rms); times_noise (strength over the typical standard deviation of the
        estimate: below 1 it is not sure).
    """
    certainty = force.estimate.posterior.times_noise
    rows = []
    for number, equation in enumerate(force.equations):
        w = force.w[:, number]
        window = _strongest_window(force, w)
        row = {
            "equation": equation,
            "trajectory": force.trajectories[window.run],
            "time_window": window.times,
            "state_region": strong_region(force, w, _own_states(force)),
            "frequency": _frequency(force, w),
            "strength": _rms(w),
            "times_noise": certainty[number],
        }
        rows.append(row)
    table = printed_table(rows)
    return table.sort_values("strength", ascending=False, ignore_index=True)


def _own_states(force: ForceRecord) -> list[str]:
    """The states that are no memory of an effect."""
    model = force.fit.model
    return [name for name in model.states if name not in model.memory]


def _rms(w: np.ndarray) -> float:
    return float(np.sqrt(np.mean(w**2)))


def _rms_in_parts(w: np.ndarray, part: np.ndarray, n_parts: int) -> np.ndarray:
    """Root mean square of w in every part, (n_parts,); 0 for an empty one."""
    count = np.bincount(part, minlength=n_parts)
    squares = np.bincount(part, w**2, n_parts)
    return np.sqrt(squares / np.maximum(count, 1))


@dataclass(frozen=True)
class _Window:
    """Number of a trajectory, and times along it in words."""

    run: int
    times: str


def _strongest_window(force: ForceRecord, w: np.ndarray) -> _Window:
    """The tenth of a trajectory where the force is strongest.

    The whole trajectory where that tenth does not stand out.
    """
    count = np.bincount(force.run)
    tenth = place_in_run(force.run) * N_WINDOWS // count[force.run]
    part = force.run * N_WINDOWS + tenth
    size = _rms_in_parts(w, part, len(count) * N_WINDOWS)
    strongest = int(np.argmax(size))
    run = strongest // N_WINDOWS
    if size[strongest] > OUTSTANDING_FORCE * _rms(w):
        return _Window(run, _times(force, np.flatnonzero(part == strongest)))
    whole = _times(force, np.flatnonzero(force.run == run))
    return _Window(run, whole + THROUGHOUT)


def _times(force: ForceRecord, inside: np.ndarray) -> str:
    """From the begin of the first interval to the end of the last: '4 to 5'."""
    first = inside[0]
    last = inside[-1]
    begin = force.t[first] - force.h[first] / 2
    end = force.t[last] + force.h[last] / 2
    return f"{begin:.3g} to {end:.3g}"


def strong_region(force: ForceRecord, w: np.ndarray, names: Sequence[str]) -> str:
    """Ranges of the variables in which a force is strong, in words.

    Args:
        force: the record, for the variables.
        w: the force, (n_intervals,).
        names: of the variables.

    Returns:
        Such as 'q -1 to -0.6 or 0.7 to 1, p 2 to 3'; 'everywhere' where no range
        stands out.
    """
    regions = []
    for name in names:
        ranges = strong_ranges(force.variable(name), w)
        if ranges:
            regions.append(f"{name} {' or '.join(map(str, ranges))}")
    return ", ".join(regions) or EVERYWHERE


@dataclass(frozen=True)
class StrongRange:
    """Values of a variable between which a force is strong.

    Attributes:
        begin: of the range; ``end``: of it.
        is_lowest: whether no smaller values were visited (but a few).
        is_highest: whether no larger ones were.
    """

    begin: float
    end: float
    is_lowest: bool
    is_highest: bool

    def __str__(self) -> str:
        return f"{self.begin:.3g} to {self.end:.3g}"


def strong_ranges(z: np.ndarray, w: np.ndarray) -> list[StrongRange]:
    """Ranges of a variable in which a force is strong; none where none stands out.

    Args:
        z: the variable, (n_intervals,).
        w: the force, (n_intervals,).
    """
    low, high = np.quantile(z, RANGE_QUANTILES)
    edges = np.unique(np.linspace(low, high, N_RANGE_BINS + 1))
    n_bins = len(edges) - 1
    if n_bins < 1:
        return []
    below = np.searchsorted(edges, z) - 1
    part = np.clip(below, 0, n_bins - 1)
    is_visited = np.bincount(part, minlength=n_bins) > VISITED_BIN * len(w)
    is_large = _rms_in_parts(w, part, n_bins) > OUTSTANDING_FORCE * _rms(w)
    is_strong = is_visited & is_large
    if is_strong.all():
        return []
    ranges = _joined(edges, is_strong)
    return ranges if len(ranges) <= MOST_STRONG_RANGES else []


def _joined(edges: np.ndarray, is_strong: np.ndarray) -> list[StrongRange]:
    """Ranges of neighbouring strong bins.

    Args:
        edges: of the bins, (n_bins + 1,).
        is_strong: (n_bins,) of bool.
    """
    change = np.diff(np.r_[False, is_strong, False].astype(int))
    begins = np.flatnonzero(change == 1)
    ends = np.flatnonzero(change == -1)
    ranges = []
    for begin, end in zip(begins, ends, strict=True):
        is_highest = end == len(is_strong)
        ranges.append(
            StrongRange(edges[begin], edges[end], bool(begin == 0), bool(is_highest))
        )
    return ranges


def is_mostly_constant(w: np.ndarray) -> bool:
    """Whether most of the mean square of a force (n_intervals,) is that of its mean."""
    mean_square = np.mean(w**2)
    return bool(np.mean(w) ** 2 > MOSTLY_CONSTANT * mean_square)


def _frequency(force: ForceRecord, w: np.ndarray) -> float:
    """Frequency at which the force is strongest, in cycles per unit of time.

    It is 0 where most of the force is constant.
    """
    if is_mostly_constant(w):
        return 0.0
    return spectrum(force.t, force.run, w - np.mean(w)).peak
