"""Linear algebra along the time, for many states.

Where samples measure every state, states are solved for by their own curvature, and
what is left for the multipliers is positive definite and couples neighbours in time.
Its blocks are factorised by Cholesky: a thirtieth of the work, and a sixth of the
memory, of LU factors of the band (`optimization.banded`), which serve every system.

::

    [H  J'] [x]   [a]
    [J  0 ] [l] = [b]      H diagonal;  J H^-1 J' l = J H^-1 a - b

Nodes between samples, on which nothing was measured, follow from the sample before.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dgetrf, dgetrs, dpotrf
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import reverse_cuthill_mckee

# From this number of states on: below, the band is as fast.
FEWEST_STATES = 32
NEGLIGIBLE = 1e-18  # share of the largest slope of a gap that is only rounding
PANEL = 64  # columns that are worked out together
# Curvature, as a share of the largest, above which a state is measured, and below which
# it is not. What lies between would cost digits.
LEAST_CURVED = 1e-8
MOST_UNCURVED = 1e-11


@dataclass(frozen=True, eq=False)
class ChainLayout:
    """Where the entries of matrices of one pattern stand: H, J and the nodes.

    Attributes:
        order: (n_states,) the states of a node, those that touch near each other. All
            that follows, and all that factors do inside, has them in this order.
        begin: (n_intervals,) first node of each interval, in the order of time; the
            next node is its end.
        n_nodes: number of nodes.
        curved: entries of the diagonal of H among all.
        state: (n_curved,) unknown on which each of them stands.
        sloped: entries of J among all.
        row: (n_sloped,) row of J of each of them.
        column: (n_sloped,) its column.
    """

    order: np.ndarray
    begin: np.ndarray
    n_nodes: int
    curved: np.ndarray
    state: np.ndarray
    sloped: np.ndarray
    row: np.ndarray
    column: np.ndarray

    @classmethod
    def of(
        cls,
        rows: np.ndarray,
        columns: np.ndarray,
        begin: np.ndarray,
        n_nodes: int,
        n_states: int,
    ) -> "ChainLayout | None":
        """Of a pattern; None where it is not of this kind, or too small to gain.

        Args:
            rows: (n_entries,) row of every entry; entries at one place are added.
            columns: (n_entries,) its column.
            begin: (n_intervals,) first node of each interval.
            n_nodes: number of nodes.
            n_states: number of states at a node.
        """
        n_x = n_nodes * n_states
        n_unknowns = n_x + len(begin) * n_states
        is_larger = max(np.max(rows, initial=0), np.max(columns, initial=0))
        in_time = bool(np.all(np.diff(begin) > 0))
        if n_states < FEWEST_STATES or not in_time or is_larger >= n_unknowns:
            return None  # such as one with processes among its unknowns
        of_states = (rows < n_x) & (columns < n_x)
        if np.any(rows[of_states] != columns[of_states]):
            return None
        curved = np.flatnonzero(of_states)
        sloped = np.flatnonzero((rows >= n_x) & (columns < n_x))
        row = rows[sloped] - n_x
        column = columns[sloped]
        first = begin[row // n_states] * n_states
        if np.any((column < first) | (column >= first + 2 * n_states)):
            return None
        order = _neighbours_first(row % n_states, column % n_states, n_states)
        rank = np.argsort(order)
        state = _renamed(rows[curved], rank)
        row, column = _renamed(row, rank), _renamed(column, rank)
        return cls(order, begin, n_nodes, curved, state, sloped, row, column)

    @property
    def n_states(self) -> int:
        """Number of states at a node."""
        return len(self.order)

    def curvature(self, entries: np.ndarray) -> np.ndarray:
        """Diagonal of H at every node, (n_nodes, n_states)."""
        n_x = self.n_nodes * self.n_states
        diagonal = np.bincount(self.state, entries[self.curved], minlength=n_x)
        return diagonal.reshape(self.n_nodes, self.n_states)

    def slopes(self, entries: np.ndarray) -> csr_matrix:
        """J, (n_intervals * n_states, n_nodes * n_states)."""
        shape = (len(self.begin) * self.n_states, self.n_nodes * self.n_states)
        return csr_matrix((entries[self.sloped], (self.row, self.column)), shape=shape)


@dataclass(frozen=True, eq=False)
class _Gap:
    """Intervals from one sample to the next.

    Attributes:
        intervals: their numbers.
        begin: sample at which it begins.
        end: sample at which it ends.
        begins_run: whether no gap ends where it begins.
    """

    intervals: range
    begin: int
    end: int
    begins_run: bool


@dataclass(frozen=True, eq=False)
class _Between:
    """An interval that ends at a node between samples.

    Attributes:
        number: of the interval.
        node: at which it begins; it ends at the next.
        before: J0, slopes in the states at its begin.
        factors: LU factors of J1, slopes in the states at its end.
        pivots: of these factors.
        behind: J0 of the next interval.
    """

    number: int
    node: int
    before: np.ndarray
    factors: np.ndarray
    pivots: np.ndarray
    behind: np.ndarray

    def solved(self, right: np.ndarray, transposed: bool = False) -> np.ndarray:
        """J1^-1 of right-hand sides (n_states, k), or that of its transpose."""
        found: np.ndarray = dgetrs(self.factors, self.pivots, right, transposed)[0]
        return found


class Chained:
    """Cholesky factors of the system of one layout.

    Args:
        layout: of the pattern.
        entries: (n_entries,) in its order.
        curvature: (n_nodes, n_states) diagonal of H.
        is_sample: (n_nodes,) whether a node's states are measured.

    Attributes:
        n: number of unknowns and multipliers.
        log_abs_det: logarithm of the absolute value of the determinant.

    Raises:
        np.linalg.LinAlgError: a multiplier or a node does not follow.
    """

    def __init__(
        self,
        layout: ChainLayout,
        entries: np.ndarray,
        curvature: np.ndarray,
        is_sample: np.ndarray,
    ) -> None:
        self._layout = layout
        self._slopes = layout.slopes(entries)
        self._gaps = _gaps(layout.begin, is_sample)
        self._last = np.array([gap.intervals[-1] for gap in self._gaps], dtype=int)
        self._between: list[_Between] = []
        self._inverse = np.zeros_like(curvature)
        self._inverse[is_sample] = 1 / curvature[is_sample]
        self.n = curvature.size + len(layout.begin) * layout.n_states
        self._factor()
        of_samples = float(np.sum(np.log(curvature[is_sample])))
        self.log_abs_det = of_samples + 2 * self._log_det_of_blocks()

    @classmethod
    def of(cls, layout: ChainLayout, entries: np.ndarray) -> "Chained | None":
        """Of the matrix with these entries; None where samples do not measure all."""
        curvature = layout.curvature(entries)
        is_sample = _samples(layout.begin, curvature)
        if is_sample is None or not np.all(np.isfinite(entries)):
            return None
        try:
            return cls(layout, entries, curvature, is_sample)
        except np.linalg.LinAlgError:
            return None

    def _factor(self) -> None:
        """S = J H^-1 J' of the samples, from block to block: S = L L'.

        A block couples with the one before by few diagonals; what these leave zero is
        not worked out.
        """
        n = self._layout.n_states
        over_gaps = self._over_gaps()
        weighted = over_gaps @ diags(self._inverse.ravel())
        coupled = csr_matrix(weighted @ over_gaps.T)
        self._own = np.empty((len(self._gaps), n, n)).transpose(0, 2, 1)
        self._below = np.zeros((len(self._gaps), n, n))
        for number, gap in enumerate(self._gaps):
            block = _block(coupled, number, number, n)
            if not gap.begins_run:
                above = _block(coupled, number - 1, number, n)
                seen = _seen(self._own[number - 1], above)
                self._below[number] = seen.T
                _take_square(block, seen)
            factor, info = dpotrf(block, lower=True, clean=True, overwrite_a=True)
            if info:
                raise np.linalg.LinAlgError("multipliers do not follow")
            self._own[number] = factor

    def _over_gaps(self) -> csr_matrix:
        """J of every gap in the samples, nodes between them solved for.

        What touches its neighbours in a step hardly touches what is far away in
        several: slopes that are no more than rounding are left out.
        """
        n = self._layout.n_states
        rows = (self._last[:, None] * n + np.arange(n)).ravel()
        own = self._slopes[rows].tocoo()
        of_sample = np.repeat(self._inverse[:, 0] > 0, n)
        kept = of_sample[own.col]  # a fine gap is joined to the sample at its end
        entries = [own.data[kept]]
        places = [(own.row[kept], own.col[kept])]
        for number, gap in enumerate(self._gaps):
            if len(gap.intervals) == 1:
                continue
            before = self._over(gap)
            largest = np.max(np.abs(before), initial=0.0)
            row, column = np.nonzero(np.abs(before) > NEGLIGIBLE * largest)
            entries.append(before[row, column])
            places.append((number * n + row, gap.begin * n + column))
        row, column = np.concatenate(places, axis=1)
        shape = (len(rows), self._inverse.size)
        return csr_matrix((np.concatenate(entries), (row, column)), shape=shape)

    def _over(self, gap: _Gap) -> np.ndarray:
        """Slopes of a whole gap in the sample at its begin, (n_states, n_states)."""
        n = self._layout.n_states
        before = _block(self._slopes, gap.intervals[0], gap.begin, n)
        first = before
        for node, number in enumerate(gap.intervals[:-1], gap.begin):
            after = _block(self._slopes, number, node + 1, n)
            factors, pivots, info = dgetrf(after, overwrite_a=True)
            if info:
                raise np.linalg.LinAlgError("a node does not follow")
            behind = _block(self._slopes, number + 1, node + 1, n)
            between = _Between(number, node, first, factors, pivots, behind)
            self._between.append(between)
            before = -behind @ between.solved(before)
            first = behind
        return before

    def _log_det_of_blocks(self) -> float:
        total = 0.0
        for factor in self._own:
            total += float(np.sum(np.log(np.diag(factor))))
        for between in self._between:
            diagonal = np.diag(between.factors)
            total += float(np.sum(np.log(np.abs(diagonal))))
        return total

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k)."""
        layout = self._layout
        n_x = self._inverse.size
        columns = right.reshape(self.n, -1)
        shape = (-1, layout.n_states, columns.shape[1])
        a = columns[:n_x].reshape(shape)[:, layout.order]
        b = columns[n_x:].reshape(shape)[:, layout.order]
        multipliers = np.zeros_like(b)
        self._fill_multipliers(multipliers, a)
        missed = self._missed(self._states(multipliers, a, b), b)
        multipliers[self._last] = self._solved(missed[self._last])
        self._fill_multipliers(multipliers, a)
        both = np.concatenate([self._states(multipliers, a, b), multipliers])
        found = np.empty_like(both)
        found[:, layout.order] = both
        return found.reshape(right.shape)

    def _fill_multipliers(self, multipliers: np.ndarray, a: np.ndarray) -> None:
        """Those of intervals that end between samples, from those behind them."""
        for between in reversed(self._between):
            number = between.number
            pull = a[between.node + 1] - between.behind.T @ multipliers[number + 1]
            multipliers[number] = between.solved(pull, transposed=True)

    def _states(
        self, multipliers: np.ndarray, a: np.ndarray, b: np.ndarray
    ) -> np.ndarray:
        """States of samples by their curvature, and of nodes from those before."""
        flat = multipliers.reshape(-1, a.shape[2])
        pull = a - (self._slopes.T @ flat).reshape(a.shape)
        states: np.ndarray = self._inverse[:, :, None] * pull
        for between in self._between:
            node = between.node
            offset = b[between.number] - between.before @ states[node]
            states[node + 1] = between.solved(offset)
        return states

    def _missed(self, states: np.ndarray, b: np.ndarray) -> np.ndarray:
        """J x - b, (n_intervals, n_states, k)."""
        shown = self._slopes @ states.reshape(-1, states.shape[2])
        missed: np.ndarray = shown.reshape(b.shape) - b
        return missed

    def _solved(self, right: np.ndarray) -> np.ndarray:
        """S^-1 of right-hand sides (n_gaps, n_states, k), block after block."""
        found = np.empty_like(right)
        for number, gap in enumerate(self._gaps):
            own = right[number]
            if not gap.begins_run:
                own = own - self._below[number] @ found[number - 1]
            found[number] = dtrsm(1.0, self._own[number], own, lower=True)
        for number in reversed(range(len(found))):
            own = found[number]
            is_followed = number + 1 < len(found)
            if is_followed and not self._gaps[number + 1].begins_run:
                own = own - self._below[number + 1].T @ found[number + 1]
            found[number] = dtrsm(1.0, self._own[number], own, lower=True, trans_a=True)
        return found


