"""The missing force: what a model lacks, as an unknown function of time.

The states and the force are found by one program (`losses.MissingForce`); how large the
force is, and how large the noise, is chosen by marginal likelihood at the linearised
solution (`linearized_force`). Both take turns until the sizes settle.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csc_matrix, diags

from phsi_opt.errors import SolveError
from phsi_opt.estimation.linearized_force import (
    ForceSolution,
    Known,
    LinearizedForce,
    Sizes,
)
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.initialization.scaling import first_point
from phsi_opt.model.model import Model
from phsi_opt.model.structure import forced_rows
from phsi_opt.optimization.ipopt import Solution, Solver
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.transcription.force_prior import ForcePrior
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import MissingForce
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import SensorOutputs

# Iterations while the force's size is still sought: beside sharp friction a generous
# force takes hundreds.
ROUGHLY = SolverSettings(tolerance=1e-6, max_iterations=30)
THOROUGHLY = SolverSettings(tolerance=1e-6, max_iterations=200)
MOST_UPDATES = 8  # of the sizes between two solves
SETTLED_SIZE = 0.02  # change of the logarithm of a size at which its updates end
# Violation of the (scaled) dynamics beyond which a search that did not end well is of
# no use.
LOST = 1e-2
# Factor on the force's size after a search from its usual size failed.
GENEROUS = 100.0
# The mean duration of a record holds as many of the force's correlation times.
N_CORRELATION_TIMES = 10
# Intervals at which the force's standard deviation is worked out exactly.
MOST_EXACT = 400


@dataclass(frozen=True, eq=False)
class ForceEstimate:
    """States and missing force along measurements.

    Attributes:
        x: (n_nodes, n_states) states.
        w: (n_intervals, n_forced) force in the forced equations ``prior.rows``, in the
            unit of a rate of their states.
        sigma: (n_states,) standard deviation of the measurement noise.
        prior: Of the force, with its size.
        log_evidence: Logarithm of the marginal likelihood of the sizes, up to a
            constant.
        grid: Nodes, intervals and measurements.
        linear: The problem linearised at the solution, for standard deviations.
        rounded: Widths of corners that were too sharp for the search, by name.
        has_converged: Whether the last solve ended at an optimum.
    """

    x: np.ndarray
    w: np.ndarray
    sigma: np.ndarray
    prior: ForcePrior
    log_evidence: float
    grid: Grid
    linear: LinearizedForce
    rounded: dict[str, float] = field(default_factory=dict)
    has_converged: bool = True


def default_prior(model: Model, grid: Grid, point: Point) -> ForcePrior:
    """A generous prior, from the rates of the states at ``point``.

    Its size in each equation is the root mean square of the state's rate, or the
    state's scale over the duration of a record if that is larger; its correlation time
    a tenth of the duration.
    """
    rows = forced_rows(model)
    last = np.r_[grid.first[1:] - 1, grid.n_nodes - 1]
    duration = float(np.mean(grid.t[last] - grid.t[grid.first]))
    mean_square = np.mean(np.diff(point.x, axis=0) ** 2, axis=0)
    rate = np.sqrt(mean_square) / np.median(grid.h)
    size = np.maximum(rate, point.x_scale / duration)[list(rows)]
    return ForcePrior(rows, size, duration / N_CORRELATION_TIMES)


def estimate_force(
    model: Model,
    grid: Grid,
    point: Point,
    sigma: np.ndarray,
    *,
    rounds: int = 3,
    known_noise: Known = False,
    prior: ForcePrior | None = None,
    integrator: str = "srk4",
    least_noise: np.ndarray | float = 0.0,
    is_patient: bool = True,
) -> ForceEstimate:
    """Estimate states and missing force, with sizes of force and noise by evidence.

    Args:
        model: The model that lacks a force.
        grid: Nodes, intervals and measurements.
        point: Where the search begins. Its parameters ``theta``, which stay, are
            (n_free,), or (n_free, n_trajectories) where trajectories have their own.
        sigma: (n_states,) noise to begin with.
        rounds: Solves, each followed by updates of the sizes, at most.
        known_noise: Whether ``sigma`` is known and stays, of all states or of each.
        prior: Of the force, to begin with; None: `default_prior`.
        integrator: The scheme of the defects.
        least_noise: Below which noise that is not known does not fall, of all states or
            (n_states,).
        is_patient: Whether many iterations are taken where few are not enough.

    Raises:
        SolveError: No states and force were found that obey the dynamics.
    """
    prior = prior or default_prior(model, grid, point)
    program = MissingForce(integrator).program(model, grid, point, prior, sigma)
    search = _Search(program, Sizes(sigma, prior, least_noise), is_patient)
    for n_left in reversed(range(rounds)):
        solution = search.solve(is_last=n_left == 0)
        x = solution.values["x"].reshape(point.x.shape)
        w = solution.values["w"].reshape(grid.n_intervals, len(prior.rows))
        jacobian = csc_matrix(solution.kkt.jacobian @ diags(1 / program.scale))
        sensors = SensorOutputs.at(model, grid, x, point.theta)
        solved = ForceSolution(grid, x, w, jacobian, sensors)
        before = search.sizes
        linear = search.update_sizes(solved, known_noise)
        change = search.sizes.change_from(before)
        if change < SETTLED_SIZE and solution.outcome.success:
            break
    sizes = search.sizes
    return ForceEstimate(
        x=x,
        w=w,
        sigma=sizes.sigma,
        prior=sizes.prior,
        log_evidence=linear.log_evidence(),
        grid=grid,
        linear=linear,
        has_converged=solution.outcome.success,
    )


class _Search:
    """The missing-force program, solved for better and better sizes.

    Attributes:
        sizes: Of noise and force, at present.
    """

    def __init__(self, program: Program, sizes: Sizes, is_patient: bool) -> None:
        self.sizes = sizes
        self._is_patient = is_patient
        self._program = program
        self._solver = Solver(program, ROUGHLY)
        self._start = program.start

    def solve(self, *, is_last: bool) -> Solution:
        """The solution for the present sizes, from the last solution.

        Raises:
            SolveError: There is none, with a generous force and, where the search is
                patient, many iterations either.
        """
        solution = self._solve_from(self._start)
        if _is_lost(solution):
            # A force large enough lets the states follow the data, whatever the model.
            self.sizes = self.sizes.with_force(GENEROUS * self.sizes.prior.size)
            solution = self._solve_from(self._program.start)
        is_unfinished = is_last and not solution.outcome.success
        if self._is_patient and (_is_lost(solution) or is_unfinished):
            self._solver = Solver(self._program, THOROUGHLY)
            solution = self._solve_from(solution.z)
        if _is_lost(solution):
            raise SolveError(
                f"The missing force could not be estimated: {solution.outcome}"
            )
        self._start = solution.z
        return solution

    def _solve_from(self, start: np.ndarray) -> Solution:
        settings = np.r_[self.sizes.prior.size, self.sizes.sigma]
        return self._solver.solve(start, settings, raise_on_failure=False)

    def update_sizes(self, solved: ForceSolution, known: Known) -> LinearizedForce:
        """Move the sizes to the largest marginal likelihood at the solution.

        Returns:
            The problem linearised there, for the sizes before the last update.
        """
        for _ in range(MOST_UPDATES):
            linear = LinearizedForce(solved, self.sizes)
            before = self.sizes
            self.sizes = linear.improved(known)
            if self.sizes.change_from(before) < SETTLED_SIZE:
                break
        return linear


def _is_lost(solution: Solution) -> bool:
    outcome = solution.outcome
    return not outcome.success and outcome.infeasibility > LOST


def force_deviation(estimate: ForceEstimate, most: int = MOST_EXACT) -> np.ndarray:
    """Standard deviation of the force given the measurements, (n_intervals, n_forced).

    Args:
        estimate: The force, with its linearised problem.
        most: Intervals at which it is exact; in between it is interpolated.
    """
    linear = estimate.linear
    n_intervals, n_forced = estimate.w.shape
    evenly = np.linspace(0, n_intervals - 1, min(most, n_intervals))
    chosen = np.unique(evenly.astype(int))
    columns = np.arange(len(chosen))
    deviation = np.zeros((n_intervals, n_forced))
    for k in range(n_forced):
        places = linear.n_x + chosen * n_forced + k
        units = np.zeros((linear.n_total, len(chosen)))
        units[places, columns] = 1.0
        variance = linear.factor.solve(units)[places, columns]
        exact = np.sqrt(np.maximum(variance, 0.0))
        deviation[:, k] = np.interp(np.arange(n_intervals), chosen, exact)
    return deviation


# A factor on the width of corners, and the prior of the force, to begin with.
_Attempt = tuple[float, ForcePrior]
# Factors on the width of corners that are too sharp.
ROUNDER = (1.0, 4.0, 16.0, 64.0)
# Factor on the force's usual size where no search from it ends well: beside a corner of
# the user's own, which is not known as one.
SMALL = 0.01


def smoothed(
    model: Model,
    grid: Grid,
    sigma: np.ndarray,
    integrator: str,
    known_noise: Known,
    theta: np.ndarray | None = None,
    *,
    rounds: int = 3,
    prior: ForcePrior | None = None,
    least_noise: np.ndarray | float = 0.0,
) -> ForceEstimate:
    """States, also unmeasured ones, and missing force at given parameters.

    Where a corner of dry friction is too sharp for the search, it is rounded, and the
    estimate says so: beside one a search may end anywhere between the force it began
    with and the one that is missing.

    Args:
        model: The model; its present values are the parameters unless ``theta`` is
            given.
        grid: Nodes, intervals and measurements.
        sigma: (n_states,) noise to begin with.
        integrator: The scheme of the defects.
        known_noise: Whether ``sigma`` is known and stays, of all states or of each.
        theta: Other values, (n_free, n_trajectories) where trajectories have parameters
            of their own.
        rounds: Solves, each followed by updates of the sizes, at most.
        prior: Of the force, to begin with; None: `default_prior`.
        least_noise: Below which noise that is not known does not fall, of all states or
            (n_states,).

    Raises:
        SolveError: No force was found, with rounded corners either.
    """
    point = first_point(model, grid)
    if theta is not None:
        point = replace(point, theta=theta)
    usual = prior or default_prior(model, grid, point)
    values = model.values
    widths = {name: values[name] for name in corner_widths(model)}

    def searched(factor: float, begun: ForcePrior, is_patient: bool) -> ForceEstimate:
        rounded = {}
        if factor != 1:
            rounded = {name: factor * width for name, width in widths.items()}
        estimate = estimate_force(
            model.with_values(rounded),
            grid,
            point,
            sigma,
            rounds=rounds,
            known_noise=known_noise,
            prior=begun,
            integrator=integrator,
            least_noise=least_noise,
            is_patient=is_patient,
        )
        return replace(estimate, rounded=rounded)

    attempts = [(factor, usual) for factor in (ROUNDER if widths else ROUNDER[:1])]
    attempts.append((1.0, replace(usual, size=SMALL * usual.size)))
    found = None
    if widths:
        # Beside a corner that can be rounded, patience is for when all else fails.
        with suppress(SolveError):
            found = _first_found(searched, attempts, is_patient=False)
    if found is not None:
        if found.estimate.has_converged:
            return found.estimate
        attempts = [found.attempt]
    return _first_found(searched, attempts, is_patient=True).estimate


@dataclass(frozen=True, eq=False)
class _Found:
    """An estimate, with the factor on widths and the prior that it began with."""

    attempt: _Attempt
    estimate: ForceEstimate


def _first_found(
    searched: Callable[[float, ForcePrior, bool], ForceEstimate],
    attempts: Sequence[_Attempt],
    is_patient: bool,
) -> _Found:
    """The first estimate whose search ended well, else the first of all.

    Raises:
        SolveError: No search led anywhere.
    """
    unfinished = None
    for factor, prior in attempts:
        try:
            estimate = searched(factor, prior, is_patient)
        except SolveError as error:
            failure = error
            continue
        found = _Found((factor, prior), estimate)
        if estimate.has_converged:
            return found
        unfinished = unfinished or found
    if unfinished is None:
        raise failure
    return unfinished
