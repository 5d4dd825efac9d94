"""Where a model fails: trajectory, times and states of the missing force.

Each is found by the size of the force in parts of the record; a part stands out where
the force is clearly larger there than in the whole.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import find_objects, label

from phsi_opt.force_analysis.cross_validation import OUTER_QUANTILES, part_of_run
from phsi_opt.force_analysis.force_record import Force
from phsi_opt.statistics import rms

# Factor on the size of a force in the whole record from which a part stands out.
OUTSTANDING_FORCE = 1.3
# Share of the record in a bin of a state above which the bin was visited.
VISITED_BIN = 0.02
# Ranges of one state in which a force is strong, at most: one, or both ends; strong in
# more of them it follows no region of that state.
MOST_STRONG_RANGES = 2

N_WINDOWS = 10  # parts of a trajectory in which the force's size is taken


@dataclass(frozen=True)
class Window:
    """Where along a trajectory a force is strongest.

    Attributes:
        trajectory: its name.
        begin: of the times; ``end``: of them.
        is_whole: whether these are all of it, because none stand out.
    """

    trajectory: str
    begin: float
    end: float
    is_whole: bool

    def __str__(self) -> str:
        throughout = " (throughout)" if self.is_whole else ""
        return f"{self.begin:.3g} to {self.end:.3g}{throughout}"


def strongest_window(force: Force) -> Window:
    """The tenth of a trajectory where a force is strongest, or else all of that."""
    record = force.record
    part = record.run * N_WINDOWS + part_of_run(record.run, N_WINDOWS)
    size = _rms_in_parts(force.w, part, int(part.max()) + 1)
    strongest = int(np.argmax(size))
    run = strongest // N_WINDOWS
    is_whole = bool(size[strongest] <= OUTSTANDING_FORCE * rms(force.w))
    inside = np.flatnonzero(record.run == run if is_whole else part == strongest)
    begin = record.t[inside[0]] - record.h[inside[0]] / 2
    end = record.t[inside[-1]] + record.h[inside[-1]] / 2
    return Window(record.trajectories[run], float(begin), float(end), is_whole)


def _rms_in_parts(w: np.ndarray, part: np.ndarray, n_parts: int) -> np.ndarray:
    """Root mean square of w in every part, (n_parts,); 0 for an empty one."""
    count = np.bincount(part, minlength=n_parts)
    squares = np.bincount(part, w**2, n_parts)
    return np.sqrt(squares / np.maximum(count, 1))


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

    Both are (n_intervals,).
    """
    low, high = np.quantile(z, OUTER_QUANTILES)
    edges = np.unique(np.linspace(low, high, num=9))
    n_bins = len(edges) - 1
    if n_bins < 1:
        return []
    part = np.clip(np.searchsorted(edges, z) - 1, 0, n_bins - 1)
    is_visited = np.bincount(part, minlength=n_bins) > VISITED_BIN * len(w)
    is_large = _rms_in_parts(w, part, n_bins) > OUTSTANDING_FORCE * rms(w)
    is_strong = is_visited & is_large
    # Neighbouring strong bins are one range.
    found = find_objects(label(is_strong)[0])
    if is_strong.all() or len(found) > MOST_STRONG_RANGES:
        return []
    ranges = []
    for (bins,) in found:
        bounds = (float(edges[bins.start]), float(edges[bins.stop]))
        ranges.append(StrongRange(*bounds, bins.start == 0, bins.stop == n_bins))
    return ranges


# Ranges of the variables, by name, in which a force is strong.
Region = Mapping[str, Sequence[StrongRange]]


def strong_region(force: Force, names: Sequence[str]) -> Region:
    """Ranges of variables in which a force is strong; of those where any stands out.

    The states of an effect's memory are left out.
    """
    region = {}
    for name in names:
        if name not in force.record.model.memory:
            ranges = strong_ranges(force.record.variable(name), force.w)
            if ranges:
                region[name] = ranges
    return region


def region_words(region: Region) -> str:
    """A region in a table: 'q -1 to -0.6 or 0.7 to 1, p 2 to 3'."""
    told = []
    for name, ranges in region.items():
        told.append(f"{name} {' or '.join(map(str, ranges))}")
    return ", ".join(told)
