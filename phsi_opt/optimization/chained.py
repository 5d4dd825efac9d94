"""Linear algebra along the time, by what patterns and sizes allow.

Where samples measure every state, states are solved for by their own curvature, and
what is left for the multipliers is positive definite and couples neighbours in time: a
band whose Cholesky factors take a small part of the work, and a fifth of the memory, of
LU factors of the whole (`optimization.banded`), which serve every system.

::

    [H  J'] [x]   [a]
    [J  0 ] [l] = [b]      H diagonal;  J H^-1 J' l = J H^-1 a - b

Nodes between samples, on which nothing was measured, follow from the sample before
(`optimization.passage`).
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse import csr_matrix, diags

from phsi_opt.errors import SolveError
from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.optimization.passage import Passage, neighbours_first

# From this number of states on: below, the band is as fast.
FEWEST_STATES = 14


@dataclass(frozen=True, eq=False)
class Chain:
    """Nodes along the time, and intervals that join neighbours.

    Attributes:
        begin: (n_intervals,) first node of each interval; the next node is its end.
        n_nodes: number of nodes.
        n_states: number of states at a node.
    """

    begin: np.ndarray
    n_nodes: int
    n_states: int


@dataclass(frozen=True, eq=False)
class ChainLayout:
    """Where the entries of matrices of one pattern stand: H, J and the nodes.

    Attributes:
        order: (n_states,) the states of a node, those that touch near each other. All
            that follows, and all that factors do inside, has them in this order.
        chain: nodes and intervals, in the order of time.
        curved: entries of the diagonal of H among all.
        state: (n_curved,) unknown on which each of them stands.
        sloped: entries of J among all.
        row: (n_sloped,) row of J of each of them.
        column: (n_sloped,) its column.
    """

    order: np.ndarray
    chain: Chain
    curved: np.ndarray
    state: np.ndarray
    sloped: np.ndarray
    row: np.ndarray
    column: np.ndarray

    @classmethod
    def of(
        cls, rows: np.ndarray, columns: np.ndarray, chain: Chain
    ) -> "ChainLayout | None":
        """Of a pattern; None where it is not of this kind, or too small to gain.

        Args:
            rows: (n_entries,) row of every entry; entries at one place are added.
            columns: (n_entries,) its column.
            chain: nodes and intervals.
        """
        begin, n_states = chain.begin, chain.n_states
        n_x = chain.n_nodes * n_states
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
        order = neighbours_first(row % n_states, column % n_states, n_states)
        rank = np.argsort(order)
        state = _renamed(rows[curved], rank)
        row, column = _renamed(row, rank), _renamed(column, rank)
        return cls(order, chain, curved, state, sloped, row, column)

    def curvature(self, entries: np.ndarray) -> np.ndarray:
        """Diagonal of H at every node, (n_nodes, n_states)."""
        shape = (self.chain.n_nodes, self.chain.n_states)
        n_x = shape[0] * shape[1]
        diagonal = np.bincount(self.state, entries[self.curved], minlength=n_x)
        return diagonal.reshape(shape)

    def slopes(self, entries: np.ndarray) -> csr_matrix:
        """J, (n_intervals * n_states, n_nodes * n_states)."""
        n = self.chain.n_states
        shape = (len(self.chain.begin) * n, self.chain.n_nodes * n)
        return csr_matrix((entries[self.sloped], (self.row, self.column)), shape=shape)


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
        SolveError: a node between samples does not follow.
        np.linalg.LinAlgError: a multiplier does not.
    """

    def __init__(
        self,
        layout: ChainLayout,
        entries: np.ndarray,
        curvature: np.ndarray,
        is_sample: np.ndarray,
    ) -> None:
        self._layout = layout
        slopes = layout.slopes(entries)
        n_states = layout.chain.n_states
        rank = np.arange(n_states)
        self._passage = Passage(slopes, layout.chain.begin, is_sample, rank)
        self._over_gaps = self._passage.slopes()
        self._inverse = 1 / curvature[is_sample].ravel()
        self.n = curvature.size + slopes.shape[0]
        band = _band_of_squares(self._over_gaps, self._inverse, n_states)
        self._factors, info = dpbtrf(band, lower=True, overwrite_ab=True)
        if info:
            raise np.linalg.LinAlgError("multipliers do not follow")
        of_samples = -float(np.sum(np.log(self._inverse)))
        of_multipliers = 2 * float(np.sum(np.log(self._factors[0])))
        of_inside = 2 * self._passage.log_abs_det
        self.log_abs_det = of_samples + of_multipliers + of_inside

    @classmethod
    def of(cls, layout: ChainLayout, entries: np.ndarray) -> "Chained | None":
        """Of the matrix with these entries; None where samples do not measure all."""
        curvature = layout.curvature(entries)
        is_sample = _samples(layout.chain.begin, curvature)
        if is_sample is None or not np.all(np.isfinite(entries)):
            return None
        with suppress(np.linalg.LinAlgError, SolveError):
            return cls(layout, entries, curvature, is_sample)
        return None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k)."""
        order = self._layout.order
        n_x = self._layout.chain.n_nodes * len(order)
        columns = right.reshape(self.n, -1)
        shape = (-1, len(order), columns.shape[1])
        sorted_columns = columns.reshape(shape)[:, order]
        flat = sorted_columns.reshape(columns.shape)
        x, multipliers = self._solved(flat[:n_x], flat[n_x:])
        found = np.empty_like(sorted_columns)
        found[:, order] = np.concatenate([x, multipliers]).reshape(shape)
        return found.reshape(right.shape)

    def _solved(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and multipliers for a (n_x, k) and b (n_multipliers, k)."""
        passage = self._passage
        weights = self._inverse[:, None]
        pulled = passage.pulled(a[passage.inside])
        a_samples = a[passage.samples] - passage.first.T @ pulled
        missed = self._over_gaps @ (weights * a_samples) - passage.over(b)
        of_last: np.ndarray = dpbtrs(self._factors, missed, lower=True)[0]
        samples = weights * (a_samples - self._over_gaps.T @ of_last)
        offset = b[passage.of_inside] - passage.first @ samples
        x = np.empty_like(a)
        x[passage.samples] = samples
        x[passage.inside] = passage.followed(offset)
        multipliers = np.empty_like(b)
        multipliers[passage.of_last] = of_last
        onward = passage.pulled(passage.onward.T @ of_last)
        multipliers[passage.of_inside] = pulled - onward
        return x, multipliers


