"""The missing force: what a model lacks, as an unknown function of time.

A first-order process in every equation that can lack a force: smooth enough to tell
force from noise, and rough enough for a friction that jumps. States and force are found
together (`model_error.joint_estimate`); how large the force is, and how large the
noise, is chosen by marginal likelihood at the linearised solution. Both take turns
until the sizes settle.
"""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit, lasting_noise, parameter_matrix, parameters_of
from phsi_opt.estimation.noise_estimation import NoiseLevels
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.initialization.scaling import first_point
from phsi_opt.model.model import Model
from phsi_opt.model.structure import forced_rows
from phsi_opt.model_error.ascent import SETTLED_EVIDENCE, climbed
from phsi_opt.model_error.disturbances import Coordinates, Disturbances, Process
from phsi_opt.model_error.joint_estimate import (
    NEARLY_HELD,
    STEPS_OF_A_PROBLEM,
    JointEstimate,
    JointPoint,
    JointProblem,
)
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import ForcePosterior
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Point, Theta

Known = bool | np.ndarray  # whether the noise is known, of all states or of each
Forces = tuple[Process, ...]

NO_PARAMETERS = np.zeros(0, dtype=int)  # that are free to move
ROUNDER = (1.0, 4.0, 16.0, 64.0)  # factors on the width of corners that are too sharp
# Estimated noise over the scatter of neighbouring samples from which a sensor is
# doubted: it contradicts another one, which no force explains.
DOUBTFUL_NOISE = 1.5
# Correlation time of a sensor's noise, in sampling intervals, up to which it is noise:
# neighbours with a correlation of 0.7 have 2.8. What lasts longer may be an effect.
BRIEF_NOISE = 5.0
# Factor on the size of the rates along the estimated states: from a force so large the
# second search comes down.
SIZE_OF_SECOND_SEARCH = 10.0


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
    theta = None
    if fit.by_trajectory:
        theta = parameter_matrix(model, parameters_of(fit, data))
    lasting = lasting_noise(fit.model_error_rows, model.states, longest_noise(grid))
    search = partial(
        smoothed,
        model,
        grid,
        theta=theta,
        known_noise=is_given,
        sensors=tuple(error for error in lasting if not is_given[error.place]),
        least_noise=noise.least,
    )
    estimate = search(initial_noise(data, np.where(is_given, scatter, np.nan)))
    measured = grid.measured_states

    def is_doubtful(found: ForceEstimate) -> bool:
        return bool(np.any(measured & (found.white > DOUBTFUL_NOISE * scatter)))

    if is_doubtful(estimate):
        rates = np.sqrt(np.mean(grid.rates(estimate.x) ** 2, axis=0))
        sizes = np.maximum(rates[list(estimate.rows)], estimate.size)
        larger = []
        forces = estimate.disturbances.forces
        for force, size in zip(forces, sizes.tolist(), strict=True):
            larger.append(replace(force, size=SIZE_OF_SECOND_SEARCH * size))
        with suppress(SolveError):
            second = search(scatter, forces=tuple(larger))
            estimate = max(
                estimate, second, key=lambda found: found.posterior.log_evidence
            )
    contradiction_is_possible = measured.sum() > 1
    if contradiction_is_possible and is_doubtful(estimate):
        with suppress(SolveError):
            return smoothed(model, grid, scatter, theta, known_noise=True)
    return estimate


def longest_noise(grid: Grid) -> float:
    """Correlation time up to which an error of a sensor is noise."""
    return BRIEF_NOISE * float(np.median(grid.h))