def _neighbours_first(row: np.ndarray, column: np.ndarray, n_states: int) -> np.ndarray:
    """An order of states in which those that touch are near, (n_states,)."""
    ones = np.ones(len(row))
    touching = csr_matrix((ones, (row, column)), shape=(n_states, n_states))
    return reverse_cuthill_mckee(csr_matrix(touching + touching.T), True)


def _renamed(places: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Places (node or interval, state) with the states in another order."""
    block, state = np.divmod(places, len(rank))
    renamed: np.ndarray = block * len(rank) + rank[state]
    return renamed


def _block(matrix: csr_matrix, row: int, column: int, n: int) -> np.ndarray:
    """Block of n rows and n columns, by its numbers, in Fortran's order."""
    limits = matrix.indptr[row * n : row * n + n + 1]
    own = slice(limits[0], limits[-1])
    rows = np.repeat(np.arange(n), np.diff(limits))
    columns = matrix.indices[own] - column * n
    is_in = (columns >= 0) & (columns < n)
    block = np.zeros((n, n), order="F")
    block[rows[is_in], columns[is_in]] = matrix.data[own][is_in]
    return block


def _seen(factor: np.ndarray, above: np.ndarray) -> np.ndarray:
    """L^-1 of a block, zero above where the block is; in Fortran's order."""
    n = len(above)
    seen = np.zeros_like(above)
    for first in range(0, n, PANEL):
        own = slice(first, first + PANEL)
        top = int(np.argmax(above[:, own].any(axis=1)))
        right = above[top:, own]
        seen[top:, own] = dtrsm(1.0, factor[top:, top:], right, lower=True)
    return seen


def _take_square(block: np.ndarray, seen: np.ndarray) -> None:
    """Lower triangle of B - V'V by columns, without the zeros at the top of V."""
    n = len(block)
    for first in range(0, n, PANEL):
        own = slice(first, first + PANEL)
        top = int(np.argmax(seen[:, own].any(axis=1)))
        block[first:, own] -= seen[top:, first:].T @ seen[top:, own]


def _samples(begin: np.ndarray, curvature: np.ndarray) -> np.ndarray | None:
    """Nodes of which all states are measured, (n_nodes,); of the others none is.

    None where it is not so, or where a trajectory begins or ends between samples.
    """
    largest = np.max(curvature, initial=0.0)
    is_sample = np.all(curvature > LEAST_CURVED * largest, axis=1)
    is_between = np.all(curvature <= MOST_UNCURVED * largest, axis=1)
    has_next = np.zeros(len(curvature), dtype=bool)
    has_next[begin] = True
    has_previous = np.zeros(len(curvature), dtype=bool)
    has_previous[begin + 1] = True
    follows = is_between & has_next & has_previous
    return is_sample if np.all(is_sample | follows) else None


def _gaps(begin: np.ndarray, is_sample: np.ndarray) -> list[_Gap]:
    """From every sample to the next of its trajectory."""
    starts = np.flatnonzero(is_sample[begin])
    limits = [*starts.tolist(), len(begin)]
    gaps: list[_Gap] = []
    for first, limit in pairwise(limits):
        begins_run = not gaps or gaps[-1].end != begin[first]
        end = int(begin[limit - 1]) + 1
        gap = _Gap(range(first, limit), int(begin[first]), end, begins_run)
        gaps.append(gap)
    return gaps
