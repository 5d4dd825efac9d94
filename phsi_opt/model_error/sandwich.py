"""Covariance of plain estimates when more than white noise disturbed the record.

Estimates that count every residual as independent noise are still good ones when it is
not; their covariance is another one. To first order an estimate moves with every
error in what was shown and with every force in the dynamics; the covariance of these,
under the disturbances that the record itself tells, gives that of the estimate (White,
Econometrica 50, 1982, with the covariance of the scores from a model of them).
"""

import numpy as np

from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import (
    Response,
    whitener_of_force,
    whitener_of_sensor,
)


def covariance_under(
    problem: Linearization, response: Response, disturbances: Disturbances
) -> np.ndarray:
    """Covariance of the scaled plain estimate, (n_theta, n_theta)."""
    run = problem.grid.trajectory[problem.node]
    sigma = disturbances.sigma[run, problem.channel]
    of_noise = response.to_values * sigma
    covariance = of_noise @ of_noise.T
    for force in disturbances.forces:
        weights = _weights_of_force(problem, response, force.place)
        factor = whitener_of_force(problem, force).factor_of(weights)
        covariance = covariance + force.size**2 * (factor.T @ factor)
    for sensor in disturbances.sensors:
        weights = response.to_values[:, problem.values_of(sensor.place)].T
        factor = whitener_of_sensor(problem, sensor).factor_of(weights)
        covariance = covariance + sensor.size**2 * (factor.T @ factor)
    for function in disturbances.functions:
        weights = _weights_of_force(problem, response, function.equation)
        values = problem.function_values[function.state]
        answer = function.size * (values.T @ weights)
        covariance = covariance + answer.T @ answer
    return covariance


def _weights_of_force(
    problem: Linearization, response: Response, equation: int
) -> np.ndarray:
    """Answer to a force of one in each interval, (n_intervals, n_theta)."""
    weights: np.ndarray = problem.dynamics_of_force(equation).T @ response.to_dynamics.T
    return weights
