"""What a linearised record says of the forces that act beside its model.

States and forces are Gaussian there, given the parameters: their mean, covariance and
evidence follow from one banded factorisation.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.marginal_likelihood import Eliminated, MarginalLikelihood
from phsi_opt.model_error.processes import Process, Whitener
from phsi_opt.statistics import TINY

# Numbers that are held at once while the linearised problem is solved: 240 MB.
MOST_SOLVED = 3e7


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """The forces given the measurements and the parameters.

    Attributes:
        likelihood: of the linearised record; no parameter moves in it.
        disturbances: with their sizes, forces among them.
    """

    likelihood: MarginalLikelihood
    disturbances: Disturbances

    @cached_property
    def _eliminated(self) -> Eliminated:
        return self.likelihood.eliminated(self.disturbances)

    @property
    def n_unknowns(self) -> int:
        """Number of states, forces and multipliers, which are solved for."""
        return len(self._eliminated.right)

    @property
    def log_evidence(self) -> float:
        """Logarithm of the marginal likelihood, up to a constant."""
        return self.likelihood.at(self.disturbances).log_evidence

    @property
    def mean(self) -> np.ndarray:
        """Of the forces, (n_intervals, n_forced)."""
        solved = self._eliminated.solved[:, -1]
        return np.array([solved[places] for places in self._places]).T

    @cached_property
    def deviation(self) -> np.ndarray:
        """Standard deviation of the forces, (n_intervals, n_forced).

        It changes slowly, is solved for at 16 to 400 intervals, as many as fit in
        memory, and interpolated between.
        """
        that_fit = MOST_SOLVED / self.n_unknowns
        most = int(np.clip(that_fit, 16, 400))
        n_intervals = self.likelihood.problem.grid.n_intervals
        evenly = np.linspace(0, n_intervals - 1, min(most, n_intervals))
        chosen = np.unique(evenly.astype(int))
        columns = np.arange(len(chosen))
        deviations = []
        for places in self._places:
            units = np.zeros((self.n_unknowns, len(chosen)), order="F")
            units[places[chosen], columns] = 1.0
            variance = self._eliminated.factors.solve(units)[places[chosen], columns]
            exact = np.sqrt(np.maximum(variance, 0.0))
            deviations.append(np.interp(np.arange(n_intervals), chosen, exact))
        return np.array(deviations).T

    @property
    def times_noise(self) -> np.ndarray:
        """Size of the forces over their typical (median) deviation, (n_forced,)."""
        size = np.sqrt(np.mean(self.mean**2, axis=0))
        typical = np.median(self.deviation, axis=0)
        return np.asarray(size / np.maximum(typical, TINY))

    def error_draws(self, n_draws: int = 24, seed: int = 0) -> np.ndarray:
        """Random errors of the forces, (n_intervals, n_forced, n_draws).

        Solutions for random noise and random innovations, whose covariance is that of
        the forces given the measurements.
        """
        rng = np.random.default_rng(seed)
        likelihood = self.likelihood
        weights = np.sqrt(self._eliminated.weights)
        noise = rng.normal(size=(len(weights), n_draws))
        right = np.zeros((self.n_unknowns, n_draws), order="F")
        of_noise = likelihood.shown_transposed @ (weights[:, None] * noise)
        right[: likelihood.n_unknowns] = of_noise
        for force, places, whitener in self._forces():
            innovations = rng.normal(size=(len(places), n_draws))
            right[places] += whitener.transposed(innovations) / force.size
        errors = self._eliminated.factors.solve(right)
        return np.stack([errors[places] for places in self._places], axis=1)

    def shown(self, number: int, forces: np.ndarray) -> np.ndarray:
        """What the mean would show of forces in one equation, (n_intervals, k).

        It is less than they are by what noise and prior hide::

            w_shown = w - C P^-1 w

        with the forces' covariance P before and C after the measurements.

        Args:
            number: of the equation among those with a force.
            forces: (n_intervals, k).
        """
        force, places, whitener = self._forces()[number]
        n_forces = forces.shape[1]
        n_parts = 1 + int(self.n_unknowns * n_forces / MOST_SOLVED)
        shown = np.empty_like(forces)
        for part in np.array_split(np.arange(n_forces), n_parts):
            right = np.zeros((self.n_unknowns, len(part)), order="F")
            pulled = whitener.transposed(whitener.whitened(forces[:, part]))
            right[places] = pulled / force.size**2
            hidden = self._eliminated.factors.solve(right)[places]
            shown[:, part] = forces[:, part] - hidden
        return shown

    @property
    def _places(self) -> list[np.ndarray]:
        """Places of every force's values among all that is solved for."""
        n_forced = len(self.disturbances.forces)
        places = self.likelihood.places_of_processes()[:n_forced]
        return [first + np.arange(n) for first, n in places]

    def _forces(self) -> list[tuple[Process, np.ndarray, Whitener]]:
        """Every force with its places and the whitener of its prior."""
        whiteners = self._eliminated.whiteners
        forces = self.disturbances.forces
        return list(zip(forces, self._places, whiteners, strict=False))
