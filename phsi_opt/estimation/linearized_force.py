"""The missing-force problem linearised at a solution: means, variances and evidence.

At a solution the measurements are taken as linear in states and force, and the dynamics
as linear constraints. Force and noise are then Gaussian, so the marginal likelihood of
their sizes is known in closed form (Laplace's approximation), and one banded
factorisation gives it. How the sizes are improved follows MacKay's fixed-point updates
(Bayesian interpolation, 1992). The solution itself is found in `missing_force`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_diag, bmat, csc_matrix, diags

from phsi_opt.optimization.banded import Banded
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import time_order
from phsi_opt.transcription.force_prior import ForcePrior
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.sensors import SensorOutputs

Known = bool | np.ndarray  # whether the noise is known, of all states or of each

N_PROBES = 24  # random vectors by which a trace is estimated, at most
N_PROBED = 200_000  # values that all probes together look at, at least
FEWEST_PROBES = 2
LARGEST_CHANGE = 10.0  # factor by which a variance may move in one update
LEAST_DETERMINED = 1e-3  # directions: keeps the update of a force without effect finite


@dataclass(frozen=True, eq=False)
class Sizes:
    """How large noise and missing force are.

    Attributes:
        sigma: (n_states,) standard deviation of the noise of each state's sensor.
        prior: Of the force, with its size in every forced equation.
        least_noise: Below which ``sigma`` does not fall where it is estimated, of all
            states or (n_states,): what quantisation makes.
    """

    sigma: np.ndarray
    prior: ForcePrior
    least_noise: np.ndarray | float = 0.0

    def with_force(self, size: np.ndarray) -> "Sizes":
        """The same noise, and another size of the force, (n_forced,)."""
        return replace(self, prior=replace(self.prior, size=size))

    def change_from(self, other: "Sizes") -> float:
        """Largest change of the logarithm of a size."""
        of_noise = np.max(np.abs(np.log(self.sigma / other.sigma)))
        of_force = np.max(np.abs(np.log(self.prior.size / other.prior.size)))
        return float(max(of_noise, of_force))


@dataclass(frozen=True, eq=False)
class ForceSolution:
    """A solution of the missing-force program.

    Attributes:
        grid: Nodes, intervals and measurements.
        x: (n_nodes, n_states) states.
        w: (n_intervals, n_forced) force.
        jacobian: Of the defects in (x, w), sparse, in their own units.
        sensors: What the sensors show of the states, with its slope.
    """

    grid: Grid
    x: np.ndarray
    w: np.ndarray
    jacobian: csc_matrix
    sensors: SensorOutputs


@dataclass(frozen=True, eq=False)
class Determined:
    """Number of directions that the data determine well.

    Attributes:
        of_channels: (n_states,) that the states take of each channel's measurements.
        of_forces: (n_forced,) in which the data, not the prior, say what a force is.
    """

    of_channels: np.ndarray
    of_forces: np.ndarray


class LinearizedForce:
    """The missing-force problem linearised at a solution, for given sizes.

    The unknowns are the states (n_x), the force (n_w) and the multipliers of the
    dynamics; the force has its forced equations side by side, interval after interval.

    Attributes:
        n_x: Number of states at all nodes; ``n_w``: of values of the force;
            ``n_total``: of unknowns, with the multipliers.
        L: Whitener of the force: from the force to independent standard normals.
        seen_of: From a change of the states to the measurements over their noise.
        factor: Factors of the optimality system; ``factor.solve`` takes a right-hand
            side (n_total,) or several as columns.
        residual: (n_x,) measured minus shown, zero where nothing was measured.
        innovations: (n_w,) the whitened force.
    """

    def __init__(self, solution: ForceSolution, sizes: Sizes) -> None:
        self.grid = solution.grid
        self.sizes = sizes
        self.n_x = solution.x.size
        self.n_w = solution.w.size
        self.n_forced = len(sizes.prior.rows)
        self._whiteners = [
            sizes.prior.whitener(self.grid, k) for k in range(self.n_forced)
        ]
        self.L = self._whitener()
        self.weight = self._weight()
        self.seen_of = diags(self.weight) @ solution.sensors.jacobian
        self.n_total = self.n_x + self.n_w + solution.jacobian.shape[0]
        self.factor = self._factor(solution)
        self._take_step(solution)

    def _whitener(self) -> csc_matrix:
        """The whiteners of all forces; columns in the order of the force's values."""
        places = np.arange(self.n_w).reshape(-1, self.n_forced)
        force_after_force = places.T.ravel()
        whitener = block_diag(self._whiteners, format="csc")
        return whitener[:, np.argsort(force_after_force)]

    def _weight(self) -> np.ndarray:
        """One over the noise of every value, (n_x,); zero where none was measured."""
        sigma = np.tile(self.sizes.sigma, (self.grid.n_nodes, 1))
        return np.where(self.grid.measured, 1 / sigma, 0.0).ravel()

    def _factor(self, solution: ForceSolution) -> Banded:
        of_states = self.seen_of.T @ self.seen_of
        of_force = self.L.T @ self.L
        hessian = block_diag([of_states, of_force], format="csc")
        jacobian = solution.jacobian
        system = bmat([[hessian, jacobian.T], [jacobian, None]], format="coo")
        n_states = solution.x.shape[1]
        order = time_order(
            self.grid,
            ("node", n_states),
            ("interval", self.n_forced),
            ("interval", n_states),
        )
        return Banded(system, order)

    def _take_step(self, solution: ForceSolution) -> None:
        """Residuals and innovations at the optimum of the linearised problem.

        The solver need not have converged; one Newton step leads there.
        """
        shown = solution.sensors.values
        measured = self.grid.measured
        residual = np.where(measured, self.grid.y - shown, 0.0).ravel()
        force = solution.w.ravel()
        in_states = -self.seen_of.T @ (self.weight * residual)
        in_force = self.L.T @ (self.L @ force)
        gradient = np.r_[in_states, in_force]
        no_defects = np.zeros(solution.jacobian.shape[0])
        step = self.factor.solve(np.r_[-gradient, no_defects])
        state_step = step[: self.n_x]
        force_step = step[self.force_part]
        self.residual = residual - solution.sensors.jacobian @ state_step
        self.innovations = self.L @ (force + force_step)

    @property
    def force_part(self) -> slice:
        """Where the force stands among the unknowns."""
        return slice(self.n_x, self.n_x + self.n_w)

    def log_evidence(self) -> float:
        """log p(y | sizes), up to a constant of the point of linearisation."""
        of_noise = np.sum((self.weight * self.residual) ** 2)
        of_force = np.sum(self.innovations**2)
        misfit = of_noise + of_force
        log_det = self.factor.log_abs_det
        log_noise = np.sum(np.log(self.weight[self.weight > 0]))
        log_prior = sum(np.sum(np.log(L.diagonal())) for L in self._whiteners)
        return float(-misfit / 2 - log_det / 2 + log_noise + log_prior)

    def improved(self, known_noise: Known) -> Sizes:
        """MacKay's update of the noise and of the force's size.

        Each variance becomes the sum of squares over the number of directions that are
        left to it: of the noise those that the states do not take, of the force those
        that the data determine.

        Args:
            known_noise: Whether the noise stays as it is, of all states or of each.
        """
        determined = self._well_determined()
        sizes = self.sizes
        sigma = self._improved_noise(determined.of_channels, known_noise)
        lowest = sizes.sigma / LARGEST_CHANGE
        highest = sizes.sigma * LARGEST_CHANGE
        size = self._improved_force(determined.of_forces)
        clipped = np.clip(sigma, lowest, highest)
        return replace(sizes, sigma=clipped).with_force(size)

    def _improved_noise(self, determined: np.ndarray, known: Known) -> np.ndarray:
        sigma = self.sizes.sigma.copy()
        least = np.broadcast_to(self.sizes.least_noise, len(sigma))
        measured = self.grid.measured
        squares = self.residual.reshape(self.grid.y.shape) ** 2
        is_known = np.broadcast_to(known, len(sigma))
        for k in np.flatnonzero(measured.any(axis=0) & ~is_known):
            n_left = max(measured[:, k].sum() - determined[k], 1.0)
            variance = squares[:, k].sum() / n_left
            sigma[k] = max(np.sqrt(max(variance, TINY)), least[k])
        return sigma

    def _improved_force(self, determined: np.ndarray) -> np.ndarray:
        per_force = self.innovations.reshape(self.n_forced, -1)
        squares = np.array([np.sum(innovations**2) for innovations in per_force])
        ratio = squares / np.maximum(determined, LEAST_DETERMINED)
        change = np.sqrt(np.clip(ratio, 1 / LARGEST_CHANGE, LARGEST_CHANGE))
        return self.sizes.prior.size * change

    def _well_determined(self) -> Determined:
        """Traces by random signs (Hutchinson's estimator), from a fixed seed."""
        rng = np.random.default_rng(0)
        # The trace of a longer record needs fewer probes.
        n_probes = int(np.clip(N_PROBED // self.n_x, FEWEST_PROBES, N_PROBES))
        is_measured = self.weight > 0
        signs_y = rng.choice([-1.0, 1.0], (self.n_x, n_probes)) * is_measured[:, None]
        signs_w = rng.choice([-1.0, 1.0], (self.n_w, n_probes))
        right = np.zeros((self.n_total, 2 * n_probes))
        right[: self.n_x, :n_probes] = self.seen_of.T @ signs_y
        right[self.force_part, n_probes:] = self.L.T @ signs_w
        left = self.factor.solve(right)
        of_y = signs_y * (self.seen_of @ left[: self.n_x, :n_probes])
        of_w = signs_w * (self.L @ left[self.force_part, n_probes:])

        per_value = of_y.mean(axis=1).reshape(self.grid.y.shape)
        per_innovation = of_w.mean(axis=1).reshape(self.n_forced, -1)
        n_each = self.n_w / self.n_forced
        return Determined(per_value.sum(axis=0), n_each - per_innovation.sum(axis=1))
