"""The point from which a likelihood is maximised: values, states, noise, and how.

How such points are found is the business of `likelihood_start`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.model.model import Model


@dataclass(frozen=True, eq=False)
class StartingPoint:
    """Where the solver of a likelihood begins.

    Attributes:
        model: with the guesses of its parameters resolved.
        theta: (n_theta,) values in the order of `Theta`.
        states: (n_samples, n_states) per trajectory, at the samples.
        sigma: (n_states,) noise.
        notes: sentences for the warnings of the fit.
        steps: intervals in every gap between samples, (n_samples - 1,) per trajectory;
            empty: one, or what the loss says.
        held: parameters that a solve left at their bounds.
        is_optimum: whether it is one of this very model, with other steps or
            measurements; then its states need not be found anew.
    """

    model: Model
    theta: np.ndarray
    states: tuple[np.ndarray, ...]
    sigma: np.ndarray
    notes: tuple[str, ...] = ()
    steps: tuple[np.ndarray, ...] = ()
    held: tuple[str, ...] = ()
    is_optimum: bool = False

    @classmethod
    def at(
        cls, estimate: LikelihoodEstimate, steps: Sequence[np.ndarray]
    ) -> "StartingPoint":
        """At an estimate, with ``steps`` of its own."""
        return cls(
            model=estimate.model,
            theta=estimate.theta,
            states=estimate.states,
            sigma=estimate.sigma,
            steps=tuple(steps),
            held=estimate.solution.outcome.at_bounds,
        )
