"""Which terms go, by size and by significance.

A rule on names, values and a covariance; `support_selection` applies it to estimates
and solves again.
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.arguments import require_choice, require_share, require_size, typed
from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model
from phsi_opt.statistics import chi_square_limit, normal_limit

TERM_SLOTS = ("H", "R", "F")


@typed
@dataclass(frozen=True)
class Pruning:
    """Remove terms that are too small or not significant, and solve again, repeatedly.

    Args:
        threshold: terms with ``|coefficient| < threshold`` go (thesis Algorithm 6; 0:
            none).
        slots: slots from which terms may be removed (by default not R, since a small
            damping is still a damping).
        debias: solve the last time without L1, because L1 shrinks all coefficients.
            Required for significance.
        max_rounds: largest number of solves.
        significance: probability, over the whole dictionary, of keeping any term whose
            true coefficient is zero. Terms are removed if two tests allow a zero
            coefficient: a z-test of each term at significance / number of terms
            (Bonferroni), and Wald's chi-square test (1943) of all terms of a round
            together. None: threshold only.

    Raises:
        ModelError: a setting is not valid.
    """

    threshold: float = 0.05
    slots: tuple[str, ...] = ("H", "F")
    debias: bool = True
    max_rounds: int = 50
    significance: float | None = None

    def __post_init__(self) -> None:
        require_size("Pruning: threshold", self.threshold)
        for slot in self.slots:
            require_choice("Pruning: slot", slot, TERM_SLOTS)
        if self.significance is None:
            return
        require_share("Pruning: significance", self.significance)
        if not self.debias:
            raise ModelError(
                "significance needs debias=True: a coefficient that L1 shrinks has no "
                "standard error."
            )

    def candidates(self, model: Model) -> list[str]:
        """Names of the coefficients that may go."""
        names = []
        for name, entry in model.entries.items():
            is_free_term = entry.prunable and not entry.parameter.fixed
            if is_free_term and entry.slot in self.slots:
                names.append(name)
        return names

    def small(self, model: Model, values: dict[str, float]) -> set[str]:
        """Names of the coefficients to remove for their size."""
        candidates = self.candidates(model)
        return {name for name in candidates if abs(values[name]) < self.threshold}

    def insignificant(
        self,
        model: Model,
        values: dict[str, float],
        covariance: np.ndarray,
        n_tests: int,
    ) -> set[str]:
        """Names of the coefficients to remove because zero explains the data as well.

        By their covariance (n_free, n_free), in the order of ``model.free``; a
        coefficient without a standard error (NaN) stays. ``n_tests`` is the number of
        terms before pruning.
        """
        if self.significance is None:
            return set()
        z = {}  # |estimate| / standard error
        for name in self.candidates(model):
            place = model.free.index(name)
            z[name] = abs(values[name]) / np.sqrt(covariance[place, place])
        limit = normal_limit(self.significance / max(n_tests, 1) / 2)
        weak = [name for name in z if z[name] < limit]
        weak.sort(key=z.__getitem__)
        while len(weak) > 1:
            together = _wald(weak, model, values, covariance)
            if together < chi_square_limit(self.significance, len(weak)):
                break
            weak.pop()
        return set(weak)


def _wald(
    names: list[str], model: Model, values: dict[str, float], covariance: np.ndarray
) -> float:
    """Wald's statistic xi' C^-1 xi of the coefficients all being zero."""
    places = list(map(model.free.index, names))
    xi = np.array(list(map(values.__getitem__, names)))
    block = covariance[np.ix_(places, places)]
    return float(xi @ np.linalg.solve(block, xi))
