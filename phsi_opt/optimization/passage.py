"""Linear dynamics over gaps between samples, the nodes inside solved for.

Every gap leads from one sample to the next. Its last interval ends at a sample; the
others end at nodes inside, which follow from the sample at its begin. Sorted by what
touches what, the slopes inside are a narrow band, whatever the number of states.

::

    inside x_inside + first x_samples = right of the intervals that end inside
    onward x_inside + last  x_samples = right of the last intervals
"""

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from phsi_opt.optimization.banded import Banded, BandLayout

NEGLIGIBLE = 1e-18  # share of the largest slope that is only rounding
# What touches its neighbours in a step hardly touches what is far away in several:
# states that are so many places apart share a column at first.
APART = 40
PANEL = 8  # columns that are solved for together


class Passage:
    """The dynamics of all gaps.

    Args:
        slopes: J, (n_intervals * n_states, n_nodes * n_states).
        begin: (n_intervals,) first node of each interval, in the order of time; the
            next node is its end.
        is_sample: (n_nodes,); the first and last nodes of every trajectory are samples.
        rank: (n_states,) place of each state where those that touch are neighbours.

    Attributes:
        of_inside: rows of J that end inside gaps.
        of_last: rows of J that end at samples.
        inside: columns of J of the nodes inside.
        samples: columns of J of samples.
        first: slopes inside gaps in the states of samples.
        onward: slopes of last intervals in the states inside.
        last: slopes of last intervals in the states of samples.

    Raises:
        SolveError: a node inside does not follow.
    """

    def __init__(
        self,
        slopes: csr_matrix,
        begin: np.ndarray,
        is_sample: np.ndarray,
        rank: np.ndarray,
    ) -> None:
        self._rank = rank
        is_last = is_sample[begin + 1]
        self._gap = np.cumsum(is_last) - is_last
        sample = np.cumsum(is_sample) - 1
        self._sample = sample[begin[is_sample[begin]]]
        self.of_inside = self._places(~is_last)
        self.of_last = self._places(is_last)
        self.inside = self._places(~is_sample)
        self.samples = self._places(is_sample)
        behind = slopes[self.of_last]
        self.onward = behind[:, self.inside]
        self.last = behind[:, self.samples]
        before = slopes[self.of_inside]
        self.first = before[:, self.samples]
        self._reach = self._farthest(self.onward)
        self._factors: Banded | None = None
        if len(self.inside):
            self._factors = self._factored(before[:, self.inside].tocoo(), ~is_last)

    def _places(self, chosen: np.ndarray) -> np.ndarray:
        """Of the states of chosen nodes, or intervals, among all."""
        n = len(self._rank)
        places: np.ndarray = (
            np.flatnonzero(chosen)[:, None] * n + np.arange(n)
        ).ravel()
        return places

    def _farthest(self, slopes: csr_matrix) -> int:
        """Places between states that touch, at most."""
        entries = slopes.tocoo()
        n = len(self._rank)
        places = self._rank[entries.row % n] - self._rank[entries.col % n]
        return int(np.max(np.abs(places), initial=0))

    def _factored(self, slopes: coo_matrix, is_inside: np.ndarray) -> Banded:
        """Of the slopes inside, in the order that makes the narrower band."""
        gap = np.repeat(self._gap[is_inside], len(self._rank))
        rank = np.tile(self._rank, len(gap) // len(self._rank))
        number = np.arange(len(gap)) // len(self._rank)
        layouts = []
        for order in (np.lexsort((number, rank, gap)), np.lexsort((rank, number))):
            layouts.append(BandLayout(slopes.row, slopes.col, order))
        narrower = min(layouts, key=lambda layout: layout.kl + layout.ku)
        return Banded(narrower, slopes.data)

    @property
    def log_abs_det(self) -> float:
        """Of the slopes inside."""
        return self._factors.log_abs_det if self._factors else 0.0

    def followed(self, right: np.ndarray) -> np.ndarray:
        """States inside for right-hand sides (n_inside, k) of their intervals."""
        return self._factors.solve(right) if self._factors else right

    def pulled(self, right: np.ndarray) -> np.ndarray:
        """Multipliers of the intervals that end inside, for pulls on states there."""
        return (
            self._factors.solve(right, is_transposed=True) if self._factors else right
        )

    def over(self, right: np.ndarray) -> np.ndarray:
        """Right-hand sides (n_intervals * n_states, k) of whole gaps."""
        followed = self.followed(right[self.of_inside])
        over: np.ndarray = right[self.of_last] - self.onward @ followed
        return over

    def slopes(self) -> csr_matrix:
        """Of whole gaps in the states of samples."""
        return self.last + self._carried(self.first, self._sample)

    def over_blocks(self, blocks: csr_matrix) -> csr_matrix:
        """Of whole gaps, for right-hand sides in one block of columns per gap."""
        carried = self._carried(blocks[self.of_inside], np.arange(len(self._sample)))
        return blocks[self.of_last] + carried

    def _carried(self, blocks: csr_matrix, place: np.ndarray) -> csr_matrix:
        """What intervals inside add to whole gaps, but for what is only rounding.

        Args:
            blocks: (n_inside, n_columns) in one block of columns per gap.
            place: (n_gaps,) number of that block.
        """
        n = len(self._rank)
        apart = min(APART, n)
        carried = self._carried_by(apart, blocks, place)
        while carried is None:
            apart = min(2 * apart, n)
            carried = self._carried_by(apart, blocks, place)
        return carried

    def _carried_by(
        self, apart: int, blocks: csr_matrix, place: np.ndarray
    ) -> csr_matrix | None:
        """The same; None where states ``apart`` from each other are still felt."""
        n = len(self._rank)
        entries = blocks.tocoo()
        largest = NEGLIGIBLE * np.max(np.abs(entries.data), initial=0.0)
        column = self._rank[entries.col % n] % apart
        found: list[tuple[np.ndarray, ...]] = []
        for first in range(0, apart, PANEL):
            own = (column >= first) & (column < first + PANEL)
            width = min(PANEL, apart - first)
            right = coo_matrix(
                (entries.data[own], (entries.row[own], column[own] - first)),
                shape=(blocks.shape[0], width),
            ).toarray(order="F")
            felt = -(self.onward @ self.followed(right))
            row, number = np.nonzero(np.abs(felt) > largest)
            distance = number + first - self._rank[row % n]
            if apart < n:
                distance = (distance + apart // 2) % apart - apart // 2
            rank = self._rank[row % n] + distance
            is_far = np.abs(distance) >= apart // 2 - self._reach
            if apart < n and np.any(is_far | (rank < 0) | (rank >= n)):
                return None
            found.append((felt[row, number], row, rank))
        value, row, rank = (np.concatenate(part) for part in zip(*found, strict=True))
        state = np.argsort(self._rank)[rank]
        places = (row, place[row // n] * n + state)
        shape = (len(place) * n, blocks.shape[1])
        return coo_matrix((value, places), shape=shape).tocsr()


def neighbours_first(row: np.ndarray, column: np.ndarray, n_states: int) -> np.ndarray:
    """An order of states in which those that touch are near, (n_states,)."""
    touching = np.zeros((n_states, n_states), dtype=bool)
    touching[row, column] = True
    return reverse_cuthill_mckee(csr_matrix(touching | touching.T), True)
