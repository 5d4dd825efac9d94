"""Linear algebra along the time: the optimality system of a record, factored.

Unknowns that touch only their neighbours in time make a banded matrix, whose factors
cost time and memory in proportion to the number of samples. The optimality system of
every likelihood here is such a matrix, bordered by the few columns of the parameters
(the border is dealt with in `model_error`).

`Banded` factors any such matrix. Where samples measure every one of many states,
`Chained` solves for the states by their own curvature; the system of the multipliers is
then positive definite and couples neighbours in time: a band whose Cholesky factors
take a small part of the work, and a fifth of the memory, of LU factors of the whole.

::

    [H  J'] [x]   [a]
    [J  0 ] [l] = [b]      H diagonal;  J H^-1 J' l = J H^-1 a - b

Nodes between samples, where nothing was measured, follow from the sample before
(`Passage`).
"""

from contextlib import suppress

import numpy as np
from scipy.linalg.lapack import dgbtrf, dgbtrs, dpbtrf, dpbtrs
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import reverse_cuthill_mckee

from phsi_opt.errors import SolveError

# From this number of states on `Chained` gains: below, the band is as fast.
FEWEST_STATES = 14


class BandLayout:
    """Where the entries of matrices of one pattern stand in LAPACK's band storage.

    Args:
        rows: (n_entries,) row of every entry; entries at one place are added.
        columns: (n_entries,) its column.
        order: (n,), the unknowns in the order in which they make a band.
        is_symmetric: whether the matrices are.
    """

    def __init__(
        self,
        rows: np.ndarray,
        columns: np.ndarray,
        order: np.ndarray,
        is_symmetric: bool = False,
    ) -> None:
        self.order = order
        self.is_symmetric = is_symmetric
        self.n = len(order)
        self.rank = np.argsort(order)
        sorted_columns = self.rank[columns]
        offsets = self.rank[rows] - sorted_columns
        self.kl = int(np.max(offsets, initial=0))
        self.ku = int(np.max(-offsets, initial=0))
        # LAPACK's band storage, with kl more rows for what pivoting fills in.
        self.height = 2 * self.kl + self.ku + 1
        self.places = sorted_columns * self.height + self.kl + self.ku + offsets


