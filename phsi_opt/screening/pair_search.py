"""Pairs of effects: what two explain together, each within its bounds and at inner
values that suit the other.
"""

from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.screening.score_test import Screen, Screened
from phsi_opt.statistics import TINY


def pairs(
    screen: Screen, found: list[Screened], most: int
) -> list[tuple[Screened, Screened]]:
    """The pairs of effects that explain most together, the stronger of each first, with
    values to start from.

    Coefficients keep their bounds, and inner parameters are chosen for the two
    together: what spills over a rim explains little until a loss makes the level right,
    and then at another rim.
    """
    points = [
        (i, point, trace) for i, one in enumerate(found) for point, trace in one.scanned
    ]
    if not points:
        return []
    traces = np.hstack([trace for *_, trace in points])
    bounds = [
        _bounds(screen, found[i], point, trace.shape[1]) for i, point, trace in points
    ]
    joint = _Joint.of(traces, screen.residual[screen.kept], bounds)
    best: dict[tuple[int, int], tuple[float, int, int]] = {}
    for a, b in combinations(range(len(points)), 2):
        i, j = points[a][0], points[b][0]
        if (
            i != j
            and (drop := screen.n_values / len(screen.kept) * joint.drop(a, b)) > 0
        ):
            score = screen.score_of(drop, found[i].n_free + found[j].n_free)
            best[i, j] = max(best.get((i, j), (-np.inf, a, b)), (score, a, b))
    ordered = sorted(best.items(), key=lambda item: -item[1][0])
    chosen = islice(
        (
            (a, b)
            for (i, j), (_, a, b) in ordered
            if _fit_together(screen, found[i], found[j])
        ),
        most,
    )
    return [_together(found, points, joint, a, b) for a, b in chosen]


def _fit_together(screen: Screen, one: Screened, other: Screened) -> bool:
    """Whether both can be in one model: Stribeck's friction has Coulomb's in it
    already.
    """
    try:
        screen.model.add(one.effect).add(other.effect)
    except ModelError:
        return False
    return True


def _together(
    found: list[Screened],
    points: list[tuple[int, dict[str, float], np.ndarray]],
    joint: "_Joint",
    a: int,
    b: int,
) -> tuple[Screened, Screened]:
    pair = []
    for (i, point, _), c in zip(
        (points[a], points[b]), joint.coefficients(a, b), strict=True
    ):
        linear = [name for name in found[i].values if name not in point]
        values = {
            **found[i].values,
            **point,
            **dict(zip(linear, c.tolist(), strict=False)),
        }
        pair.append(replace(found[i], values=values))
    first, second = sorted(pair, key=lambda one: -one.drop)
    return first, second


def _bounds(
    screen: Screen, one: Screened, point: dict[str, float], k: int
) -> np.ndarray:
    """(k, 2): the bounds of the coefficients; an effect without one is there as a
    whole, a body at rest up to that.
    """
    entries = screen.model.add(one.effect).entries
    linear = [entries[name].parameter for name in one.values if name not in point]
    own = [(p.lower, p.upper) for p in linear]
    return np.array(own + [(0.0 if own else 1.0, 1.0)] * (k - len(own)))


@dataclass(frozen=True, eq=False)
class _Joint:
    """The regression of the residual on the traces of two of many points together, from
    their common products.
    """

    size: np.ndarray  # of each column
    gram: np.ndarray  # of the columns over their size
    right: np.ndarray
    bounds: np.ndarray  # of the coefficients times the size
    edges: np.ndarray  # where the columns of each point begin

    @classmethod
    def of(
        cls, traces: np.ndarray, residual: np.ndarray, bounds: list[np.ndarray]
    ) -> "_Joint":
        size = np.maximum(np.linalg.norm(traces, axis=0), TINY)
        gram = (traces / size).T @ (traces / size) + 1e-10 * np.eye(len(size))
        edges = np.cumsum([0, *map(len, bounds)])
        return cls(
            size,
            gram,
            (traces / size).T @ residual,
            np.concatenate(bounds) * size[:, None],
            edges,
        )

    def _at(self, point: int) -> np.ndarray:
        return np.arange(self.edges[point], self.edges[point + 1])

    def _solved(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """The columns of both, and their coefficients; what would leave its bounds is
        held there.
        """
        both = np.r_[self._at(a), self._at(b)]
        gram, lower, upper = self.gram[np.ix_(both, both)], *self.bounds[both].T
        c, free = np.where(lower == upper, lower, 0.0), lower < upper
        while free.any():
            c[free] = np.linalg.solve(
                gram[np.ix_(free, free)],
                (self.right[both] - gram[:, ~free] @ c[~free])[free],
            )
            outside = free & ((c < lower) | (c > upper))
            if not outside.any():
                break
            c[outside] = np.clip(c, lower, upper)[outside]
            free = free & ~outside
        return both, c

    def drop(self, a: int, b: int) -> float:
        """Fall of the misfit; none where one of the two does nothing."""
        both, c = self._solved(a, b)
        n = len(self._at(a))
        if not (c[:n].any() and c[n:].any()):
            return 0.0
        return float(2 * c @ self.right[both] - c @ self.gram[np.ix_(both, both)] @ c)

    def coefficients(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Of the first and of the second."""
        both, c = self._solved(a, b)
        c, n = c / self.size[both], len(self._at(a))
        return c[:n], c[n:]
