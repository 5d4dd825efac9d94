"""TODO."""

from collections.abc import Mapping, Sequence

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.trajectory_parameters import parameter_matrix
from phsi_opt.initialization.scaling import point_at
from phsi_opt.optimization.ipopt import Solver
from phsi_opt.transcription.elimination import ReducedSystem
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import output_slopes, output_slopes_in_theta

LONGEST = 200_000  # values in a record up to which bands are worked out


def bands(
    fit: Fit,
    data: Measurements,
    sigma: np.ndarray,
    simulated: Sequence[np.ndarray],
    values: Mapping[str, Mapping[str, float]],
) -> tuple[np.ndarray, ...] | None:
    """Standard deviation of what a free run shows, (n_samples, n_states) per
    trajectory; None where it is not known.

    Both the uncertainty of the parameters, with starting states that follow the record,
    and that of the starting states count, to first order along the run. The noise of a
    single measurement is not in it.
    """
    known = np.isfinite(np.diag(fit.covariance))
    runs = tuple(run.name for run in data.trajectories)
    unknown = Theta.of(fit.model, runs)
    if not known.any() or sum(x.size for x in simulated) > LONGEST:
        return None
    grid, nodes = grid_of(data), np.concatenate(simulated)
    if not np.all(np.isfinite(nodes)) or not grid.measured.any():
        return None
    theta = np.zeros(len(unknown))
    theta[unknown.table] = parameter_matrix(fit.model, values)
    point = point_at(fit.model, grid, unknown, theta, nodes)
    program = MaximumLikelihood().program(fit.model, grid, point, {}, sigma, unknown)
    kkt = Solver(program).kkt(program.start, sigma)
    block, x = program.variables["theta"], program.variables["x"]
    information = kkt.hessian * (int(grid.measured.sum()) / 2)
    reduced = ReducedSystem(
        grid, fit.model.n_states, information, kkt.jacobian, block.slice, x.slice
    )
    covariance = _covariance(fit, unknown, point.theta_scale, reduced.information)
    starts = grid.first[:, None] * fit.model.n_states + np.arange(fit.model.n_states)
    following, left = (
        reduced.following,
        reduced.start_covariances(starts, grid.trajectory),
    )
    following, left = (
        following * point.x_scale[:, None],
        left * np.outer(point.x_scale, point.x_scale),
    )
    if fit.model.sensor:
        by_x = output_slopes(
            fit.model, grid, nodes, unknown.by_trajectory(theta)
        ).in_states
        following = (
            by_x @ following
            + output_slopes_in_theta(unknown, grid, nodes, theta) * point.theta_scale
        )
        left = by_x @ left @ by_x.transpose(0, 2, 1)
    variance = np.einsum(
        "aij,jk,aik->ai", following, covariance, following
    ) + np.einsum("aii->ai", left)
    deviation = np.sqrt(np.maximum(variance, 0.0))
    return grid.split(deviation)


def _covariance(
    fit: Fit, unknown: Theta, scale: np.ndarray, information: np.ndarray
) -> np.ndarray:
    """Covariance of the scaled parameters: that of the fit; what a trajectory has of
    its own follows its record.
    """
    known = np.isfinite(np.diag(fit.covariance))
    fitted = np.where(np.outer(known, known), fit.covariance, 0.0)
    old = [i for i, name in enumerate(unknown.names) if name in fit.names]
    new = [i for i, name in enumerate(unknown.names) if name not in fit.names]
    at = [fit.names.index(unknown.names[i]) for i in old]
    covariance = np.zeros((len(unknown), len(unknown)))
    covariance[np.ix_(old, old)] = fitted[np.ix_(at, at)] / np.outer(
        scale[old], scale[old]
    )
    if new:
        own = np.linalg.pinv(information[np.ix_(new, new)], hermitian=True)
        follow = -own @ information[np.ix_(new, old)]
        covariance[np.ix_(new, old)] = follow @ covariance[np.ix_(old, old)]
        covariance[np.ix_(old, new)] = covariance[np.ix_(new, old)].T
        covariance[np.ix_(new, new)] = (
            own + follow @ covariance[np.ix_(old, old)] @ follow.T
        )
    return covariance
