"""Ridge regression whose weight is chosen by the prediction of what was left out."""

from dataclasses import dataclass

import numpy as np

N_FOLDS = 5
# Weights that are tried, in units of the mean sum of squares of a ridged column.
RIDGE_WEIGHTS = 10.0 ** np.arange(-9, 1)
# Share of the largest singular value below which a direction is left alone.
SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class _Squares:
    """``|d + A z|^2 = z' normal z + 2 z' right + constant``."""

    normal: np.ndarray
    right: np.ndarray
    constant: float

    def at(self, z: np.ndarray) -> float:
        """The sum of squares at z."""
        value = z @ self.normal @ z + 2 * z @ self.right + self.constant
        return float(value)


def cross_validated(
    columns: np.ndarray, d: np.ndarray, folds: np.ndarray, ridged: np.ndarray
) -> np.ndarray:
    """Least squares with a ridge, by cross-validation.

    The z, (n_columns,), that minimises::

        |d + columns z|^2 + weight |z_ridged|^2

    The weight is the largest within a standard error of the one that predicts the folds
    best when they are left out: the smoothest force whose prediction is not
    significantly worse.

    Args:
        columns: (n_intervals, n_equations, n_columns).
        d: (n_intervals, n_equations).
        folds: (n_intervals,), numbers below `N_FOLDS`.
        ridged: (n_columns,), whether the weight acts on the column.
    """
    parts = []
    for fold in range(N_FOLDS):
        A = columns[folds == fold].reshape(-1, columns.shape[2])
        b = d[folds == fold].ravel()
        parts.append(_Squares(A.T @ A, A.T @ b, b @ b))
    normal = sum(part.normal for part in parts)
    right = sum(part.right for part in parts)
    size = float(np.mean(np.diag(normal)[ridged]))

    def solved(weight: float, left_out: _Squares | None = None) -> np.ndarray:
        N = normal if left_out is None else normal - left_out.normal
        r = right if left_out is None else right - left_out.right
        ridge = np.diag(weight * size * ridged)
        return np.linalg.lstsq(N + ridge, -r, rcond=SINGULAR)[0]

    errors = {}
    for weight in RIDGE_WEIGHTS:
        errors[weight] = np.array([part.at(solved(weight, part)) for part in parts])
    return solved(_largest_within_an_error(errors))


def _largest_within_an_error(errors: dict[float, np.ndarray]) -> float:
    """The largest weight whose errors exceed the least by at most a standard error.

    Args:
        errors: by weight, those of the folds, (N_FOLDS,).
    """
    best = min(errors, key=lambda weight: float(errors[weight].sum()))
    largest = best
    for weight in errors:
        more = errors[weight] - errors[best]
        standard_error = more.std(ddof=1) / np.sqrt(N_FOLDS)
        if weight > largest and more.mean() <= standard_error:
            largest = weight
    return largest