def smoothed(
    model: Model,
    grid: Grid,
    sigma: np.ndarray,
    theta: np.ndarray | None = None,
    *,
    forces: Forces | None = None,
    **options: Any,
) -> ForceEstimate:
    """States, also unmeasured ones, and missing force at given parameters.

    Where a corner of dry friction is too sharp for the search, it is rounded, and the
    estimate says so: with a sharp one a search may end anywhere between the force it
    began with and the one that is missing. Arguments are those of `estimate_force`,
    with parameters theta (n_free,) or (n_free, n_trajectories), None: the model's own.

    Raises:
        SolveError: No force was found, with rounded corners either.
    """
    point = first_point(model, grid)
    if theta is not None:
        point = replace(point, theta=theta)
    usual = generous_force(model, grid, point) if forces is None else forces
    widths = {name: model.values[name] for name in corner_widths(model)}

    def first_found(is_patient: bool) -> tuple[tuple[float, Forces], ForceEstimate]:
        """The first attempt whose search ended well, else the first of all."""
        unfinished = None
        for factor, begun in attempts:
            rounded = {}
            if factor != 1:
                rounded = {name: factor * width for name, width in widths.items()}
            try:
                estimate = estimate_force(
                    model.with_values(rounded),
                    grid,
                    point,
                    sigma,
                    forces=begun,
                    is_patient=is_patient,
                    **options,
                )
            except SolveError as error:
                failure = error
                continue
            found = (factor, begun), replace(estimate, rounded=rounded)
            if estimate.has_converged:
                return found
            unfinished = unfinished or found
        if unfinished is None:
            raise failure
        return unfinished

    # Factors on the width of corners, and the forces to begin with; with a corner of
    # the user's own, which is not known as one, a small force.
    factors = ROUNDER if widths else ROUNDER[:1]
    attempts = [*((one, usual) for one in factors), (1.0, _scaled(usual, 0.01))]
    if widths:
        # With a corner that can be rounded, patience is for when all else fails.
        with suppress(SolveError):
            attempt, estimate = first_found(is_patient=False)
            if estimate.has_converged:
                return estimate
            attempts = [attempt]
    return first_found(is_patient=True)[1]


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


def estimate_force(
    model: Model,
    grid: Grid,
    point: Point,
    sigma: np.ndarray,
    *,
    rounds: int = 3,
    known_noise: Known = False,
    forces: Forces,
    sensors: tuple[Process, ...] = (),
    integrator: str = "srk4",
    least_noise: np.ndarray | float = 0.0,
    is_patient: bool = True,
) -> ForceEstimate:
    """Estimate states and missing force, with sizes of force and noise by evidence.

    The parameters ``theta`` of the point stay. ``rounds`` solves at most are each
    followed by updates of the sizes; unknown noise does not fall below ``least_noise``.

    Raises:
        SolveError: no states and force were found that obey the dynamics.
    """
    noise = np.tile(sigma, (grid.n_trajectories, 1))
    disturbances = Disturbances(noise, forces, sensors)
    is_open = grid.measured_states & ~np.broadcast_to(known_noise, len(sigma))
    channels = tuple(np.flatnonzero(is_open).tolist())
    # The likelihood at parameters that stay.
    unknown = Theta.of(model, list(map(str, range(grid.n_trajectories))))
    theta = point.theta
    if theta.ndim == 2:
        theta = unknown.stacked(theta)
    point = replace(point, theta=theta, theta_scale=np.ones(len(unknown)))
    values = LikelihoodValues(model, grid, integrator, point, unknown)
    linearizer = Linearizer(values)
    last: JointPoint | None = None

    def solved(
        start: JointPoint | None, most_steps: int = STEPS_OF_A_PROBLEM
    ) -> JointEstimate:
        problem = JointProblem(linearizer, disturbances, NO_PARAMETERS)
        z = point.scaled if start is None else start.z
        return problem.optimum(z, most_steps, start)

    for n_left in reversed(range(rounds)):
        found = solved(last)
        if _is_lost(found):
            # A force large enough lets the states follow the data, whatever the model.
            larger = _scaled(disturbances.forces, 100.0)
            disturbances = replace(disturbances, forces=larger)
            found = solved(None)
        is_unfinished = n_left == 0 and not found.has_converged
        if is_patient and (_is_lost(found) or is_unfinished):
            found = solved(found.point, 200)
        if _is_lost(found):
            raise SolveError(
                "the missing force could not be estimated: no states satisfy the "
                f"model with a force (largest violation {found.violation:.2g} after "
                f"{found.n_steps} steps); choose other starting values, or smooth "
                "sharp corners in the model."
            )
        last = found.point
        # Sizes of the largest marginal likelihood at the solution.
        coordinates = Coordinates(
            origin=disturbances,
            channels=channels,
            least_noise=np.broadcast_to(least_noise, len(sigma)),
            fixed_times=True,
        )
        sized = climbed(found.likelihood, coordinates, channels, most_steps=8)
        disturbances = coordinates.at(sized.vector)
        if sized.gain < SETTLED_EVIDENCE and found.has_converged:
            break
    n_forces = len(forces) * grid.n_intervals
    return ForceEstimate(
        x=point.unscaled(found.point.z)["x"],
        w=found.point.processes[:n_forces].reshape(len(forces), -1).T,
        grid=grid,
        posterior=ForcePosterior(found.likelihood, disturbances),
        has_converged=found.has_converged,
    )


def _scaled(forces: Forces, factor: float) -> Forces:
    return tuple(replace(force, size=factor * force.size) for force in forces)


def _is_lost(found: JointEstimate) -> bool:
    return not found.has_converged and found.violation > NEARLY_HELD
