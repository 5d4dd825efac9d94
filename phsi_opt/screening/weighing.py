"""Models weighed beside a force that could have done the same.

A model is worth the evidence of the measurements when a lasting force of unknown size
acts in its equations too::

    log Z = log p(y | theta, sizes) - k/2 log n + log p(starting states)

with the parameters and the sizes of noise and forces where the evidence is largest,
states and forces where they are most likely then, and Schwarz' price for each of the k
parameters (Annals of Statistics 6, 1978). Starting states have a flat prior over the
range of the motion, so that the scale of a state that nobody measured does not count;
the memory of an effect begins near rest. The difference of two models is the logarithm
of a Bayes factor: what a law gains is what it explains better than a force without a
law.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import STRONG_EVIDENCE
from phsi_opt.data.checks import Hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.noise_estimation import NoiseLevels
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.model import Model
from phsi_opt.model_error.ascent import SETTLED_EVIDENCE, climbed
from phsi_opt.model_error.disturbances import Coordinates, Disturbances
from phsi_opt.model_error.joint_estimate import JointEstimate, JointPoint, JointProblem
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import (
    Border,
    MarginalLikelihood,
    OptimalitySystem,
    solve_border,
)
from phsi_opt.statistics import TINY
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import AlignedData, WithMeasurements
from phsi_opt.transcription.integrators import SCHEME
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Theta

MOST_ROUNDS = 6  # of steps with given sizes, each followed by better sizes
STEPS_OF_A_ROUND = 12
CLIMBS_OF_A_ROUND = 6  # steps of the sizes uphill
# Shortest correlation time of a force, in sampling intervals.
SHORTEST_FORCE = 2.0
# A model that has not come to rest in so many rounds is given up.
ROUNDS_TO_REST = 3
# Size of a force, as a share of the rate in its equation, that is as good as none, and
# one beyond which it is no disturbance of the motion but in its place.
NO_FORCE = 1e-5
LARGEST_FORCE = 3.0
# Violation of the scaled dynamics up to which states obey them well enough, and length
# of a last step, in standard deviations of all that is unknown, up to which the record
# is linear enough for an evidence.
OBEYED = 1e-3
SHORT = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Start:
    """Where a model begins to be weighed."""

    model: Model  # with its parameters
    theta: np.ndarray  # (n_theta,) their values
    states: np.ndarray = field(repr=False)  # (n_nodes, n_states)
    # Values of each force, then of each sensor's errors; None: they are not known.
    processes: tuple[np.ndarray, ...] | None = field(repr=False)
    # Noise, forces and errors of sensors, with their sizes.
    disturbances: Disturbances = field(repr=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class Weighed(Start):
    """A model and the forces that it leaves open, where both are most likely.

    Attributes:
        model: with its values; a mean where trajectories have their own.
        log_likelihood: of all measurements, states and forces integrated out.
        log_evidence: the same with the priors.
        log_training: of those that the fit was made from, alone.
        names: of the parameters, (n_theta,).
        at_bounds: names of those that ended at a bound.
        covariance: of theta, (n_theta, n_theta), forces of these sizes acting.
        force_shares: root mean square of each force over that of the rates in its
            equation, by the number of the equation.
    """

    log_likelihood: float
    log_evidence: float
    log_training: float
    names: tuple[str, ...]
    at_bounds: tuple[str, ...]
    covariance: np.ndarray = field(repr=False)
    force_shares: Mapping[int, float]

    @property
    def log_held_out(self) -> float:
        """Log predictive density of the measurements held out, after the others."""
        return self.log_evidence - self.log_training

    def force_share(self, equation: int) -> float:
        """That of the force in an equation; the largest where it has none."""
        largest = max(self.force_shares.values(), default=0.0)
        return self.force_shares.get(equation, largest)


@dataclass(frozen=True, eq=False)
class _Found:
    """Where steps ended, the record linearised there."""

    joint: JointEstimate
    system: OptimalitySystem

    @cached_property
    def evidence(self) -> float:
        """Log likelihood, states and forces integrated out."""
        border = self.system.border
        found = _log_likelihood(border, np.zeros(border.n_theta))
        return found - self.system.n_free * np.log(2 * np.pi) / 2

    @property
    def is_valid(self) -> bool:
        """Whether states obey the model, and the steps came to rest."""
        is_short = self.joint.has_converged or self.joint.length < SHORT
        return is_short and self.joint.violation < OBEYED

    def is_better_than(self, other: "_Found") -> bool:
        """Whether it is valid where the other is not, or as valid and likelier."""
        if self.is_valid != other.is_valid:
            return self.is_valid
        return self.evidence > other.evidence


@dataclass(frozen=True, eq=False)
class Weighing(WithMeasurements):
    """How models are weighed by one record."""

    aligned: AlignedData  # the measurements, those of the fit first
    n_fitted: int  # number of trajectories that the fit was made from
    n_states: int  # of the smallest model; further ones are the memory of an effect
    channels: tuple[int, ...]  # measured states whose noise is not known
    least_noise: np.ndarray  # (n_states,) below which that does not fall
    longest: float  # correlation time of a force, at most
    # (n_states,) typical rate of every state, before anything is weighed.
    rates: np.ndarray

    @np.errstate(all="ignore")
    def weighed(self, start: Start, worth: float = -np.inf) -> Weighed:
        """Steps with given sizes and better sizes by turns, until both stay.

        Rounds end where no log likelihood of at least ``worth`` is promised.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        problem = self.problem(start)
        z = problem.values.point.scaled
        processes = None
        if start.processes is not None:
            processes = np.concatenate([np.zeros(0), *start.processes])
            problem = problem.tilted(problem.optimum(z, 0))
        best = None
        # Beside a force that was never met with these parameters they stay at first:
        # free ones may run from a large force to where nothing is alike.
        for number in range(MOST_ROUNDS):
            are_held = start.processes is None and number == 0
            own = replace(problem, moving=problem.moving[:0]) if are_held else problem
            joint = own.optimum(z, STEPS_OF_A_ROUND, _beside(own, z, processes))
            z, processes = joint.point.z, joint.point.processes
            likelihood = joint.likelihood.with_moving(_within_bounds(own, z))
            # Of the sizes that led there: others have their optimum elsewhere.
            found = _Found(joint, likelihood.at(own.disturbances))
            sizes, promise = problem.disturbances, 0.0
            if found.is_valid:
                sizes, promise = self._better_sizes(likelihood, sizes)
            problem = replace(problem, disturbances=sizes).tilted(joint)
            promise += joint.move_for(problem.slope) ** 2 / 2
            gain = np.inf
            if best is not None and best.is_valid:
                gain = found.evidence - best.evidence
            if best is None or found.is_better_than(best):
                best = found
            is_settled = min(promise, gain) < SETTLED_EVIDENCE
            if is_settled and joint.has_converged and not are_held:
                break
            if number + 1 == ROUNDS_TO_REST and not best.is_valid:
                break
            if found.is_valid and found.evidence + promise < worth:
                break
        assert best is not None
        if not best.is_valid:
            raise SolveError(
                "its evidence could not be computed: no states satisfy "
                f"it with a force (largest violation {best.joint.violation:.2g}, last "
                f"step of {best.joint.length:.2g} standard deviations)."
            )
        return self._result(problem, best)

    def problem(self, start: Start) -> JointProblem:
        """Parameters, states and forces together, as a start has them."""
        model = start.model
        grid = self.aligned.for_model(model).grid
        unknown = Theta.of(model, self.runs)
        is_held = (start.theta <= unknown.lower) | (start.theta >= unknown.upper)
        held = {model.free[owner] for owner in unknown.owner[is_held]}
        point = point_at(model, grid, unknown, start.theta, start.states, held)
        sizes = start.disturbances
        n_old = self.n_states
        if model.n_states > n_old:
            # The memory of an effect begins near rest, as if that were measured.
            memory = start.states[:, n_old:]
            y = grid.y.copy()
            y[grid.starts, n_old:] = memory[grid.starts]
            grid = replace(grid, y=y)
            spread = np.maximum(np.std(memory, axis=0), TINY)
            of_memory = np.tile(spread, (len(sizes.sigma), 1))
            sigma = np.hstack([sizes.sigma[:, :n_old], of_memory])
            sizes = replace(sizes, sigma=sigma)
        values = LikelihoodValues(model, grid, SCHEME, point, unknown)
        return JointProblem(Linearizer(values), sizes, np.arange(len(unknown)))

    def _better_sizes(
        self, likelihood: MarginalLikelihood, sizes: Disturbances
    ) -> tuple[Disturbances, float]:
        """Sizes of the largest evidence on the linearised record, and its gain."""
        problem, rates = likelihood.problem, self.rates
        n_more = problem.n_states - len(self.least_noise)
        coordinates = Coordinates(
            origin=sizes,
            channels=self.channels,
            least_noise=np.r_[self.least_noise, np.zeros(n_more)],
            shortest=SHORTEST_FORCE * float(np.median(problem.grid.h)),
            longest=self.longest,
            largest_functions=tuple(rates[[f.equation for f in sizes.functions]]),
        )
        found = climbed(likelihood, coordinates, CLIMBS_OF_A_ROUND)
        sizes = found.disturbances
        forces = []
        for force in sizes.forces:
            rate = float(rates[force.place])
            size = float(np.clip(force.size, NO_FORCE * rate, LARGEST_FORCE * rate))
            forces.append(replace(force, size=size))
        return replace(sizes, forces=tuple(forces)), found.gain

    def _result(self, problem: JointProblem, found: _Found) -> Weighed:
        point, unknown = problem.values.point, problem.values.unknown
        values = point.unscaled(found.joint.point.z)
        theta = values["theta"]
        states = values["x"]
        system = found.system
        likelihood = system.likelihood
        grid = self.aligned.grid
        n_values = int(grid.measured.sum())
        n_training = int(grid.measured[grid.trajectory < self.n_fitted].sum())
        # Of starting states, flat over the range of their motion.
        spread = np.std(states[:, : self.n_states], axis=0) + TINY
        price = len(self.runs) * float(np.sum(np.log(spread)))
        k = len(theta)
        evidence = found.evidence - k * np.log(n_values) / 2 - price
        training = evidence
        borders = system.borders_by_trajectory()
        if len(borders) > self.n_fitted:
            fitted, whole = Border.sum(borders[: self.n_fitted]), Border.sum(borders)
            # Where steps ended short of the optimum of all, that is no gain of a part.
            n = whole.n_theta
            precision = whole.information[:n, :n] + np.eye(n)
            missed = solve_border(precision, whole.gradient[:n])
            pull = fitted.gradient[:n] - fitted.information[:n, :n] @ missed
            training = _log_likelihood(fitted, pull)
            training -= k * np.log(n_training) / 2 + price * n_training / n_values
        covariance = np.full((k, k), np.nan)
        moving = likelihood.moving
        scale = point.theta_scale[moving]
        covariance[np.ix_(moving, moving)] = system.covariance * np.outer(scale, scale)
        ends = np.cumsum([len(site.t) for site in likelihood.sites], dtype=int)
        processes = tuple(np.split(found.joint.point.processes, ends)[:-1])
        rates = likelihood.problem.grid.rates(states)
        shares = {}
        for force, acting in zip(system.disturbances.forces, processes, strict=False):
            typical = np.sqrt(np.mean(rates[:, force.place] ** 2)) + TINY
            shares[force.place] = float(np.sqrt(np.mean(acting**2)) / typical)
        is_met = (theta <= unknown.lower) | (theta >= unknown.upper)
        model = problem.values.model
        means = zip(model.free, unknown.means(theta).tolist(), strict=True)
        return Weighed(
            model=model.with_values(dict(means)),
            theta=theta,
            states=states,
            processes=processes,
            disturbances=system.disturbances,
            log_likelihood=found.evidence,
            log_evidence=float(evidence),
            log_training=float(training),
            names=unknown.names,
            at_bounds=tuple(np.array(unknown.names)[is_met].tolist()),
            covariance=covariance,
            force_shares=shares,
        )


