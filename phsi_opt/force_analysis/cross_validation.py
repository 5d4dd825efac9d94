"""How well functions predict a force on stretches of time that their fit did not see.

Cross-validation by stretches, not by samples: an estimated force is smooth, so a sample
alone is known from its neighbours, and every flexible function would seem to predict
it. An input that is held at a value for long tells the time by it: where functions of
inputs are judged, what is left out has several such values as a whole.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.statistics import TINY

N_FOLDS = 5  # every fifth stretch is left out in turn
N_VALIDATION_STRETCHES = 40  # into which a record is cut
HOLDS_IN_STRETCH = 3  # values of an input that is held, in a stretch, at least
COEFFICIENT_RIDGE = 1e-3  # weight of the smallness of coefficients, in samples per knot


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """A force on stretches of time that are left out in turn.

    Attributes:
        w: the force, (n_intervals,).
        fold: number of the fold that leaves each interval out, (n_intervals,).
    """

    w: np.ndarray
    fold: np.ndarray

    @classmethod
    def of(cls, w: np.ndarray, run: np.ndarray) -> "CrossValidation":
        """The stretches of a force (n_intervals,) along trajectories ``run``."""
        return cls(w, fold_numbers(run))

    @classmethod
    def of_inputs(
        cls, w: np.ndarray, run: np.ndarray, inputs: np.ndarray
    ) -> "CrossValidation":
        """The stretches of a force on which functions of inputs are judged.

        Args:
            w: the force, (n_intervals,).
            run: number of the trajectory, (n_intervals,).
            inputs: (n_intervals, n_inputs).
        """
        return cls(w, fold_numbers_of_holds(run, inputs))

    @property
    def total(self) -> float:
        """Sum of squares of the force."""
        return float(np.sum(self.w**2))

    @property
    def training_masks(self) -> Iterable[np.ndarray]:
        """Which intervals each fold fits to, (n_intervals,) of bool."""
        for number in np.unique(self.fold):
            yield self.fold != number

    def leave_out_error(self, bases: Sequence[np.ndarray]) -> float:
        """Sum of squares that least-squares fits leave on the stretches left out.

        Args:
            bases: columns of functions, each (n_intervals, k), fitted together.
        """
        columns = np.hstack(bases)
        parts = []
        for number in np.unique(self.fold):
            is_left_out = self.fold == number
            parts.append((columns[is_left_out], self.w[is_left_out]))
        grams = [part.T @ part for part, _ in parts]
        rights = [part.T @ w for part, w in parts]
        error = 0.0
        for i, (part, w) in enumerate(parts):
            gram = sum(grams) - grams[i]
            right = sum(rights) - rights[i]
            residual = w - part @ ridge_coefficients(gram, right)
            error += float(np.sum(residual**2))
        return error

    def error_left_out(self, columns: np.ndarray, is_fitted: np.ndarray) -> float:
        """Sum of squares on what one fold leaves out, after a fit to the rest.

        Args:
            columns: of functions, (n_intervals, k).
            is_fitted: the intervals that are fitted to, (n_intervals,) of bool.
        """
        fitted = columns[is_fitted]
        # Of a matrix and its own transpose NumPy takes another product, which rounds
        # otherwise; a second copy keeps the digits of the results that are stored.
        gram = columns[is_fitted].T @ fitted
        right = fitted.T @ self.w[is_fitted]
        predicted = columns[~is_fitted] @ ridge_coefficients(gram, right)
        residual = self.w[~is_fitted] - predicted
        return float(np.sum(residual**2))


def fold_numbers(run: np.ndarray) -> np.ndarray:
    """Which fold leaves each interval out, (n_intervals,).

    Stretches of each trajectory, as long as one another, are dealt to the folds in
    turn.

    Args:
        run: number of the trajectory, (n_intervals,).
    """
    return np.asarray(_even_stretches(run) % N_FOLDS)


def fold_numbers_of_holds(run: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """The same; of whole holds, where an input is held for a third of a stretch.

    Args:
        run: number of the trajectory, (n_intervals,).
        inputs: (n_intervals, n_inputs).
    """
    stretch = _even_stretches(run)
    for u in inputs.T:
        of_holds = _stretches_of_holds(_holds(run, u))
        if of_holds is not None and of_holds[-1] < stretch[-1]:
            stretch = of_holds
    return np.asarray(stretch % N_FOLDS)


def _even_stretches(run: np.ndarray) -> np.ndarray:
    """Number of the stretch of each interval, (n_intervals,), all of like length."""
    count = np.bincount(run)
    share_of_record = N_VALIDATION_STRETCHES * count / len(run)
    at_most = np.maximum(count, 1)
    n_stretches = np.clip(np.round(share_of_record), 1, at_most).astype(int)
    n_before = np.cumsum(n_stretches) - n_stretches
    in_run = place_in_run(run) * n_stretches[run] // count[run]
    return np.asarray(n_before[run] + in_run)


def _holds(run: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Number of the value at which an input (n_intervals,) is held, (n_intervals,).

    What changes from interval to interval belongs to the value before.
    """
    is_new_run = np.r_[True, np.diff(run) != 0]
    changes = is_new_run | np.r_[True, np.diff(u) != 0]
    stays = np.r_[~changes[1:], True]
    return np.asarray(np.cumsum(is_new_run | (changes & stays)) - 1)


def _stretches_of_holds(hold: np.ndarray) -> np.ndarray | None:
    """Number of the stretch of each interval, (n_intervals,): of whole holds.

    None where there are too few holds for the folds, or one is longer than a fold.
    """
    n_holds = int(hold[-1]) + 1
    longest = int(np.bincount(hold).max())
    if n_holds < N_FOLDS or longest > len(hold) / N_FOLDS:
        return None
    n_stretches = max(n_holds // HOLDS_IN_STRETCH, N_FOLDS)
    return np.asarray(hold * n_stretches // n_holds)


def place_in_run(run: np.ndarray) -> np.ndarray:
    """Number of each interval within its trajectory, counted from 0, (n_intervals,)."""
    count = np.bincount(run)
    first = np.cumsum(count) - count
    return np.asarray(np.arange(len(run)) - first[run])


def ridge_coefficients(gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Coefficients (k,) of a fit with gram matrix (k, k), slightly drawn to zero."""
    n = len(gram)
    weight = COEFFICIENT_RIDGE * np.trace(gram) / max(n, 1) + TINY
    regularised = gram + weight * np.eye(n)
    return np.asarray(np.linalg.solve(regularised, right))


def explained_share(error: float, total: float) -> float:
    """Part of a sum of squares that is not error; zero where the error is larger."""
    if total <= 0:
        return 0.0
    return max(0.0, 1 - error / total)
