"""How well functions predict a force on stretches of time that their fit did not see.

Cross-validation by stretches, not by samples: an estimated force is smooth, so a sample
alone is known from its neighbours, and every flexible function would seem to predict
it. An input that is held at a value for long tells the time by it: where functions of
inputs are judged, what is left out has several such values as a whole.
"""

from collections.abc import Callable, Sequence

import numpy as np

from phsi_opt.statistics import TINY, stretches

# Quantiles of the variable at the outer knots: the extreme hundredths share them.
OUTER_QUANTILES = (0.01, 0.99)


def piecewise_linear_basis(z: np.ndarray, n_knots: int = 12) -> np.ndarray:
    """Functions of a variable z (n,) that are linear between knots, (n, n_knots).

    Each is one at its knot and zero at the others; beyond the outer knots all are
    constant. Knots stand half way between even spacing and even occupation; there are
    fewer columns where they fall together.
    """
    quantiles = np.quantile(z, np.linspace(*OUTER_QUANTILES, n_knots))
    even = np.linspace(quantiles[0], quantiles[-1], n_knots)
    knots = np.unique((quantiles + even) / 2)
    peaks = np.eye(len(knots))
    return np.column_stack([np.interp(z, knots, peak) for peak in peaks])


def product_basis(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of piecewise linear functions of two variables (n,), (n, n_products)."""
    of_a = piecewise_linear_basis(a, n_knots=7)
    of_b = piecewise_linear_basis(b, n_knots=7)
    products = of_a[:, :, None] * of_b[:, None, :]
    return products.reshape(len(a), -1)


def odd_basis(z: np.ndarray) -> np.ndarray:
    """Odd piecewise linear functions of a variable z (n,); they jump at zero."""
    of_size = piecewise_linear_basis(np.abs(z), n_knots=6)
    return np.sign(z)[:, None] * of_size


# ---- judged on stretches left out ----------------------------------------------------

N_FOLDS = 5  # every fifth stretch is left out in turn

# Functions (n, k) that are sought on the intervals that are fitted to, (n,) of bool.
Sought = Callable[[np.ndarray], np.ndarray]


def left_out_error(
    w: np.ndarray,
    fold: np.ndarray,
    bases: Sequence[np.ndarray],
    sought: Sought | None = None,
) -> float:
    """Sum of squares of a force that fits leave on stretches of time left out.

    The columns (n_intervals, k) of all bases are fitted together, and those that
    ``sought`` finds for each fold; ``fold`` is the number of the fold that leaves each
    interval out. Coefficients are slightly drawn to zero: as by a thousandth of the
    samples.
    """
    columns = np.hstack(bases)
    normal = normal_equations(columns, w)
    error = 0.0
    for number in np.unique(fold):
        is_left_out = fold == number
        if sought is not None:
            columns = np.hstack([*bases, sought(~is_left_out)])
            normal = normal_equations(columns, w)
        left_out = columns[is_left_out]
        rest = normal - normal_equations(left_out, w[is_left_out])
        gram = rest[:, :-1]
        n = len(gram)
        weight = 1e-3 * np.trace(gram) / max(n, 1) + TINY
        coefficients = np.linalg.solve(gram + weight * np.eye(n), rest[:, -1])
        residual = w[is_left_out] - left_out @ coefficients
        error += float(residual @ residual)
    return error


def explained_share(error: float, total: float) -> float:
    """Part of a sum of squares that is not error; zero where the error is larger."""
    return max(0.0, 1 - error / total) if total > 0 else 0.0


def normal_equations(columns: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Gram matrix and right-hand side of a fit to w (n,), (k, k + 1)."""
    return columns.T @ np.column_stack([columns, w])


def fold_numbers(run: np.ndarray, inputs: np.ndarray | None = None) -> np.ndarray:
    """Which fold leaves each interval out, (n_intervals,).

    Forty stretches of the record, as long as one another, are dealt to the folds in
    turn, at least one of each trajectory; where functions of inputs (n_intervals,
    n_inputs) are judged, stretches of whole holds, if an input is held for a third of a
    stretch.
    """
    count = np.bincount(run)
    share_of_record = 40 * count / len(run)
    at_most = np.maximum(count, 1)
    n_stretches = np.clip(np.round(share_of_record), 1, at_most).astype(int)
    stretch = stretches(run, n_stretches)
    for u in () if inputs is None else inputs.T:
        hold = _holds(run, u)
        n_holds = int(hold[-1]) + 1
        longest = int(np.bincount(hold).max())
        # Else there are too few for the folds, or one is longer than a fold.
        if n_holds >= N_FOLDS and longest <= len(hold) / N_FOLDS:
            n_of_holds = max(n_holds // 3, N_FOLDS)
            of_holds = hold * n_of_holds // n_holds
            if of_holds[-1] < stretch[-1]:
                stretch = of_holds
    return stretch % N_FOLDS


def _holds(run: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Number of the value at which an input (n_intervals,) is held, (n_intervals,)."""
    is_new_run = np.r_[True, np.diff(run) != 0]
    changes = is_new_run | np.r_[True, np.diff(u) != 0]
    stays = np.r_[~changes[1:], True]
    return np.cumsum(is_new_run | (changes & stays)) - 1