class Banded:
    """LU factors (LAPACK, partial pivoting) of a matrix that is banded once sorted.

    Args:
        layout: of its pattern.
        entries: (n_entries,) in the order of the layout.

    Raises:
        SolveError: the matrix is singular.
    """

    def __init__(self, layout: BandLayout, entries: np.ndarray) -> None:
        self.layout = layout
        self.n = layout.n
        size = layout.n * layout.height
        band = np.bincount(layout.places, weights=entries, minlength=size)
        self._factors, self._pivots, info = dgbtrf(
            band.reshape(layout.n, layout.height).T,
            layout.kl,
            layout.ku,
            overwrite_ab=True,
        )
        if info > 0:
            raise SolveError(
                "the optimality system is singular: probably a state is not measured "
                "and does not act on a measured one. Measure it, or remove it from "
                "the model."
            )

    def solve(self, right: np.ndarray, is_transposed: bool = False) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k), maybe transposed.

        Column after column in memory, as LAPACK has them; nothing is copied where the
        right-hand sides are so too.
        """
        layout = self.layout
        columns = np.take(right.reshape(self.n, -1).T, layout.order, axis=1)
        if layout.is_symmetric:
            # Both are the same, and from three columns on LAPACK solves with the
            # transposed factors in less time: a quarter to a third less for eight.
            is_transposed = len(columns) >= 3
        solution, _ = dgbtrs(
            self._factors,
            layout.kl,
            layout.ku,
            columns.T,
            self._pivots,
            trans=int(is_transposed),
            overwrite_b=True,
        )
        result = np.take(solution.T, layout.rank, axis=1)
        return result[0] if right.ndim == 1 else result.T

    @property
    def log_abs_det(self) -> float:
        diagonal = self._factors[self.layout.kl + self.layout.ku]
        return float(np.sum(np.log(np.abs(diagonal))))


# ---- dynamics over gaps between samples


class Passage:
    """Linear dynamics over gaps between samples, the nodes inside solved for.

    Every gap leads from one sample to the next. Its last interval ends at a sample; the
    others end at nodes inside, which follow from the sample at its begin. Sorted by
    what touches what, the slopes inside are a narrow band, whatever the number of
    states.

    ::

        inside x_inside + first x_samples = right of the intervals that end inside
        onward x_inside + last  x_samples = right of the last intervals

    Args:
        slopes: J, (n_intervals * n_states, n_nodes * n_states).
        begin: (n_intervals,) first node of each interval, in the order of time; the
            next node is its end.
        is_sample: (n_nodes,); the first and last nodes of every trajectory are samples.
        n_states: number of states.

    Attributes:
        rank: (n_states,) place of each state where those that touch are neighbours.
        of_inside: rows of J that end inside gaps; of_last: those that end at samples.
        inside: columns of J of the nodes inside; samples: those of samples.

    Raises:
        SolveError: a node inside does not follow.
    """

    def __init__(
        self,
        slopes: csr_matrix,
        begin: np.ndarray,
        is_sample: np.ndarray,
        n_states: int,
    ) -> None:
        entries = slopes.tocoo()
        state = entries.row % n_states
        order = neighbours_first(state, entries.col % n_states, n_states)
        self.rank = np.argsort(order)
        self._n = n_states
        is_last = is_sample[begin + 1]
        sample = np.cumsum(is_sample) - 1
        self._sample = sample[begin[is_sample[begin]]]
        self.of_inside = self._places(~is_last)
        self.of_last = self._places(is_last)
        self.inside = self._places(~is_sample)
        self.samples = self._places(is_sample)
        self.onward = slopes[self.of_last][:, self.inside]
        self.last = slopes[self.of_last][:, self.samples]
        before = slopes[self.of_inside]
        self.first = before[:, self.samples]
        self._factors: Banded | None = None
        if len(self.inside):
            gap = (np.cumsum(is_last) - is_last)[~is_last]
            self._factors = self._factored(before[:, self.inside].tocoo(), gap)

    def _places(self, chosen: np.ndarray) -> np.ndarray:
        """Of the states of chosen nodes, or intervals, among all."""
        return np.flatnonzero(np.repeat(chosen, self._n))

    def _factored(self, slopes: coo_matrix, gap: np.ndarray) -> Banded:
        """Of the slopes inside, in the order that makes the narrower band."""
        interval, state = np.divmod(np.arange(slopes.shape[0]), self._n)
        rank = self.rank[state]
        layouts = []
        for keys in ((interval, rank, gap[interval]), (rank, interval)):
            layouts.append(BandLayout(slopes.row, slopes.col, np.lexsort(keys)))
        narrower = min(layouts, key=lambda layout: layout.kl + layout.ku)
        return Banded(narrower, slopes.data)

    @property
    def log_abs_det(self) -> float:
        return self._factors.log_abs_det if self._factors else 0.0

    def followed(self, right: np.ndarray, is_transposed: bool = False) -> np.ndarray:
        """States inside for right-hand sides (n_inside, k) of their intervals.

        Transposed: multipliers of these intervals for pulls on states inside.
        """
        return self._factors.solve(right, is_transposed) if self._factors else right

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
        """What intervals inside add to whole gaps, but for rounding."""
        # ``blocks`` (n_inside, n_columns) has one block of columns per gap, that of the
        # number ``place`` (n_gaps,). Gaps do not touch: one solution serves a column of
        # every block, eight columns at a time. Smaller shares of the largest slope than
        # 1e-18 are rounding.
        n = self._n
        entries = blocks.tocoo()
        negligible = 1e-18 * np.max(np.abs(entries.data), initial=0.0)
        column = entries.col % n
        parts = []
        for states in np.array_split(np.arange(n), -(-n // 8)):
            own = (column >= states[0]) & (column <= states[-1])
            right = coo_matrix(
                (entries.data[own], (entries.row[own], column[own] - states[0])),
                shape=(blocks.shape[0], len(states)),
            ).toarray(order="F")
            effect = -(self.onward @ self.followed(right))
            row, number = np.nonzero(np.abs(effect) > negligible)
            into = place[row // n] * n + states[number]
            parts.append((effect[row, number], row, into))
        value, row, into = map(np.concatenate, zip(*parts, strict=True))
        shape = (len(place) * n, blocks.shape[1])
        return csr_matrix((value, (row, into)), shape=shape)


def neighbours_first(row: np.ndarray, column: np.ndarray, n_states: int) -> np.ndarray:
    """An order of states in which those that touch are near, (n_states,)."""
    touching = np.zeros((n_states, n_states), dtype=bool)
    touching[row, column] = True
    return reverse_cuthill_mckee(csr_matrix(touching | touching.T), True)


# ---- many states, all of them measured at samples


class Chained:
    """Cholesky factors where samples measure all states, and nothing between them is.

    Args:
        slopes: J, (n_intervals * n_states, n_nodes * n_states).
        begin: as that of `Passage`.
        curvature: (n_nodes, n_states) diagonal of H.
        is_sample: (n_nodes,) whether a node's states are measured.

    Raises:
        SolveError: a node between samples does not follow.
        np.linalg.LinAlgError: a multiplier does not.
    """

    @classmethod
    def of(
        cls, slopes: csr_matrix, begin: np.ndarray, curvature: np.ndarray
    ) -> "Chained | None":
        """None where samples do not measure all, or where there are no factors."""
        largest = np.max(curvature, initial=0.0)
        # What lies between the two limits would cost digits.
        is_sample = np.all(curvature > 1e-8 * largest, axis=1)
        is_between = np.all(curvature <= 1e-11 * largest, axis=1)
        nodes = np.arange(len(curvature))
        is_between &= np.isin(nodes, begin) & np.isin(nodes, begin + 1)
        is_number = np.isfinite(largest) and np.all(np.isfinite(slopes.data))
        if is_number and np.all(is_sample | is_between):
            with suppress(np.linalg.LinAlgError, SolveError):
                return cls(slopes, begin, curvature, is_sample)
        return None

    def __init__(
        self,
        slopes: csr_matrix,
        begin: np.ndarray,
        curvature: np.ndarray,
        is_sample: np.ndarray,
    ) -> None:
        n_states = curvature.shape[1]
        self._passage = Passage(slopes, begin, is_sample, n_states)
        self._over_gaps = self._passage.slopes()
        self._inverse = 1 / curvature[is_sample].ravel()
        self.n = curvature.size + slopes.shape[0]
        self._n_x = curvature.size
        first = np.arange(0, self._over_gaps.shape[0], n_states)[:, None]
        # Of multipliers in the band.
        self._order = (first + np.argsort(self._passage.rank)).ravel()
        band = _band_of_squares(self._over_gaps[self._order], self._inverse)
        self._factors, info = dpbtrf(band, lower=True, overwrite_ab=True)
        if info:
            raise np.linalg.LinAlgError("multipliers do not follow")
        of_samples = -float(np.sum(np.log(self._inverse)))
        of_multipliers = 2 * float(np.sum(np.log(self._factors[0])))
        of_inside = 2 * self._passage.log_abs_det
        self.log_abs_det = of_samples + of_multipliers + of_inside

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k)."""
        passage = self._passage
        columns = right.reshape(self.n, -1)
        a, b = columns[: self._n_x], columns[self._n_x :]
        weights = self._inverse[:, None]
        pulled = passage.followed(a[passage.inside], is_transposed=True)
        a_samples = a[passage.samples] - passage.first.T @ pulled
        missed = self._over_gaps @ (weights * a_samples) - passage.over(b)
        of_last = np.empty_like(missed)
        solved = dpbtrs(self._factors, missed[self._order], lower=True)[0]
        of_last[self._order] = solved
        samples = weights * (a_samples - self._over_gaps.T @ of_last)
        x = np.empty_like(a)
        x[passage.samples] = samples
        x[passage.inside] = passage.followed(
            b[passage.of_inside] - passage.first @ samples
        )
        multipliers = np.empty_like(b)
        multipliers[passage.of_last] = of_last
        onward = passage.followed(passage.onward.T @ of_last, is_transposed=True)
        multipliers[passage.of_inside] = pulled - onward
        return np.concatenate([x, multipliers]).reshape(right.shape)


def _band_of_squares(slopes: csr_matrix, inverse: np.ndarray) -> np.ndarray:
    """J H^-1 J' in LAPACK's storage of the lower half of a band, (height, n)."""
    n = slopes.shape[0]
    weighted = slopes @ diags(inverse)
    transposed = slopes.T.tocsr()
    transposed.sort_indices()
    begin, end = transposed.indptr[:-1], transposed.indptr[1:]
    is_any = end > begin
    indices = transposed.indices
    farthest = indices[end[is_any] - 1] - indices[begin[is_any]]
    height = 1 + int(np.max(farthest, initial=0))
    band = np.zeros(height * n)
    step = 1024  # rows whose products are worked out at a time
    for first in range(0, n, step):
        part = (weighted[first : first + step] @ transposed).tocoo()
        below = part.row + first - part.col
        is_lower = below >= 0
        places = part.col[is_lower].astype(np.int64) * height + below[is_lower]
        band[places] = part.data[is_lower]
    return band.reshape(n, height).T