def _within_bounds(problem: JointProblem, z: np.ndarray) -> np.ndarray:
    """The parameters that move and are at no bound."""
    values = problem.values
    n = len(values.unknown)
    is_met = (z[:n] <= values.lower[:n]) | (z[:n] >= values.upper[:n])
    return problem.moving[~is_met[problem.moving]]


def _log_likelihood(border: Border, pull: np.ndarray) -> float:
    """Log likelihood of a record, or a part of it, at its own best parameters."""
    n = border.n_theta
    precision = border.precision.copy()
    log_det = np.linalg.slogdet(precision[n:, n:])[1]
    # Parameters move by their slope alone, whatever the functions do; and what the
    # record says little of goes no further than by its own scale.
    precision[:n, n:] = 0.0
    precision[n:, :n] = 0.0
    precision[:n, :n] += np.eye(n)
    gradient = np.concatenate([pull, border.gradient[n:]])
    misfit = border.constant - gradient @ solve_border(precision, gradient)
    return float(border.log_constant - (misfit + log_det) / 2 + border.log_prior)


def _beside(
    problem: JointProblem, z: np.ndarray, processes: np.ndarray | None
) -> JointPoint | None:
    """Disturbances to begin with: those of before, functions of states at zero."""
    if processes is None:
        return None
    n = 0
    if problem.disturbances.functions:
        linear = problem.linearized(z, problem.values.at(z))
        for function in problem.disturbances.functions:
            n += linear.function_values[function.state].shape[1]
    return JointPoint(z, processes, np.zeros(n))


