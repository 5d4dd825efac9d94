"""The small regression of a record's residuals on what a candidate leaves in them."""

from dataclasses import dataclass

import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_step import bounded_least_squares
from phsi_opt.screening.sensitivities import Sensitivities
from phsi_opt.statistics import TINY

# Share of the diagonal that is added to the correlations of traces: two that are equal
# to rounding still factorise.
CORRELATION_RIDGE = 1e-10
# A body at rest: friction that holds it may explain up to all of its defects.
REST_BOUNDS = (0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Regression:
    """Coefficients within their bounds, and what they explain.

    Attributes:
        coefficients: (k,); one where an effect without a coefficient is there as a
            whole.
        drop: fall of the misfit, in units of the noise variance.
        information: of the coefficients, (k, k).
    """

    coefficients: np.ndarray
    drop: float
    information: np.ndarray

    @property
    def covariance_diagonal(self) -> np.ndarray:
        """Variance of each coefficient for noise of variance one, (k,)."""
        covariance = np.linalg.pinv(self.information, hermitian=True)
        return np.maximum(np.diag(covariance), 0.0)


def bounds_of(model: Model, names: list[str]) -> list[tuple[float, float]]:
    """Lower and upper bound of each parameter."""
    found = []
    for name in names:
        parameter = model.entries[name].parameter
        found.append((parameter.lower, parameter.upper))
    return found


def regression(sensitivities: Sensitivities, trace: np.ndarray) -> Regression:
    """Regress a record's residual on a trial's trace (n_values, k) within bounds."""
    trial = sensitivities.trial
    information = trace.T @ trace
    right = trace.T @ sensitivities.linearized.residual
    if not trial.linear:
        drop = float(2 * right[0] - information[0, 0])
        return Regression(np.ones(1), drop, information)
    size = np.sqrt(np.maximum(np.diag(information), TINY))
    correlation = information / np.outer(size, size)
    factor = np.linalg.cholesky(correlation + CORRELATION_RIDGE * np.eye(len(size)))
    n_rest = trace.shape[1] - len(trial.linear)
    bounds = bounds_of(trial.model, trial.linear) + [REST_BOUNDS] * n_rest
    lower, upper = np.array(bounds).T * size
    z = np.linalg.solve(factor, right / size)
    scaled = np.linalg.solve(factor.T, z)
    if np.any(scaled < lower) or np.any(scaled > upper):
        upper = np.maximum(upper, lower + TINY)
        scaled = bounded_least_squares(factor.T, z, lower, upper)
    c = scaled / size
    return Regression(c, float(2 * c @ right - c @ information @ c), information)
