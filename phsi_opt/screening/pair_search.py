"""Pairs of effects: what two explain together, without re-fitting.

Each coefficient keeps its bounds, and inner parameters are chosen for the two together:
what spills over a rim explains little until a loss makes the level right, and then at
another rim.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.screening.regression import CORRELATION_RIDGE, REST_BOUNDS, bounds_of
from phsi_opt.screening.score_test import ScannedPoint, ScoreTest, Screened
from phsi_opt.statistics import TINY

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
    joint = _JointRegression.of(test, found, scanned)
    best = _best_points(test, found, scanned, joint)
    ordered = sorted(best.items(), key=lambda item: -item[1].score)
    compatible = _compatible(test, found, ordered)
    return [_started(found, scanned, joint, pair) for pair in islice(compatible, most)]


def _best_points(
    test: ScoreTest,
    found: Sequence[Screened],
    scanned: list[_Scanned],
    joint: "_JointRegression",
) -> dict[tuple[int, int], _Best]:
    """The two points of every two effects that explain most together."""
    of_kept_rows = test.n_values / len(test.linearized.kept_rows)
    best: dict[tuple[int, int], _Best] = {}
    for a, b in combinations(range(len(scanned)), 2):
        i = scanned[a].owner
        j = scanned[b].owner
        if i == j:
            continue
        drop = of_kept_rows * joint.drop(a, b)
        if not drop > 0:
            continue
        score = test.score_of(drop, found[i].n_free + found[j].n_free)
        known = best.get((i, j))
        if known is None or (score, a, b) > (known.score, known.first, known.second):
            best[i, j] = _Best(score, a, b)
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
    joint: "_JointRegression",
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
class _JointRegression:
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
    ) -> "_JointRegression":
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
        """Scaled coefficients; what would leave its bounds is held there."""
        gram = self.gram[np.ix_(both, both)]
        right = self.right[both]
        lower, upper = self.bounds[both].T
        c = np.where(lower == upper, lower, 0.0)
        free = lower < upper
        while free.any():
            at_bounds = gram[:, ~free] @ c[~free]
            c[free] = np.linalg.solve(
                gram[np.ix_(free, free)], (right - at_bounds)[free]
            )
            is_outside = free & ((c < lower) | (c > upper))
            if not is_outside.any():
                break
            c[is_outside] = np.clip(c, lower, upper)[is_outside]
            free = free & ~is_outside
        return c

    def drop(self, a: int, b: int) -> float:
        """Fall of the misfit; none where one of the two does nothing."""
        of_a = self._columns(a)
        both = np.r_[of_a, self._columns(b)]
        c = self._solved(both)
        n = len(of_a)
        if not (c[:n].any() and c[n:].any()):
            return 0.0
        gram = self.gram[np.ix_(both, both)]
        return float(2 * c @ self.right[both] - c @ gram @ c)

    def coefficients(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients at point ``a`` and at point ``b``."""
        of_a = self._columns(a)
        both = np.r_[of_a, self._columns(b)]
        c = self._solved(both) / self.size[both]
        return c[: len(of_a)], c[len(of_a) :]