@dataclass(frozen=True, eq=False)
class EvidenceRecord:
    """Measurements by which models are weighed: those of the fit, and held out."""

    weighing: Weighing  # how
    base: Weighed = field(repr=False)  # the model of the fit, weighed

    @classmethod
    def of(cls, trained: Record, judged: Record | None) -> "EvidenceRecord":
        """Of the records of one fit, whose model is weighed from its missing force.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        records = [trained] if judged is None else [trained, judged]
        data = _joined([record.data for record in records])
        estimate = trained.estimate
        n_more = trained.model.n_states - len(estimate.white)
        white = np.r_[estimate.white, np.ones(n_more)]
        sigma = np.tile(white, (data.n_trajectories, 1))
        noise = NoiseLevels.beside_force(data)
        aligned = AlignedData.of(trained.model, data)
        # Of the missing force, with the memory of the model.
        runs = []
        for one in records:
            found = one.estimate
            runs.append(with_memory(one.model, found.grid, found.x, one.theta))
        states = np.concatenate(runs)
        disturbances = replace(estimate.disturbances, sigma=sigma)
        times = [force.time for force in disturbances.processes]
        rates = aligned.grid.rates(states)
        weighing = Weighing(
            aligned=aligned,
            n_fitted=trained.data.n_trajectories,
            n_states=states.shape[1],
            channels=noise.channels(aligned.grid),
            least_noise=noise.least,
            longest=max(times, default=np.inf),
            rates=np.sqrt(np.mean(rates**2, axis=0)) + TINY,
        )
        model = trained.model.with_values(estimate.rounded)
        parameters = np.hstack([record.theta for record in records])
        parameters = _at_their_bounds(trained.fit, parameters)
        start = Start(
            model=model,
            theta=Theta.of(model, weighing.runs).stacked(parameters),
            states=states,
            processes=None,
            disturbances=disturbances,
        )
        return cls(weighing, weighing.weighed(start))

    @property
    def n_fitted_nodes(self) -> int:
        """Number of nodes of the measurements that the fit was made from."""
        grid = self.weighing.aligned.grid
        return int(np.sum(grid.trajectory < self.weighing.n_fitted))

    def better_from(self, larger: Weighed) -> "EvidenceRecord | None":
        """With the base begun where a larger model is; None where that is no likelier.

        A model has the evidence of the best point that it can have, and a larger one
        that has gained by more than its own size has found a better one.
        """
        worth = self.base.log_likelihood + STRONG_EVIDENCE
        return self._better(self._within(larger, self.base.model), worth)

    def better_at(self, values: Mapping[str, float]) -> "EvidenceRecord | None":
        """The same begun at other values of its parameters.

        A fit without a force may have led to where the model hardly moves, and what it
        lacks cannot be told.
        """
        theta = self._start(self.base.model, {}).theta
        unknown = Theta.of(self.base.model, self.weighing.runs)
        theta = unknown.from_values(values, theta)
        theta = np.clip(theta, unknown.lower, unknown.upper)
        return self._better(replace(self.base, theta=theta, processes=None), -np.inf)

    def _better(self, start: Start, worth: float) -> "EvidenceRecord | None":
        try:
            found = self.weighing.weighed(start, worth)
        except SolveError:
            return None
        if found.log_evidence < self.base.log_evidence + STRONG_EVIDENCE:
            return None
        return replace(self, base=found)

    def weighed_within(self, larger: Weighed, model: Model) -> Weighed:
        """A model that a larger one contains, begun where the larger one is likeliest.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        return self.weighing.weighed(self._within(larger, model))

    def _within(self, larger: Weighed, model: Model) -> Start:
        unknown = Theta.of(model, self.weighing.runs)
        own = list(map(larger.names.index, unknown.names))
        states = larger.states[:, list(map(larger.model.states.index, model.states))]
        sigma = larger.disturbances.sigma[:, : self.weighing.n_states]
        return Start(
            model=model,
            theta=larger.theta[own],
            states=states,
            processes=larger.processes,
            disturbances=replace(larger.disturbances, sigma=sigma),
        )

    def weighed(
        self, model: Model, values: Mapping[str, float], worth: float = -np.inf
    ) -> Weighed:
        """A larger model with values of what is new, begun where the base is likeliest.

        Rounds end where it promises to be no likelier than the base, or has less than a
        log likelihood ``worth``.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        least = max(worth, self.base.log_likelihood)
        return self.weighing.weighed(self._start(model, values), least)

    def _start(self, model: Model, values: Mapping[str, float]) -> Start:
        """A larger model with values of what is new, where the base is likeliest."""
        base = self.base
        unknown = Theta.of(model, self.weighing.runs)
        known = dict(values) | dict(zip(base.names, base.theta.tolist(), strict=True))
        default = unknown.spread(np.array([model.values[n] for n in model.free]))
        theta = unknown.from_values(known, default)
        theta = np.clip(theta, unknown.lower, unknown.upper)
        grid = self.weighing.aligned.for_model(model).grid
        return Start(
            model=model,
            theta=theta,
            states=with_memory(model, grid, base.states, theta[unknown.table]),
            processes=base.processes,
            disturbances=base.disturbances,
        )

    def volume_slopes(
        self, model: Model, values: Mapping[str, float], names: Sequence[str]
    ) -> np.ndarray:
        """Slopes of -1/2 log|det K| in some parameters of a larger model, (n_names,).

        K is the optimality system of states and forces (`JointProblem.tilted`).
        """
        problem = self.weighing.problem(self._start(model, values))
        unknown = problem.values.unknown
        places = np.array(list(map(unknown.names.index, names)), dtype=int)
        problem = replace(problem, moving=places)
        found = problem.optimum(problem.values.point.scaled, 0)
        slopes = problem.tilted(found).slope / problem.values.point.theta_scale
        return np.asarray(slopes[places])

    def log_noise(self, weighed: Weighed) -> float:
        """Log likelihood that a model would have if what it leaves were noise.

        No force acts, so that starting states and parameters alone are integrated out,
        and the squares of the residuals are as many as these leave free.
        """
        sizes = replace(weighed.disturbances, forces=())
        start = replace(weighed, processes=None, disturbances=sizes)
        problem = self.weighing.problem(start)
        # The slopes alone are of interest: of the states that the force explains.
        problem = replace(problem, moving=problem.moving[:0])
        found = problem.optimum(problem.values.point.scaled, 0)
        system = found.likelihood.at(sizes)
        n_free = system.n_free - len(weighed.theta)
        volume = system.border.log_constant - system.n_free * np.log(2 * np.pi) / 2
        return float(volume - n_free / 2)

    def held_as(self, hold: Hold) -> "EvidenceRecord":
        """With inputs that do otherwise between their samples.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        aligned = self.weighing.aligned.held_as(hold, ())
        weighing = replace(self.weighing, aligned=aligned)
        return EvidenceRecord(weighing, weighing.weighed(self.base))

    def fitted(self, comparisons: Sequence[Comparison], has_force: bool) -> Weighed:
        """A fitted model begun at its free runs, training first; with or without force.

        Raises:
            SolveError: no such states were found.
        """
        model = comparisons[0].model
        parameters = np.hstack([one.record.theta for one in comparisons])
        sizes = self.base.disturbances
        start = Start(
            model=model,
            theta=Theta.of(model, self.weighing.runs).stacked(parameters),
            states=np.concatenate([x for one in comparisons for x in one.simulated]),
            processes=None,
            disturbances=sizes if has_force else replace(sizes, forces=()),
        )
        return self.weighing.weighed(start)

    def likelihood(self, weighed: Weighed) -> MarginalLikelihood:
        """The record linearised where a model is most likely.

        Without a tilt: what an effect does to the volume is not known before it is
        weighed, and that of the parameters alone would be no fair start.
        """
        problem = self.weighing.problem(weighed)
        return problem.optimum(problem.values.point.scaled, 0).likelihood


def _at_their_bounds(fit: Fit, parameters: np.ndarray) -> np.ndarray:
    """Parameters of a fit, (n_free, n_trajectories), those at a bound exactly there."""
    # A solver stops a hair beside it, and that hair says nothing of a parameter's size.
    exact = parameters.copy()
    for place, name in enumerate(fit.model.free):
        if name in fit.outcome.at_bounds:
            bound = fit.model.entries[name].parameter.nearest_bound
            exact[place] = list(map(bound, parameters[place]))
    return exact


def _joined(parts: list[Measurements]) -> Measurements:
    """Measurements one behind the other; a name that comes twice is told apart."""
    first, *others = parts
    trajectories = list(first.trajectories)
    for part in others:
        names = {run.name for run in trajectories}
        for run in part.trajectories:
            name = run.name
            while name in names:
                name += " (held out)"
            names.add(name)
            trajectories.append(replace(run, name=name))
    return replace(first, trajectories=tuple(trajectories))
