"""How certain a free run is: the covariance of the estimates carried to what it shows.

To first order along the run. Both the uncertainty of the parameters, with starting
states that follow the record, and that of the starting states count. The noise of a
single measurement is not in it.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import parameter_matrix
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model_error.linearization import linearized
from phsi_opt.model_error.marginal_likelihood import ReducedSystem
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import output_slopes, output_slopes_in_theta


def prediction_bands(
    record: Record,
    simulated: Sequence[np.ndarray],
    values: Mapping[str, Mapping[str, float]],
) -> tuple[np.ndarray, ...] | None:
    """Standard deviation of what a free run shows.

    Args:
        record: the fit and the measurements that its starting states follow.
        simulated: states of the run, one (n_samples, n_states) per trajectory.
        values: the free parameters of the run, by trajectory and name.

    Returns:
        One (n_samples, n_states) per trajectory, in the units of the states; None where
        it is not known.
    """
    fit = record.fit
    grid = record.grid
    is_known = np.isfinite(np.diag(fit.covariance))
    has_covariance = not fit.names or is_known.any()
    nodes = np.concatenate(simulated)
    # Of very many values they take longer than the fit, and are too narrow to be seen.
    if not has_covariance or nodes.size > 200_000:
        return None
    if not np.all(np.isfinite(nodes)) or not grid.measured.any():
        return None
    model = record.model
    unknown = Theta.of(model, record.trajectories)
    theta = np.zeros(len(unknown))
    theta[unknown.table] = parameter_matrix(model, values)
    point = point_at(model, grid, unknown, theta, nodes)
    scheme = MaximumLikelihood().integrator
    likelihood = LikelihoodValues(model, grid, scheme, point, unknown)
    z = point.scaled
    linear = linearized(likelihood, z, likelihood.at(z))
    system = ReducedSystem(linear, record.sigma)
    # What states follow parameters, and what is left open beside these.
    starts = grid.first[:, None] * model.n_states + np.arange(model.n_states)
    by_theta = system.following * point.x_scale[:, None]
    left_open = system.start_covariances(starts, grid.trajectory)
    left_open = left_open * np.outer(point.x_scale, point.x_scale)
    if model.sensor:
        of_runs = unknown.by_trajectory(theta)
        by_state = output_slopes(model, grid, nodes, of_runs).in_states
        direct = output_slopes_in_theta(unknown, grid, nodes, theta)
        by_theta = by_state @ by_theta + direct * point.theta_scale
        left_open = by_state @ left_open @ by_state.transpose(0, 2, 1)
    own_names = record.estimated_here(model)
    is_own = np.array([one.name in own_names for one in unknown.entries], dtype=bool)
    covariance = _parameter_covariance(
        fit, unknown, is_own, point.theta_scale, system.information
    )
    from_parameters = np.einsum("aij,jk,aik->ai", by_theta, covariance, by_theta)
    from_starts = np.einsum("aii->ai", left_open)
    # What is not independent tells as little about starting states as about parameters.
    share = fit.independent_share(fit.names)
    from_starts = from_starts / (share if np.isfinite(share) else 1.0)
    variance = from_parameters + from_starts
    return grid.split(np.sqrt(np.maximum(variance, 0.0)))


def _parameter_covariance(
    fit: Fit,
    unknown: Theta,
    is_own: np.ndarray,
    scale: np.ndarray,
    information: np.ndarray,
) -> np.ndarray:
    """Covariance of the scaled parameters along a record, (n_theta, n_theta).

    That of the fit; what is estimated from the record (``is_own``) follows it, given
    the other parameters.
    """
    is_known = np.isfinite(np.diag(fit.covariance))
    fitted = np.where(np.outer(is_known, is_known), fit.covariance, 0.0)
    shared = np.flatnonzero(~is_own)
    own = np.flatnonzero(is_own)
    place = [fit.names.index(unknown.names[i]) for i in shared]
    of_shared = fitted[np.ix_(place, place)] / np.outer(scale[shared], scale[shared])
    covariance = np.zeros((len(unknown), len(unknown)))
    following = np.eye(len(unknown))[:, shared]
    if len(own):
        conditional = np.linalg.pinv(information[np.ix_(own, own)], hermitian=True)
        following[own] = -conditional @ information[np.ix_(own, shared)]
        covariance[np.ix_(own, own)] = conditional
    return covariance + following @ of_shared @ following.T
