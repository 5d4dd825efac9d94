"""A fit along measurements: what comparing and diagnosing need of both, made once.

Aligning measurements with a model, laying them out, collecting the parameters of every
trajectory and estimating the missing force (with it the noise) are the same for every
question that is asked of a fit. They are done here, and the record is handed on; so are
the states from which a free run begins.

A free run begins at a state that was estimated from the whole record and never looks at
the measurements again; after a gap with an unknown input it begins anew. Steps of the
transcription that are too long for a fast motion hide that an optimum is none: an
accurate run shows it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import attrgetter

import numpy as np
from scipy.optimize import least_squares

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.fit import Fit, lasting_noise, parameters_of
from phsi_opt.estimation.free_runs import Parameters, Runs, free_runs, parameter_matrix
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, StartingPoint
from phsi_opt.estimation.missing_force import (
    ForceEstimate,
    longest_noise,
    missing_force_of,
)
from phsi_opt.estimation.noise_estimation import NoiseLevels
from phsi_opt.estimation.optimum_checks import finer_steps
from phsi_opt.initialization.relative_guesses import fast_motion
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.statistics import TINY
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import (
    AlignedData,
    WithMeasurements,
    checked_data,
    grid_of,
)
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

# The noise is known and the start is near, so a brief solve is enough.
BRIEF_SOLVE = SolverSettings(max_iterations=60, thorough=False)


@dataclass(frozen=True, eq=False)
class Record(WithMeasurements):
    """A fit and one set of measurements."""

    fit: Fit  # the fit
    aligned: AlignedData  # the measurements in the model's order, laid out
    # States, noise and missing force along the measurements. Of a candidate (see
    # `refitted`) it is that of the base model: noise and starting states are then
    # judged alike for all candidates.
    estimate: ForceEstimate

    @classmethod
    def of(cls, fit: Fit, data: Measurements) -> "Record":
        """The record of a fit and measurements that hold its states and inputs.

        Raises:
            DataError: a state or input of the model is not in the measurements.
            SolveError: the missing force could not be estimated.
        """
        return cls.of_aligned(fit, checked_data(fit.model, data))

    @classmethod
    def of_aligned(cls, fit: Fit, aligned: AlignedData) -> "Record":
        """`of` for measurements that were aligned with the model before.

        Raises:
            SolveError: the missing force could not be estimated.
        """
        aligned = aligned.for_model(fit.model)
        return cls(fit, aligned, missing_force_of(fit, aligned.data, aligned.grid))

    def refitted(self, fit: Fit) -> "Record":
        """The same measurements with the fit of a larger model."""
        return Record(fit, self.aligned.for_model(fit.model), self.estimate)

    @property
    def model(self) -> Model:
        return self.fit.model

    @cached_property
    def parameters(self) -> Parameters:
        """Values of the free parameters by trajectory and name.

        For a trajectory that the fit has not seen, the means of the fit. Where they are
        `estimated_here` that is where the search for them begins.
        """
        return parameters_of(self.fit, self.data)

    @cached_property
    def theta(self) -> np.ndarray:
        """The free parameters, (n_free, n_trajectories)."""
        return parameter_matrix(self.model, self.parameters)

    @property
    def sigma(self) -> np.ndarray:
        """Noise per state, (n_states,); one for states that nobody measured.

        With noise that lasts from sample to sample, all of it.
        """
        n_states = self.model.n_states
        known = self.estimate.sigma[:n_states]
        sigma = np.r_[known, np.ones(n_states - len(known))]
        if not self.has_correlated_noise:
            return sigma
        # Few of its values are independent: the longer record of the fit knows it too.
        of_fit = [self.fit.noise.get(name, 0.0) for name in self.model.states]
        return np.maximum(sigma, of_fit)

    @property
    def _brief_noise(self) -> int:
        """Number of sensors whose errors last for a few samples, as the fit found."""
        longest = longest_noise(self.grid)
        rows = self.fit.model_error_rows
        return len(lasting_noise(rows, self.model.states, longest))

    @property
    def has_correlated_noise(self) -> bool:
        """Whether all disturbances are errors of sensors that last for a few samples.

        There is no force, and no function of a state.
        """
        n_lasting = sum(row.time != 0 for row in self.fit.model_error_rows)
        is_brief = n_lasting == self._brief_noise
        return not self.fit.has_model_error and n_lasting > 0 and is_brief

    @property
    def shows_correlated_noise(self) -> bool:
        """Whether a disturbance is such an error; there may be others too."""
        return self._brief_noise > 0

    @property
    def start(self) -> tuple[np.ndarray, ...]:
        """States of the estimate at the samples, (n_samples, n_known) per trajectory.

        The memory that a candidate adds is not in them.
        """
        return self.estimate.grid.split(self.estimate.x)

    @property
    def is_of_training(self) -> bool:
        """Whether the fit was made from these measurements, and knows their states."""
        return bool(self.fit.states) and self._was_fitted

    @property
    def _was_fitted(self) -> bool:
        """Whether the fit was made from these very measurements."""
        return self.fit.provenance.get("data_sha256") == self.data.digest

    def estimated_here(self, model: Model) -> set[str]:
        """Names of the parameters whose values these measurements give, not the fit.

        As starting states are: what every trajectory has of its own, where the fit was
        not made from these measurements.
        """
        entries = model.entries
        own = {name for name in model.free if entries[name].parameter.per_trajectory}
        return set() if self._was_fitted else own


# ---- the states with which a fitted model explains a record best ---------------------


@dataclass(frozen=True, eq=False)
class SmoothedStates:
    """States at the samples, and the parameters that belong to them."""

    states: Sequence[np.ndarray]  # one (n_samples, n_states) per trajectory
    # Values of the free parameters by trajectory and name.
    parameters: Parameters


def smoothed_states(record: Record) -> SmoothedStates:
    """The states of a model along a record, from which free runs begin.

    The dynamics hold exactly (zero defects) and the shared parameters stay as they are.
    On the measurements of the fit they are those of the fit. Elsewhere they are found
    by maximum likelihood, and with them what every trajectory has of its own; where no
    such states are found, by free runs that begin near those of the missing force.
    """
    fit = record.fit
    if record.is_of_training:
        return SmoothedStates(fit.states, record.parameters)
    nodes = np.concatenate(record.start)
    guess = record.grid.split(
        with_memory(record.model, record.grid, nodes, record.theta)
    )
    sigma = record.sigma
    if fit.huber is not None:
        # Outliers that the fit set aside must not make up the noise.
        by_state = zip(record.model.states, sigma, strict=True)
        sigma = np.array([fit.noise.get(name, s) for name, s in by_state])
    found = _most_likely_states(record, sigma, guess)
    if found is None:
        likeliest = partial(_likeliest_run, record, sigma, guess)
        states = tuple(map(likeliest, range(len(guess))))
        found = SmoothedStates(states, record.parameters)
    return found


def _likeliest_run(
    record: Record, sigma: np.ndarray, guess: Sequence[np.ndarray], number: int
) -> np.ndarray:
    """A free run with the starting state of least misfit, (n_samples, n_states).

    By least squares from several starts: that of the guess, and from where states that
    were not measured are a standard deviation away.
    """
    model = record.model
    data = record.data[number]
    aligned = AlignedData(data, grid_of(data))
    x = guess[number]
    spread = np.std(x, axis=0)
    away = np.where(record.grid.measured_states, 0.0, spread)

    def misfit(start: np.ndarray) -> np.ndarray:
        residuals = free_runs(model, aligned, [start[None]], record.parameters)[2][0]
        return np.asarray((residuals / sigma)[np.isfinite(data.trajectories[0].x)])

    best = x[0]
    for start in np.unique([x[0], x[0] + away, x[0] - away], axis=0):
        scale = np.where(spread > 0, spread, 1.0)
        found = least_squares(misfit, start, x_scale=scale, max_nfev=12)
        best = min(best, found.x, key=lambda one: float(np.sum(misfit(one) ** 2)))
    return free_runs(model, aligned, [best[None]], record.parameters)[0][0]


def _most_likely_states(
    record: Record, sigma: np.ndarray, guess: Sequence[np.ndarray]
) -> SmoothedStates | None:
    """States by maximum likelihood, parameters per trajectory; None: not found.

    The steps are so fine that an accurate run agrees: from the first state it would
    otherwise leave the others.
    """
    fit = record.fit
    model = fit.model
    shared = dict(fit.values)
    for name in model.free:
        if model.entries[name].parameter.per_trajectory:
            del shared[name]
    model = model.with_fixed(shared)
    steps = steps_on(fit, record.data)
    along = (record.aligned, sigma, likelihood_of(fit), model)
    likely = partial(maximum_along, *along, parameters=record.parameters)
    state = likely(guess, steps)
    finer = 4  # times as many steps, twice at most, and not where they are many
    for _ in range(2):
        if state is None or finer * state.nodes.size > 50_000:
            break
        # Beside large residuals an integration error does not show.
        size = np.sqrt(max(state.solution.outcome.objective, 1.0))
        if finer_steps(replace(state, sigma=size * state.sigma)) is None:
            break
        steps = tuple(finer * n for n in steps)
        refined = likely(state.states, steps)
        if refined is None:
            break
        state = refined
    if state is None:
        return None
    parameters = {}
    for run, known in record.parameters.items():
        parameters[run] = {**known, **state.unknown.values_of(state.theta, run)}
    return SmoothedStates(state.states, parameters)


def maximum_along(
    aligned: AlignedData,
    sigma: np.ndarray,
    loss: MaximumLikelihood,
    model: Model,
    states: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
    parameters: Parameters | None = None,
) -> LikelihoodEstimate | None:
    """The likelihood's maximum along a record whose noise is known; None: not found.

    For what is asked of a fit afterwards: no windows, no finer steps, no pruning. From
    parameters (None: the values of the model) and states at the samples, (n_samples,
    n_states) per trajectory, with noise sigma (n_states,) and so many steps in every
    gap.
    """
    task = Task(model, aligned, l1={}, pruning=None, settings=BRIEF_SOLVE)
    known = parameters or dict.fromkeys(task.runs, model.values)
    start = StartingPoint(
        model=model,
        theta=Theta.of(model, task.runs).stacked(parameter_matrix(model, known)),
        states=tuple(states),
        sigma=sigma,
        steps=tuple(steps),
    )
    problem = LikelihoodProblem(task, loss, NoiseLevels.known(sigma))
    estimate = problem.solve_from(start)
    return estimate if estimate.is_success else None


def likelihood_of(fit: Fit) -> MaximumLikelihood:
    """The loss of the fit, for a record along which its parameters are known."""
    return MaximumLikelihood(huber=fit.huber)


def steps_on(fit: Fit, data: Measurements) -> tuple[np.ndarray, ...]:
    """Intervals in every gap between samples, one (n_samples - 1,) per trajectory.

    Those of the fit on its own record, else its median everywhere.
    """
    lengths = [run.n_samples for run in data.trajectories]
    if [len(steps) + 1 for steps in fit.steps] == lengths:
        return fit.steps
    median = int(np.median(np.concatenate(fit.steps))) if fit.steps else 1
    return tuple(np.full(n_samples - 1, median) for n_samples in lengths)


# ---- free runs -----------------------------------------------------------------------


def leaving_words(model: Model, data: Measurements, residuals: Runs) -> str:
    """What to do if a free run leaves the measurements; "" where it does not."""
    places = list(map(data.states.index, data.measured))
    spread = np.maximum(np.nanstd(data.stacked("x")[:, places], axis=0), TINY)
    squares = np.concatenate(residuals)[:, places] ** 2
    errors = np.sqrt(np.nanmean(squares, axis=0)) / spread
    worst = int(np.argmax(errors))
    # A constant has an error of one, and a motion out of step one of 1.4.
    if not errors[worst] > 2:
        return ""
    runs = ", ".join(map(attrgetter("name"), data.trajectories[:3]))
    advice = "choose other starting values for the parameters"
    if not model.free:
        advice = "the fixed numbers of the formulas"
    return (
        f"The free run of {data.measured[worst]} leaves the measurements ({runs}): its "
        f"error is {errors[worst]:.3g} times their standard deviation; a constant is "
        f"better. Check the units and the sign of each term, and {advice}."
    )


def doubts_of(fit: Fit, aligned: AlignedData) -> str:
    """The warning to read first, of a fit and the data it was made from."""
    words = [fast_motion(fit.model, aligned.grid, aligned.data.units)]
    if fit.states and fit.outcome.success:
        parameters = parameters_of(fit, aligned.data)
        residuals = free_runs(fit.model, aligned, fit.states, parameters)[2]
        words.insert(0, leaving_words(fit.model, aligned.data, residuals))
    return " ".join(filter(None, words))
