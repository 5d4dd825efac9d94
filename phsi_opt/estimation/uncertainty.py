"""Covariances of the estimates: what the data say about each parameter.

By `MaximumLikelihood` the covariance is the inverse of the information; by `PHSILoss`,
whose residuals are not independent, it is a sandwich. A parameter at a bound, and one
on which the data are silent (`identifiability`), gets NaN: no number is given that is
not trusted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from phsi_opt.estimation.identifiability import (
    NOTHING_SILENT,
    SilentDirections,
    silent_directions,
)
from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_step import RIDGE
from phsi_opt.transcription.defects import defect_slopes
from phsi_opt.transcription.grid import Grid


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is known about the estimates.

    Attributes:
        covariance: (n_theta, n_theta); NaN where it is not known.
        warnings: A sentence per direction that cannot be identified, or why nothing is
            known.
        silent: The directions that cannot be identified.
    """

    covariance: np.ndarray
    warnings: tuple[str, ...] = ()
    silent: SilentDirections = NOTHING_SILENT


def unknown(n_theta: int, reason: str) -> Uncertainty:
    """No standard error is given, and why."""
    return Uncertainty(np.full((n_theta, n_theta), np.nan), (reason,))


def of_covariance(
    names: Sequence[str],
    theta: np.ndarray,
    scale: np.ndarray,
    scaled: np.ndarray,
    at_bounds: tuple[str, ...],
    known: SilentDirections = NOTHING_SILENT,
    told: np.ndarray | None = None,
) -> Uncertainty:
    """A covariance of scaled parameters, without those of which nothing is known.

    Args:
        names: Of the parameters, in the order of theta.
        theta: (n_theta,) estimates.
        scale: (n_theta,) size of each.
        scaled: (n_theta, n_theta) covariance of theta over scale.
        at_bounds: Names of the parameters that ended at a bound.
        known: Directions that are known to be silent, besides those of the covariance.
        told: (n_theta, n_theta) covariance that says which directions are silent; None:
            ``scaled``.
    """
    held = [i for i, name in enumerate(names) if name in at_bounds]
    held += known.parameters
    told = scaled if told is None else told
    found = silent_directions(names, theta / scale, told, held)
    silent = SilentDirections(
        sentences=(*known.sentences, *found.sentences),
        parameters=tuple(sorted({*known.parameters, *found.parameters})),
        pinned=tuple(sorted({*known.pinned, *found.pinned})),
    )
    covariance = scaled * np.outer(scale, scale)
    not_known = [*held, *silent.parameters]
    covariance[not_known, :] = np.nan
    covariance[:, not_known] = np.nan
    return Uncertainty(covariance, silent.sentences, silent)


def of_defects(
    model: Model,
    grid: Grid,
    scheme: str,
    theta: np.ndarray,
    scale: np.ndarray,
    at_bounds: tuple[str, ...],
    d: np.ndarray | None = None,
) -> Uncertainty:
    """Sandwich covariance of the PHSI loss.

    Neighbouring defects share a noisy sample, so they are not independent. To first
    order in the noise e of the samples the gradient of the loss is::

        sum_n G_n e_n

    where G_n gathers what the two defects at the sample n make of its noise; so the
    covariance of the gradient is sum_n G_n Sigma G_n'. Sigma, a variance per state,
    comes from the sizes of the defects. The bias that noisy states cause is not in it.

    Args:
        model: The fitted model.
        grid: The intervals whose two ends are measured.
        scheme: Of the defects, such as "srk4".
        theta: (n_free,) estimates.
        scale: (n_free,) size of each parameter.
        at_bounds: Names of the parameters that ended at a bound.
        d: (n_intervals, n_states) defects there, where they are not the model's alone.
    """
    n_theta = len(theta)
    y = np.nan_to_num(grid.y)
    n = model.n_states
    own_d, slopes = defect_slopes(model, grid, scheme, y, theta)
    at_begin, at_end = slopes[:, :, :n], slopes[:, :, n : 2 * n]
    jacobian = slopes[:, :, 2 * n :] * scale

    gathered = np.zeros((grid.n_nodes, n, n_theta))
    np.add.at(gathered, grid.begin, np.einsum("ikj,ikp->ijp", at_begin, jacobian))
    np.add.at(gathered, grid.begin + 1, np.einsum("ikj,ikp->ijp", at_end, jacobian))

    noise_to_square = np.mean(at_begin**2, axis=0) + np.mean(at_end**2, axis=0)
    squares = np.mean((own_d if d is None else d) ** 2, axis=0)
    variance, _ = nnls(noise_to_square, squares)

    weighted = gathered * np.sqrt(variance)[None, :, None]
    weighted = weighted.reshape(-1, n_theta)
    of_gradient = weighted.T @ weighted
    by_defect = jacobian.reshape(-1, n_theta)
    information = by_defect.T @ by_defect
    mean_information = np.trace(information) / max(n_theta, 1)
    ridge = RIDGE * mean_information * np.eye(n_theta)
    # A pseudo-inverse, for data from which nothing follows: states that are all zero.
    bread = np.linalg.pinv(information + ridge, hermitian=True)
    return of_covariance(
        model.free,
        theta,
        scale,
        bread @ of_gradient @ bread,
        at_bounds,
        told=bread * mean_information,
    )
