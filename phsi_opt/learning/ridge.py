"""Ridge regression whose weight is chosen by the prediction of what was left out."""

from collections.abc import Iterator

import numpy as np

from phsi_opt.force_analysis.cross_validation import N_FOLDS, normal_equations

# Weights that are tried, in units of the mean sum of squares of a ridged column.
RIDGE_WEIGHTS = np.logspace(-10, 0, num=11)
# Share of the largest singular value below which a direction is left alone.
SINGULAR = 1e-12


def solutions(
    normal: np.ndarray, ridge: np.ndarray, weights: np.ndarray = RIDGE_WEIGHTS
) -> Iterator[np.ndarray]:
    """Coefficients (k,) of a regression for each weight of its ridge, (n_weights,).

    By its `normal_equations` and the ridge (k, k).
    """
    for weight in weights:
        regularized = normal[:, :-1] + weight * ridge
        yield np.linalg.lstsq(regularized, normal[:, -1], rcond=SINGULAR)[0]


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
        of_fold = columns[folds == fold].reshape(-1, columns.shape[2])
        parts.append((of_fold, -d[folds == fold].ravel()))
    normals = [normal_equations(*part) for part in parts]
    normal = sum(normals[1:], normals[0])
    ridge = np.diag(ridged * np.mean(np.diag(normal)[ridged]))
    errors = np.zeros((len(RIDGE_WEIGHTS), N_FOLDS))
    for fold, (of_fold, target) in enumerate(parts):
        of_others = normal - normals[fold]
        found = solutions(of_others, ridge)
        for place, z in enumerate(found):
            errors[place, fold] = np.sum((target - of_fold @ z) ** 2)
    more = errors - errors[np.argmin(errors.sum(axis=1))]
    standard_error = more.std(axis=1, ddof=1) / np.sqrt(N_FOLDS)
    good = np.flatnonzero(more.mean(axis=1) <= standard_error)
    return next(solutions(normal, ridge, RIDGE_WEIGHTS[good[-1:]]))
