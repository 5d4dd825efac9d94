"""The missing force: what a model lacks, as an unknown function of time.

A first-order process in every equation that can lack a force: smooth enough to tell
force from noise, and rough enough for a friction that jumps. States and force are found
together (`model_error.joint_estimate`); how large the force is, and how large the
noise, is chosen by marginal likelihood at the linearised solution. Both take turns
until the sizes settle.
"""

from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit, lasting_noise, parameters_of
from phsi_opt.estimation.free_runs import parameter_matrix
from phsi_opt.estimation.noise_estimation import NoiseLevels
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.initialization.scaling import first_point
from phsi_opt.model.model import Model
from phsi_opt.model.structure import forced_rows
from phsi_opt.model_error.ascent import SETTLED_EVIDENCE, climbed
from phsi_opt.model_error.disturbances import Coordinates, Disturbances, Process
from phsi_opt.model_error.joint_estimate import (
    NEARLY_HELD,
    JointEstimate,
    JointProblem,
)
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import ForcePosterior
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import SCHEME
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Point, Theta

Forces = tuple[Process, ...]

NO_PARAMETERS = np.zeros(0, dtype=int)  # that are free to move
ROUNDER = (4.0, 16.0, 64.0)  # factors on the width of corners that are too sharp


@dataclass(frozen=True, eq=False)
class ForceEstimate:
    """States and missing force along measurements.

    Attributes:
        x: (n_nodes, n_states) states.
        w: (n_intervals, n_forced) force in the equations ``rows``, in the unit of a
            rate of their states.
        grid: nodes, intervals and measurements.
        posterior: what the linearised record says of the force, with its sizes.
        rounded: widths of corners that were too sharp for the search, by name.
        has_converged: whether the last solve ended at an optimum.
    """

    x: np.ndarray
    w: np.ndarray
    grid: Grid
    posterior: ForcePosterior
    rounded: dict[str, float] = field(default_factory=dict)
    has_converged: bool = True

    @property
    def disturbances(self) -> Disturbances:
        """Noise and force, with their sizes."""
        return self.posterior.disturbances

    @property
    def white(self) -> np.ndarray:
        """Standard deviation of the white measurement noise alone, (n_states,)."""
        return self.disturbances.sigma[0]

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of all measurement noise, (n_states,), lasting or not."""
        variance = self.white**2
        for sensor in self.disturbances.sensors:
            variance[sensor.place] += sensor.size**2
        return np.sqrt(variance)

    @property
    def rows(self) -> tuple[int, ...]:
        """Equations in which a force was estimated, (n_forced,)."""
        return tuple(force.place for force in self.disturbances.forces)

    @property
    def size(self) -> np.ndarray:
        """Standard deviation of the force's prior in each of them, (n_forced,)."""
        return np.array([force.size for force in self.disturbances.forces])


def missing_force_of(fit: Fit, data: Measurements, grid: Grid) -> ForceEstimate:
    """The force that a fitted model lacks along measurements, with states and noise.

    The search for the sizes is local: begun too low, it can end with everything called
    noise. And no force explains a sensor that contradicts another one, which would
    count as noise as well. Where the noise of a channel comes out far beyond what
    neighbouring samples scatter, the search is begun again from a larger force, and at
    last with the noise taken from the scatter.

    Raises:
        SolveError: no states were found with which a force explains the data.
    """
    noise = NoiseLevels.beside_force(data)
    is_given = noise.is_known
    scatter = noise.sigma
    model = fit.model
    unknown = Theta.of(model, [run.name for run in data.trajectories])
    theta = unknown.stacked(parameter_matrix(model, parameters_of(fit, data)))
    point = first_point(model, grid)
    measured = grid.measured_states
    lasting = lasting_noise(fit.model_error_rows, model.states, longest_noise(grid))
    search = _Search(
        unknown=unknown,
        grid=grid,
        point=replace(point, theta=theta, theta_scale=np.ones(len(unknown))),
        channels=noise.channels(grid),
        least_noise=noise.least,
    )
    first = Disturbances(
        sigma=initial_noise(data, np.where(is_given, scatter, np.nan)),
        forces=generous_force(model, grid, point),
        sensors=tuple(error for error in lasting if not is_given[error.place]),
    )
    estimate = search.begun_at(first)

    def is_doubtful(found: ForceEstimate) -> bool:
        return bool(np.any(measured & (found.white > 1.5 * scatter)))

    if is_doubtful(estimate):
        rates = np.sqrt(np.mean(grid.rates(estimate.x) ** 2, axis=0))
        larger = []
        for force in estimate.disturbances.forces:
            size = max(float(rates[force.place]), force.size)
            larger.append(replace(force, size=10 * size))
        with suppress(SolveError):
            larger_first = replace(first, sigma=scatter, forces=tuple(larger))
            second = search.begun_at(larger_first)
            if second.posterior.log_evidence > estimate.posterior.log_evidence:
                estimate = second
    contradiction_is_possible = measured.sum() > 1
    if contradiction_is_possible and is_doubtful(estimate):
        with suppress(SolveError):
            of_scatter = replace(first, sigma=scatter, sensors=())
            return replace(search, channels=()).begun_at(of_scatter)
    return estimate


