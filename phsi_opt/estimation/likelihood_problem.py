"""A likelihood before its first solve: the task, the loss, and what noise is known.

What would make the problem unsolvable is refused here, before any time is spent.
"""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.data.noise import initial_noise
from phsi_opt.data.resolution import quantisation_noise
from phsi_opt.errors import DataError
from phsi_opt.estimation.missing_force import ForceEstimate, smoothed
from phsi_opt.estimation.problem import Task
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Noise per state before the first solve.

    Attributes:
        sigma: (n_states,) standard deviations.
        is_known: (n_states,) whether it was declared; the others are estimated.
        least: (n_states,) below which none is estimated: that of quantisation.
    """

    sigma: np.ndarray
    is_known: np.ndarray
    least: np.ndarray

    @classmethod
    def known(cls, sigma: np.ndarray) -> "NoiseLevels":
        """Noise that is known of every state."""
        return cls(sigma, np.ones(len(sigma), dtype=bool), np.zeros(len(sigma)))

    def with_estimates(self, sigma: np.ndarray) -> "NoiseLevels":
        """``sigma`` in place of what was not declared."""
        estimated = np.maximum(sigma, self.least)
        return replace(self, sigma=np.where(self.is_known, self.sigma, estimated))


@dataclass(frozen=True, eq=False)
class LikelihoodProblem:
    """The likelihood of a task.

    Attributes:
        task: what was asked for.
        loss: the likelihood.
        noise: what is known of the noise, and guesses of the rest.
    """

    task: Task
    loss: MaximumLikelihood
    noise: NoiseLevels

    @classmethod
    def of(cls, task: Task, loss: MaximumLikelihood) -> "LikelihoodProblem":
        """With the declared noise, and a guess from the data where none is declared.

        Raises:
            DataError: if a sensor's state is not measured, the values are too few, the
                declared noise is none, or nothing moves.
        """
        _check_sensors(task)
        _check_number_of_values(task)
        declared = _declared_noise(task, loss)
        sigma = initial_noise(task.data, declared)
        least = quantisation_noise(task.data)
        return cls(task, loss, NoiseLevels(sigma, np.isfinite(declared), least))

    def with_noise_of(self, sigma: np.ndarray) -> "LikelihoodProblem":
        """``sigma`` (n_states,) in place of the noise that was not declared."""
        return replace(self, noise=self.noise.with_estimates(sigma))

    def smooth_states(
        self,
        model: Model,
        grid: Grid,
        theta: np.ndarray | None = None,
        *,
        rounds: int,
    ) -> ForceEstimate:
        """States and missing force at parameters theta (n_theta,); see `smoothed`.

        Raises:
            SolveError: if no states are found.
        """
        return smoothed(
            model,
            grid,
            self.noise.sigma,
            self.loss.integrator,
            self.noise.is_known,
            theta,
            rounds=rounds,
            least_noise=self.noise.least,
        )


def _check_sensors(task: Task) -> None:
    for name in task.model.sensor:
        if name not in task.data.measured:
            raise DataError(
                f"the model has a sensor of {name!r}, but {name!r} was never measured; "
                "leave one of them out."
            )


def _check_number_of_values(task: Task) -> None:
    data = task.data
    n_values = len(task.grid.channel)
    n_theta = len(Theta.of(task.model, task.runs))
    n_unknown = n_theta + data.n_trajectories * task.model.n_states
    if n_values <= n_unknown:
        raise DataError(
            f"{n_values} measured values are too few for {n_unknown} unknowns "
            f"({n_theta} parameters and the starting states of {data.n_trajectories} "
            "trajectories); measure more, or fix parameters."
        )


def _declared_noise(task: Task, loss: MaximumLikelihood) -> np.ndarray:
    """Noise per state as the loss or the measurements declare it, (n_states,).

    NaN where it is to be estimated. A loss that declares noise declares that of every
    measured state.
    """
    data = task.data
    noise = loss.noise if loss.noise is not None else data.noise or {}
    for name in data.measured:
        is_missing = loss.noise is not None and name not in noise
        is_wrong = name in noise and not (np.isfinite(noise[name]) and noise[name] > 0)
        if is_missing or is_wrong:
            raise DataError(
                f"noise of the measured state {name!r} is {noise.get(name)!r}; "
                "expected a number above zero."
            )
    return np.array([noise.get(name, np.nan) for name in data.states])
