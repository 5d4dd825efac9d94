"""The missing force of a fit along measurements, searched from more than one size.

`missing_force` finds force and noise together by their marginal likelihood. That search
is local: begun too low, it can end with everything called noise. And no force explains
a sensor that contradicts another one, which would count as noise as well. Where the
noise of a channel comes out far beyond what neighbouring samples scatter, the search
is begun again from a larger force, and at last with the noise taken from the scatter.
"""

from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise
from phsi_opt.data.resolution import quantisation_noise
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import parameter_matrix, parameters_of
from phsi_opt.estimation.missing_force import ForceEstimate, smoothed
from phsi_opt.estimation.model_error_table import lasting_noise
from phsi_opt.transcription.grid import Grid

# Estimated noise over the scatter of neighbouring samples from which a sensor is
# doubted: it contradicts another one, which no force explains.
DOUBTFUL_NOISE = 1.5
# Correlation time of a sensor's noise, in sampling intervals, up to which it is noise:
# neighbours with a correlation of 0.7 have 2.8. What lasts longer may be an effect.
BRIEF_NOISE = 5.0

# Factor on the size of the rates along the estimated states: from a force so large the
# second search comes down.
SIZE_OF_SECOND_SEARCH = 10.0
# Least noise over what neighbouring samples scatter: a force in the equation of a
# measured position can go through every sample, and the noise would come out as 1e-14.
# Not more, as steps that are coarse beside the motion scatter by its curvature.
LEAST_NOISE_BESIDE_SCATTER = 0.01


def missing_force_of(fit: Fit, data: Measurements, grid: Grid) -> ForceEstimate:
    """The force that a fitted model lacks along measurements, with states and noise.

    Args:
        fit: the fitted model.
        data: measurements with states and inputs in the model's order.
        grid: the same, laid out with one interval between neighbouring samples.

    Returns:
        States (n_nodes, n_states), force (n_intervals, n_forced), noise per state.

    Raises:
        SolveError: no states were found beside which a force explains the data.
    """
    given = np.array([(data.noise or {}).get(name, np.nan) for name in data.states])
    is_given = np.isfinite(given)
    model = fit.model.frozen()
    theta = None
    if fit.by_trajectory:
        model = fit.model
        theta = parameter_matrix(model, parameters_of(fit, data))
    guess = initial_noise(data, given)
    scatter = np.where(is_given, given, initial_noise(data))
    least = np.maximum(quantisation_noise(data), LEAST_NOISE_BESIDE_SCATTER * scatter)
    rows = fit.model_error_rows
    lasting = lasting_noise(rows, model.states, longest_noise(grid))
    sensors = tuple(error for error in lasting if not is_given[error.place])
    search = partial(
        smoothed,
        model,
        grid,
        theta=theta,
        known_noise=is_given,
        sensors=sensors,
        least_noise=least,
    )
    estimate = search(guess)
    measured = grid.measured_states

    def is_doubtful(found: ForceEstimate) -> bool:
        return bool(np.any(measured & (found.white > DOUBTFUL_NOISE * scatter)))

    if is_doubtful(estimate):
        sizes = SIZE_OF_SECOND_SEARCH * rate_size(estimate)
        larger = tuple(
            replace(force, size=float(size))
            for force, size in zip(estimate.disturbances.forces, sizes, strict=True)
        )
        with suppress(SolveError):
            second = search(scatter, forces=larger)
            estimate = max(estimate, second, key=lambda found: found.log_evidence)
    contradiction_is_possible = measured.sum() > 1
    if contradiction_is_possible and is_doubtful(estimate):
        with suppress(SolveError):
            return smoothed(model, grid, scatter, theta, known_noise=True)
    return estimate


def longest_noise(grid: Grid) -> float:
    """Correlation time up to which an error of a sensor is noise."""
    return BRIEF_NOISE * float(np.median(grid.h))


def rate_size(estimate: ForceEstimate) -> np.ndarray:
    """Root mean square rate of forced equations, (n_forced,); at least the prior's."""
    rates = estimate.grid.rates(estimate.x)
    size = np.sqrt(np.mean(rates**2, axis=0))
    return np.maximum(size[list(estimate.rows)], estimate.size)
