"""A covariance, and how well it is known."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Spread:
    """A covariance of the scaled parameters, and how well it is known.

    Attributes:
        covariance: (n_theta, n_theta).
        freedom: (n_theta,) degrees of freedom of the variances.
    """

    covariance: np.ndarray
    freedom: np.ndarray
