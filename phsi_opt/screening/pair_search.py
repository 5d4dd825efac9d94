"""Pairs of effects: what two explain together, without re-fitting.

Each coefficient keeps its bounds, and inner parameters are chosen for the two together:
what spills over a rim explains little until a loss makes the level right, and then at
another rim.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.screening.regression import CORRELATION_RIDGE, REST_BOUNDS, bounds_of
from phsi_opt.screening.score_test import ScannedPoint, ScoreTest, Screened
from phsi_opt.statistics import TINY

PAIRS_AT_ONCE = 10_000  # of points, whose small systems are solved together
# Bounds of an effect without a coefficient: it is there as a whole.
WHOLE = (1.0, 1.0)
Pair = tuple[Screened, Screened]  # the stronger first


@dataclass(frozen=True, eq=False)
class _Scanned:
    """One of the points at which an effect was scanned; ``owner``: its number."""

    owner: int
    point: ScannedPoint


@dataclass(frozen=True, eq=False)
class _Best:
    """Two points of two effects, and what they explain together."""

    score: float
    first: int
    second: int


def best_pairs(test: ScoreTest, found: Sequence[Screened], most: int) -> list[Pair]:
    """The pairs of effects that explain most together, with values to start from.

    Args:
        test: of the record.
        found: the effects, as screened alone.
        most: number of pairs.
    """
    scanned = []
    for owner, one in enumerate(found):
        scanned += [_Scanned(owner, point) for point in one.scanned]
    if not scanned:
        return []
    joint = JointRegression.of(test, found, scanned)
    best = _best_points(test, found, scanned, joint)
    ordered = sorted(best.items(), key=lambda item: (-item[1].score, item[0]))
    compatible = _compatible(test, found, ordered)
    return [_started(found, scanned, joint, pair) for pair in islice(compatible, most)]


def _best_points(
    test: ScoreTest,
    found: Sequence[Screened],
    scanned: list[_Scanned],
    joint: "JointRegression",
) -> dict[tuple[int, int], _Best]:
    """The two points of every two effects that explain most together."""
    of_kept_rows = test.n_values / len(test.linearized.kept_rows)
    owner = np.array([one.owner for one in scanned])
    n_free = np.array([one.n_free for one in found])[owner]
    a, b = np.triu_indices(len(scanned), k=1)
    is_pair = owner[a] != owner[b]
    a, b = a[is_pair], b[is_pair]
    drops = of_kept_rows * joint.drops(a, b)
    does_fall = drops > 0
    a, b, drops = a[does_fall], b[does_fall], drops[does_fall]
    scores = test.score_of(drops, n_free[a] + n_free[b])
    best: dict[tuple[int, int], _Best] = {}
    # The best of every two effects comes last, and stays.
    for place in np.lexsort((b, a, scores)).tolist():
        first, second = int(a[place]), int(b[place])
        owners = int(owner[first]), int(owner[second])
        best[owners] = _Best(float(scores[place]), first, second)
    return best


def _compatible(
    test: ScoreTest,
    found: Sequence[Screened],
    ordered: list[tuple[tuple[int, int], _Best]],
) -> Iterator[_Best]:
    """Pairs that can be in one model: Stribeck's friction contains Coulomb's."""
    for (i, j), pair in ordered:
        try:
            test.model.add(found[i].effect).add(found[j].effect)
        except ModelError:
            continue
        yield pair


def _started(
    found: Sequence[Screened],
    scanned: list[_Scanned],
    joint: "JointRegression",
    pair: _Best,
) -> Pair:
    """Both effects with the values that they have beside each other."""
    coefficients = joint.coefficients(pair.first, pair.second)
    started = []
    for place, c in zip((pair.first, pair.second), coefficients, strict=True):
        one = found[scanned[place].owner]
        inner = scanned[place].point.values
        linear = [name for name in one.values if name not in inner]
        together = dict(zip(linear, c.tolist(), strict=False))
        values = {**one.values, **inner, **together}
        started.append(replace(one, values=values))
    first, second = sorted(started, key=lambda one: -one.drop)
    return first, second


def _bounds(test: ScoreTest, one: Screened, point: ScannedPoint) -> np.ndarray:
    """Bounds of the coefficients, (k, 2), those of a body at rest last."""
    model = test.model.add(one.effect)
    linear = [name for name in one.values if name not in point.values]
    bounds = bounds_of(model, linear)
    n_more = point.trace.shape[1] - len(bounds)
    return np.array(bounds + [REST_BOUNDS if bounds else WHOLE] * n_more)


@dataclass(frozen=True, eq=False)
class JointRegression:
    """The regression of the residual on the traces of two of many points together.

    From their common products, so that a pair costs the solution of a small system.

    Attributes:
        size: norm of each column.
        gram: products of the columns over their sizes.
        right: products with the residual.
        bounds: of the coefficients times the size, (n_columns, 2).
        edges: where the columns of each point begin.
    """

    size: np.ndarray
    gram: np.ndarray
    right: np.ndarray
    bounds: np.ndarray
    edges: np.ndarray

    @classmethod
    def of(
        cls, test: ScoreTest, found: Sequence[Screened], scanned: list[_Scanned]
    ) -> "JointRegression":
        """Of effects that were screened, at the points at which they were scanned."""
        traces = np.hstack([one.point.trace for one in scanned])
        bounds = [_bounds(test, found[one.owner], one.point) for one in scanned]
        residual = test.linearized.residual[test.linearized.kept_rows]
        size = np.maximum(np.linalg.norm(traces, axis=0), TINY)
        columns = traces / size
        # By the general product: the symmetric one, which BLAS takes for an array and
        # itself, rounds in another way, and pairs that are close change places.
        gram = columns.copy().T @ columns + CORRELATION_RIDGE * np.eye(len(size))
        return cls(
            size=size,
            gram=gram,
            right=columns.T @ residual,
            bounds=np.concatenate(bounds) * size[:, None],
            edges=np.cumsum([0, *map(len, bounds)]),
        )

    def _columns(self, point: int) -> np.ndarray:
        return np.arange(self.edges[point], self.edges[point + 1])

    def _solved(self, both: np.ndarray) -> np.ndarray:
        """Scaled coefficients of these columns; what would leave its bounds is held.

        ``both`` is (n_pairs, k), as is the result.
        """
        gram = self._products(both)
        lower, upper = self.bounds[both].transpose(2, 0, 1)
        c = np.where(lower == upper, lower, 0.0)
        free = lower < upper
        left = np.flatnonzero(free.any(axis=1))
        while len(left):
            c[left] = _with_held(
                gram[left], self.right[both[left]], c[left], free[left]
            )
            is_outside = free[left] & (
                (c[left] < lower[left]) | (c[left] > upper[left])
            )
            left = left[is_outside.any(axis=1)]
            is_outside = free & ((c < lower) | (c > upper))
            c[is_outside] = np.clip(c, lower, upper)[is_outside]
            free &= ~is_outside
            left = left[free[left].any(axis=1)]
        return c

    def _products(self, both: np.ndarray) -> np.ndarray:
        """Of the columns of every pair, (n_pairs, k, k)."""
        return self.gram[both[:, :, None], both[:, None, :]]

    def drops(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Fall of the misfit by points ``a`` and ``b``, (n_pairs,) all.

        None where one of the two does nothing.
        """
        found = np.zeros(len(a))
        n_of = np.diff(self.edges)
        for n, m in np.unique(np.column_stack([n_of[a], n_of[b]]), axis=0).tolist():
            alike = np.flatnonzero((n_of[a] == n) & (n_of[b] == m))
            # Some at a time, so that memory is bounded.
            for some in np.split(
                alike, range(PAIRS_AT_ONCE, len(alike), PAIRS_AT_ONCE)
            ):
                of_a = self.edges[a[some], None] + np.arange(n)
                of_b = self.edges[b[some], None] + np.arange(m)
                found[some] = self._drops_of(np.hstack([of_a, of_b]), n)
        return found

    def _drops_of(self, both: np.ndarray, n: int) -> np.ndarray:
        """Of pairs whose first point has n columns."""
        c = self._solved(both)
        by_both = c[:, :n].any(axis=1) & c[:, n:].any(axis=1)
        explained = np.einsum("ij,ij->i", c, self.right[both])
        spent = np.einsum("ij,ijk,ik->i", c, self._products(both), c)
        return np.where(by_both, 2 * explained - spent, 0.0)

    def coefficients(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients at point ``a`` and at point ``b``."""
        of_a = self._columns(a)
        both = np.r_[of_a, self._columns(b)]
        c = self._solved(both[None])[0] / self.size[both]
        return c[: len(of_a)], c[len(of_a) :]


def _with_held(
    gram: np.ndarray, right: np.ndarray, c: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Least squares in the coefficients that are free, the others as they are.

    ``gram`` is (n, k, k), the others (n, k).
    """
    held = np.where(free, 0.0, c)
    at_held = np.einsum("ijk,ik->ij", gram, held)
    both_free = free[:, :, None] & free[:, None, :]
    system = np.where(both_free, gram, np.eye(c.shape[1]))
    wanted = np.where(free, right - at_held, c)
    return np.linalg.solve(system, wanted[..., None])[..., 0]
