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
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dgetrf, dgetrs, dpotrf
from scipy.sparse import csr_matrix

# From this number of states on: below, the band is as fast.
FEWEST_STATES = 16
# Curvature, as a share of the largest, above which a state is measured, and below which
# it is not. What lies between would cost digits.
LEAST_CURVED = 1e-8
MOST_UNCURVED = 1e-11


@dataclass(frozen=True, eq=False)
class ChainLayout:
    """Where the entries of matrices of one pattern stand: H, J and the nodes.

    Attributes:
        begin: (n_intervals,) first node of each interval, in the order of time; the
            next node is its end.
        n_nodes: number of nodes.
        n_states: number of states at a node.
        curved: entries of the diagonal of H among all.
        state: (n_curved,) unknown on which each of them stands.
        sloped: entries of J among all.
        row: (n_sloped,) row of J of each of them.
        column: (n_sloped,) its column.
    """

    begin: np.ndarray
    n_nodes: int
    n_states: int
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
        state = rows[curved]
        return cls(begin, n_nodes, n_states, curved, state, sloped, row, column)

    @cached_property
    def _in_order(self) -> np.ndarray:
        """Entries of J, one interval after the other."""
        return np.argsort(self.row // self.n_states, kind="stable")

    @cached_property
    def _limits(self) -> np.ndarray:
        """Where each interval's entries begin among them, (n_intervals + 1,)."""
        lengths = np.bincount(self.row // self.n_states, minlength=len(self.begin))
        return np.concatenate([[0], np.cumsum(lengths)])

    @cached_property
    def _places(self) -> np.ndarray:
        """Place of each of them in J0 and J1 of its interval, column by column."""
        interval, row = np.divmod(self.row[self._in_order], self.n_states)
        first = self.begin[interval] * self.n_states
        column = self.column[self._in_order] - first
        return column * self.n_states + row

    def curvature(self, entries: np.ndarray) -> np.ndarray:
        """Diagonal of H at every node, (n_nodes, n_states)."""
        n_x = self.n_nodes * self.n_states
        diagonal = np.bincount(self.state, entries[self.curved], minlength=n_x)
        return diagonal.reshape(self.n_nodes, self.n_states)

    def slopes(self, entries: np.ndarray) -> csr_matrix:
        """J, (n_intervals * n_states, n_nodes * n_states)."""
        shape = (len(self.begin) * self.n_states, self.n_nodes * self.n_states)
        return csr_matrix((entries[self.sloped], (self.row, self.column)), shape=shape)

    def blocks(
        self, entries: np.ndarray, interval: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """J in the states at begin and end of an interval, in Fortran's order."""
        own = slice(self._limits[interval], self._limits[interval + 1])
        n = self.n_states
        values = entries[self.sloped[self._in_order[own]]]
        both = np.bincount(self._places[own], values, minlength=2 * n * n)
        before, after = both.reshape(2, n, n)
        return before.T, after.T


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
        self._factor(entries)
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

    def _factor(self, entries: np.ndarray) -> None:
        """S = J H^-1 J' of the samples, from block to block: S = L L'."""
        n = self._layout.n_states
        self._own = np.empty((len(self._gaps), n, n)).transpose(0, 2, 1)
        self._below = np.zeros((len(self._gaps), n, n)).transpose(0, 2, 1)
        root = np.sqrt(self._inverse)
        seen = np.empty((n, n))
        for number, gap in enumerate(self._gaps):
            before, after = self._over(entries, gap)
            in_begin = before * root[gap.begin]
            in_end = after * root[gap.end]
            block = in_begin @ in_begin.T + in_end @ in_end.T
            if not gap.begins_run:
                below = in_begin @ seen.T
                block -= below @ below.T
                self._below[number] = below
            factor, info = dpotrf(block.T, lower=True, clean=True, overwrite_a=True)
            if info:
                raise np.linalg.LinAlgError("multipliers do not follow")
            self._own[number] = factor
            in_end = np.asfortranarray(in_end)
            seen = dtrsm(1.0, factor, in_end, lower=True, overwrite_b=True)

    def _over(self, entries: np.ndarray, gap: _Gap) -> tuple[np.ndarray, np.ndarray]:
        """Slopes of a whole gap in the samples at its begin and end."""
        before, after = self._layout.blocks(entries, gap.intervals[0])
        first = before
        for node, number in enumerate(gap.intervals[:-1], gap.begin):
            factors, pivots, info = dgetrf(after)
            if info:
                raise np.linalg.LinAlgError("a node does not follow")
            behind, after = self._layout.blocks(entries, number + 1)
            between = _Between(number, node, first, factors, pivots, behind)
            self._between.append(between)
            before = -behind @ between.solved(before)
            first = behind
        return before, after

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
        a = columns[:n_x].reshape(shape)
        b = columns[n_x:].reshape(shape)
        multipliers = np.zeros_like(b)
        self._fill_multipliers(multipliers, a)
        missed = self._missed(self._states(multipliers, a, b), b)
        multipliers[self._last] = self._solved(missed[self._last])
        self._fill_multipliers(multipliers, a)
        states = self._states(multipliers, a, b)
        found = np.concatenate([states.ravel(), multipliers.ravel()])
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
