"""How well a record can be expected to tell each parameter: its Fisher information."""

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.maximum_likelihood import crude_start
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.model.model import Model
from phsi_opt.model.structure import with_kinds_of_units
from phsi_opt.model_error.joint_estimate import JointProblem
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import white_system
from phsi_opt.optimization.bounded_step import RIDGE, regularized_inverse
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.transcription.grid import checked_data
from phsi_opt.transcription.losses import MaximumLikelihood


def expected_errors(model: Model, data: Measurements) -> dict[str, tuple[float, float]]:
    """By name a value, and the standard error to be expected there.

    From the Fisher information along the motion three steps of Gauss and Newton away
    from the measured states, with the noise that is left there, or the scatter of
    neighbouring samples if that is less. Of a parameter of each trajectory the mean,
    and the largest.

    Raises:
        DataError: if model and data do not match, or the record is too short.
    """
    model = with_kinds_of_units(model, data.units)
    aligned = checked_data(model, data)
    task = Task(model, aligned.for_model(model), {}, None, SolverSettings())
    problem = LikelihoodProblem.of(task, MaximumLikelihood())
    start = crude_start(problem)
    values = problem.values_at(start)
    linearizer = Linearizer(values)
    nearby = JointProblem.white(linearizer, start.sigma).optimum(values.point.scaled, 3)
    z = nearby.point.z
    linear = linearizer.at(z)
    iteration = NoiseIteration(
        values.grid, problem.noise, len(values.unknown), huber=None, is_penalized=False
    )
    standardized = linear.residual / start.sigma[values.grid.channel]
    residual = standardized * np.sqrt(2 / len(standardized))
    left = iteration.updated(start.sigma, residual)
    system = white_system(linear, np.minimum(start.sigma, left))
    covariance = regularized_inverse(system.information)
    variances = np.diag(covariance).copy()
    variances[variances > 0.01 / RIDGE] = np.inf  # only the ridge holds it
    errors = np.sqrt(variances) * values.point.theta_scale
    unknown = values.unknown
    largest = np.max(errors[unknown.table], axis=1, initial=0.0)
    means = unknown.means(values.point.unscaled(z)["theta"]).tolist()
    return dict(zip(model.free, zip(means, largest.tolist(), strict=True), strict=True))