def longest_noise(grid: Grid) -> float:
    """Correlation time up to which an error of a sensor is noise.

    Five sampling intervals: neighbours with a correlation of 0.7 have 2.8. What lasts
    longer may be an effect.
    """
    return 5 * float(np.median(grid.h))


def generous_force(model: Model, grid: Grid, point: Point) -> Forces:
    """A force in every equation that can lack one, as large as its state's rate.

    The root mean square of the rate at ``point``, or the state's scale over the
    duration of a record if that is larger; the correlation time is a tenth of the
    duration.
    """
    last = np.r_[grid.first[1:] - 1, grid.n_nodes - 1]
    duration = float(np.mean(grid.t[last] - grid.t[grid.first]))
    mean_square = np.mean(np.diff(point.x, axis=0) ** 2, axis=0)
    rate = np.sqrt(mean_square) / np.median(grid.h)
    size = np.maximum(rate, point.x_scale / duration)
    time = duration / 10
    return tuple(Process(row, float(size[row]), time) for row in forced_rows(model))


@dataclass(frozen=True, eq=False)
class _Search:
    """A search for states and missing force beside parameters that stay."""

    unknown: Theta  # the parameters
    grid: Grid
    point: Point  # where it begins, with their values
    channels: tuple[int, ...]  # measured states whose noise is not known
    least_noise: np.ndarray  # (n_states,) below which that does not fall

    def begun_at(self, first: Disturbances) -> ForceEstimate:
        """States and force from disturbances to begin with, of noise (n_states,).

        Where a corner of dry friction is too sharp for the search, it is rounded, and
        the estimate says so: with a sharp one a search may end anywhere between the
        force it began with and the one that is missing.

        Raises:
            SolveError: No force was found, with rounded corners either.
        """
        model = self.unknown.model
        widths = corner_widths(model)
        first = replace(
            first, sigma=np.tile(first.sigma, (self.grid.n_trajectories, 1))
        )
        # Widths of corners, and what to begin with; with a corner of the user's own,
        # which is not known as one, a small force.
        attempts: list[tuple[dict[str, float], Disturbances]] = [({}, first)]
        for factor in ROUNDER if widths else ():
            rounded = {name: factor * model.values[name] for name in widths}
            attempts.append((rounded, first))
        attempts.append(({}, _scaled(first, 0.01)))
        # With a corner that can be rounded, patience is for when all else fails.
        for is_patient in (False, True) if widths else (True,):
            unfinished = []
            for attempt in attempts:
                try:
                    estimate = self.estimate(*attempt, is_patient)
                except SolveError as error:
                    failure = error
                    continue
                if estimate.has_converged:
                    return estimate
                unfinished.append((attempt, estimate))
            if unfinished:
                attempts = [unfinished[0][0]]
        if not unfinished:
            raise failure
        return unfinished[0][1]

    def estimate(
        self, rounded: dict[str, float], first: Disturbances, is_patient: bool
    ) -> ForceEstimate:
        """States and missing force, with sizes of force and noise by evidence.

        Three solves at most, each followed by better sizes.

        Raises:
            SolveError: no states and force were found that obey the dynamics.
        """
        grid = self.grid
        point = self.point
        model = self.unknown.model.with_values(rounded)
        values = LikelihoodValues(model, grid, SCHEME, point, self.unknown)
        problem = JointProblem(Linearizer(values), first, NO_PARAMETERS)
        last = None
        z = point.scaled
        for n_left in reversed(range(3)):
            found = problem.optimum(z, beside=last)
            if _is_lost(found):
                # A force large enough lets the states follow the data, whatever the
                # model.
                larger = _scaled(problem.disturbances, 100.0)
                problem = replace(problem, disturbances=larger)
                found = problem.optimum(point.scaled)
            is_unfinished = n_left == 0 and not found.has_converged
            if is_patient and (_is_lost(found) or is_unfinished):
                found = problem.optimum(found.point.z, 200, found.point)
            if _is_lost(found):
                raise SolveError(
                    "the missing force could not be estimated: no states satisfy the "
                    f"model with a force (largest violation {found.violation:.2g} "
                    f"after {found.n_steps} steps); choose other starting values, or "
                    "smooth sharp corners in the model."
                )
            last = found.point
            z = last.z
            # Sizes of the largest marginal likelihood at the solution.
            coordinates = Coordinates(
                origin=problem.disturbances,
                channels=self.channels,
                least_noise=self.least_noise,
                fixed_times=True,
            )
            sized = climbed(found.likelihood, coordinates, most_steps=8)
            problem = replace(problem, disturbances=sized.disturbances)
            if sized.gain < SETTLED_EVIDENCE and found.has_converged:
                break
        n_forced = len(first.forces)
        forces = found.point.processes[: n_forced * grid.n_intervals]
        return ForceEstimate(
            x=point.unscaled(z)["x"],
            w=forces.reshape(n_forced, -1).T,
            grid=grid,
            posterior=ForcePosterior(found.likelihood, problem.disturbances),
            rounded=rounded,
            has_converged=found.has_converged,
        )


def _scaled(disturbances: Disturbances, factor: float) -> Disturbances:
    """With forces of other sizes."""
    forces = disturbances.forces
    larger = tuple(replace(force, size=factor * force.size) for force in forces)
    return replace(disturbances, forces=larger)


def _is_lost(found: JointEstimate) -> bool:
    return not found.has_converged and found.violation > NEARLY_HELD
