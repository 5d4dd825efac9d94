"""The covariance of parameters from their information, which may lack directions."""

from collections.abc import Sequence

import numpy as np

from phsi_opt.errors import SolveError

# Information, per scaled parameter, that makes the matrix regular where the data say
# nothing.
RIDGE = 1e-10
# The same as a share of the largest information: beside less the others drown in its
# inverse's rounding.
ROUNDED_RIDGE = 1e-15
HELD = 1e12  # information, per scaled parameter, by which a parameter does not move
REGULAR = 1e-13  # share of the largest curvature that is added where a state has none


def regularized_inverse(
    information: np.ndarray, held: Sequence[int] = ()
) -> np.ndarray:
    """Covariance of scaled parameters: (information + ridge)^-1.

    Args:
        information: (n_theta, n_theta), symmetric. A direction without information may
            round below zero and counts as zero; the ridge holds it.
        held: places of parameters that do not move, such as those at a bound.

    Raises:
        SolveError: the information is not finite.
    """
    if not np.all(np.isfinite(information)):
        raise SolveError(
            "the model's slopes along its states are beyond all numbers, so that no "
            "parameter has a standard error; give parameters bounds, or start them "
            "nearer to the truth."
        )
    values, vectors = np.linalg.eigh(information)
    least = max(RIDGE, ROUNDED_RIDGE * float(np.max(values, initial=0.0)))
    ridge = np.full(len(information), least)
    ridge[list(held)] = HELD
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    regular = positive + np.diag(ridge)
    try:
        return np.linalg.inv(regular)
    except np.linalg.LinAlgError:  # it spans more digits than numbers have
        return np.linalg.pinv(regular, rcond=1e-15, hermitian=True)