@dataclass(frozen=True, eq=False)
class TimeLayout:
    """A symmetric pattern of states and multipliers, filled again and again.

    Attributes:
        rows: (n_entries,) row of every entry; entries at one place are added.
        columns: (n_entries,) its column.
        order: (n,), the unknowns in the order in which they make a band.
        chain: nodes and intervals that the unknowns belong to; None: a band is all.
    """

    rows: np.ndarray
    columns: np.ndarray
    order: np.ndarray
    chain: Chain | None

    @cached_property
    def _banded(self) -> BandLayout:
        return BandLayout(self.rows, self.columns, self.order, is_symmetric=True)

    @cached_property
    def _chained(self) -> ChainLayout | None:
        if self.chain is None:
            return None
        return ChainLayout.of(self.rows, self.columns, self.chain)

    def factors(self, entries: np.ndarray) -> Banded | Chained:
        """Of the matrix with these entries (n_entries,).

        Raises:
            SolveError: the matrix is singular.
        """
        chained = self._chained and Chained.of(self._chained, entries)
        return chained or Banded(self._banded, entries)


def _band_of_squares(
    slopes: csr_matrix, inverse: np.ndarray, n_states: int
) -> np.ndarray:
    """J H^-1 J' in LAPACK's storage of the lower half of a band, (height, n)."""
    n = slopes.shape[0]
    weighted = slopes @ diags(inverse)
    transposed = slopes.T.tocsr()
    height = 1 + _farthest(transposed)
    band = np.zeros(height * n)
    step = 64 * n_states  # gaps whose products are worked out at a time
    for first in range(0, n, step):
        part = (weighted[first : first + step] @ transposed).tocoo()
        below = part.row + first - part.col
        is_lower = below >= 0
        places = part.col[is_lower].astype(np.int64) * height + below[is_lower]
        band[places] = part.data[is_lower]
    return band.reshape(n, height).T


def _farthest(transposed: csr_matrix) -> int:
    """Places between rows that touch one column, at most."""
    transposed.sort_indices()
    begin, end = transposed.indptr[:-1], transposed.indptr[1:]
    is_any = end > begin
    indices = transposed.indices
    return int(np.max(indices[end[is_any] - 1] - indices[begin[is_any]], initial=0))


def _renamed(places: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Places (node or interval, state) with the states in another order."""
    block, state = np.divmod(places, len(rank))
    renamed: np.ndarray = block * len(rank) + rank[state]
    return renamed


def _samples(begin: np.ndarray, curvature: np.ndarray) -> np.ndarray | None:
    """Nodes of which all states are measured, (n_nodes,); of the others none is.

    None where it is not so, or where a trajectory begins or ends between samples.
    """
    largest = np.max(curvature, initial=0.0)
    # What lies between the two limits would cost digits.
    is_sample = np.all(curvature > 1e-8 * largest, axis=1)
    is_between = np.all(curvature <= 1e-11 * largest, axis=1)
    has_next = np.zeros(len(curvature), dtype=bool)
    has_next[begin] = True
    has_previous = np.zeros(len(curvature), dtype=bool)
    has_previous[begin + 1] = True
    follows = is_between & has_next & has_previous
    return is_sample if np.all(is_sample | follows) else None
