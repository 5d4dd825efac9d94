"""Which terms go, by size and by significance, and when to stop."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model


@dataclass(frozen=True)
class Pruning:
    """Remove terms that are too small, or that the data do not need, and solve again
    until none is left to remove.

    Args:
        threshold: terms with |coefficient| < threshold go (thesis Algorithm 6; 0:
            none).
        significance: chance, over the whole dictionary, to keep any term whose true
            coefficient is zero. Terms go while the data do not contradict that they are
            zero: each by its own z-test at significance / number of terms (Bonferroni),
            and those that go in one round also together, by Wald's chi-square test.
            None: size alone.
        slots: where terms may go (damping stays by default: a small damping is still
            one).
        debias: solve the last time without L1, which shrinks every coefficient that it
            keeps. Significance needs it.
    """

    threshold: float = 0.05
    slots: tuple[str, ...] = ("H", "F")
    debias: bool = True
    max_rounds: int = 50
    significance: float | None = None

    def __post_init__(self) -> None:
        if not self.threshold >= 0:
            raise ModelError(
                f"threshold={self.threshold!r} of Pruning must be a number of at least 0."
            )
        for slot in self.slots:
            if slot not in ("H", "R", "F"):
                raise ModelError(
                    f"slot {slot!r} of Pruning is unknown; expected 'H', 'R' or 'F'."
                )
        if self.significance is not None and not 0 < self.significance < 1:
            raise ModelError(
                f"significance={self.significance!r} of Pruning must lie between 0 and 1, such as 0.01."
            )
        if self.significance is not None and not self.debias:
            raise ModelError(
                "significance needs debias=True: a coefficient that L1 shrinks has no standard error."
            )

    def candidates(self, model: Model) -> list[str]:
        """Names of the coefficients that may go."""
        return [
            name
            for name, entry in model.entries.items()
            if entry.prunable and not entry.parameter.fixed and entry.slot in self.slots
        ]

    def small(self, model: Model, values: dict[str, float]) -> set[str]:
        """Names of the coefficients to remove for their size."""
        return {
            name
            for name in self.candidates(model)
            if abs(values[name]) < self.threshold
        }

    def insignificant(
        self,
        model: Model,
        values: dict[str, float],
        covariance: np.ndarray,
        n_tests: int,
    ) -> set[str]:
        """Names of the coefficients to remove because zero explains the data as well.

        ``covariance`` is that of ``model.free``; a coefficient without a standard error
        stays. ``n_tests`` is the number of terms of the dictionary that pruning began
        with.
        """
        if self.significance is None:
            return set()
        order = {name: i for i, name in enumerate(model.free)}
        known = [
            name
            for name in self.candidates(model)
            if np.isfinite(covariance[order[name], order[name]])
        ]
        z = {
            name: abs(values[name]) / np.sqrt(covariance[order[name], order[name]])
            for name in known
        }
        limit = norm.isf(self.significance / max(n_tests, 1) / 2)
        weak = sorted(
            (name for name in known if z[name] < limit), key=lambda name: z[name]
        )
        while len(weak) > 1:
            index, xi = (
                [order[name] for name in weak],
                np.array([values[name] for name in weak]),
            )
            together = xi @ np.linalg.solve(covariance[np.ix_(index, index)], xi)
            if together < chi2.isf(self.significance, len(weak)):
                break
            weak.pop()
        return set(weak)
