"""Models weighed beside a force that could have done the same.

A model is worth the evidence of the measurements when a lasting force of unknown size
acts in its equations too::

    log Z = log p(y | theta, sizes) - k/2 log n + log p(starting states)

with parameters, states and forces where they are most likely together, the sizes of
noise and forces where the evidence is largest, and Schwarz' price for each of the k
parameters (Annals of Statistics 6, 1978). Starting states have a flat prior over the
range of the motion, so that the scale of a state that nobody measured does not count;
the memory of an effect begins near rest. The difference of two models is the logarithm
of a Bayes factor: what a law gains is what it explains better than a force without a
law.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise
from phsi_opt.data.resolution import quantisation_noise
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.force_search import LEAST_NOISE_BESIDE_SCATTER
from phsi_opt.estimation.missing_force import ROUNDER
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.model import Model
from phsi_opt.model_error.ascent import climbed
from phsi_opt.model_error.coordinates import Coordinates
from phsi_opt.model_error.disturbance_search import MOST_SIZES
from phsi_opt.model_error.disturbances import Disturbances, StateFunction
from phsi_opt.model_error.joint_estimate import JointEstimate, JointPoint, JointProblem
from phsi_opt.model_error.linearization import linearized
from phsi_opt.model_error.marginal_likelihood import Border, MarginalLikelihood
from phsi_opt.statistics import TINY
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Theta

SCHEME = "srk4"  # the integrator of the dynamics
MOST_ROUNDS = 6  # of steps with given sizes, each followed by better sizes
STEPS_OF_A_ROUND = 12
CLIMBS_OF_A_ROUND = 6  # steps of the sizes uphill
# Shortest correlation time of a force, in sampling intervals.
SHORTEST_FORCE = 2.0
# Change of the logarithm of every size at which the rounds end, and gain of the
# evidence by a round that makes no difference to a verdict.
SETTLED_SIZES = 0.02
SETTLED_EVIDENCE = 0.1
# A model that has not come to rest in so many rounds is given up, and one whose
# evidence is so far below that of the base.
ROUNDS_TO_REST = 3
HOPELESS = 10.0
# Factor between values at which an inner number is held, and how many are tried to
# either side of the first.
SCAN_FACTOR = 1.15
MOST_SCANNED = 4
SMALLER = 0.01  # factor on the force of a second attempt
# Size of a force, as a share of the rate in its equation, that is as good as none, and
# one beyond which it is no disturbance of the motion but in its place.
NO_FORCE = 1e-5
LARGEST_FORCE = 3.0
# Violation of the scaled dynamics up to which states obey them well enough, and length
# of a last step, in standard deviations of all that is unknown, up to which the record
# is linear enough for an evidence.
OBEYED = 1e-3
SHORT = 1.0


@dataclass(frozen=True, eq=False)
class Weighed:
    """A model beside the forces that it leaves open, where both are most likely.

    Attributes:
        model: with its values; a mean where trajectories have their own.
        log_likelihood: of all measurements, states and forces integrated out.
        log_evidence: the same with the priors.
        log_training: of those that the fit was made from, alone.
        names: of the parameters, (n_theta,).
        at_bounds: names of those that ended at a bound.
        theta: (n_theta,); ``covariance``: of them, forces of these sizes acting.
        states: (n_nodes, n_states).
        processes: values of forces and errors of sensors, forces first.
        disturbances: noise, forces and errors of sensors, with their sizes.
        force_shares: root mean square of each force over that of the rates in its
            equation, by the number of the equation.
    """

    model: Model
    log_likelihood: float
    log_evidence: float
    log_training: float
    names: tuple[str, ...]
    at_bounds: tuple[str, ...]
    theta: np.ndarray
    covariance: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)
    processes: np.ndarray = field(repr=False)
    disturbances: Disturbances = field(repr=False)
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
class EvidenceRecord:
    """Measurements beside which models are weighed: those of the fit, and held out.

    Attributes:
        aligned: all of them, those of the fit first.
        n_fitted: number of trajectories that the fit was made from.
        first: the model of the fit, its corners rounded as the missing force asks.
        parameters: its free parameters, (n_free, n_trajectories).
        states: of the missing force, (n_nodes, n_states), where a search begins.
        disturbances: of the missing force, with their sizes.
        channels: measured states whose noise is not known.
        least_noise: (n_states,) below which that does not fall.
    """

    aligned: AlignedData
    n_fitted: int
    first: Model
    parameters: np.ndarray
    states: np.ndarray = field(repr=False)
    disturbances: Disturbances = field(repr=False)
    channels: tuple[int, ...]
    least_noise: np.ndarray

    @classmethod
    def of(cls, trained: Record, judged: Record | None) -> "EvidenceRecord":
        """Of the records of one fit; ``judged`` where data were held out."""
        records = [trained] if judged is None else [trained, judged]
        data = _joined([record.data for record in records])
        estimate = trained.estimate
        n_more = trained.model.n_states - len(estimate.white)
        white = np.r_[estimate.white, np.ones(n_more)]
        sigma = np.tile(white, (data.n_trajectories, 1))
        given = np.array([(data.noise or {}).get(name, np.nan) for name in data.states])
        is_given = np.isfinite(given)
        scatter = np.where(is_given, given, initial_noise(data))
        least = np.maximum(
            quantisation_noise(data), LEAST_NOISE_BESIDE_SCATTER * scatter
        )
        aligned = AlignedData.of(trained.model, data)
        measured = aligned.grid.measured.any(axis=0)
        record = cls(
            aligned=aligned,
            n_fitted=trained.data.n_trajectories,
            first=trained.model.with_values(estimate.rounded),
            parameters=_at_their_bounds(
                trained.fit, np.hstack([record.theta for record in records])
            ),
            states=np.concatenate([_states_of(record) for record in records]),
            disturbances=replace(estimate.disturbances, sigma=sigma),
            channels=tuple(np.flatnonzero(measured & ~is_given).tolist()),
            least_noise=least,
        )
        return record._rounded_enough()

    def _rounded_enough(self) -> "EvidenceRecord":
        """The same with corners of dry friction as round as the steps need them.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        model = self.first
        widths = {name: model.values[name] for name in corner_widths(model)}
        for factor in ROUNDER if widths else ROUNDER[:1]:
            rounded = {name: factor * width for name, width in widths.items()}
            record = replace(self, first=model.with_values(rounded))
            try:
                record.base  # noqa: B018
            except SolveError as error:
                failure = error
                continue
            return record
        raise failure

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the trajectories."""
        return tuple(run.name for run in self.aligned.data.trajectories)

    @property
    def n_fitted_nodes(self) -> int:
        """Number of nodes of the measurements that the fit was made from."""
        return int(np.sum(self.aligned.grid.trajectory < self.n_fitted))

    @cached_property
    def base(self) -> Weighed:
        """The model of the fit, weighed.

        From the missing force, or from one that is far smaller where that fails.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        start = self._beginning(None)
        try:
            return self._weighed(start)
        except SolveError:
            forces = []
            for force in self.disturbances.forces:
                forces.append(replace(force, size=SMALLER * force.size))
            small = replace(self.disturbances, forces=tuple(forces))
            return self._weighed(replace(start, disturbances=small))

    def weighed(self, model: Model, values: Mapping[str, float]) -> Weighed:
        """A model that is larger than the base, begun beside it.

        Args:
            model: the base with something more.
            values: of its parameters, from which to start.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        beside = self.base
        try:
            return self._weighed_from(self._beginning(beside), model, values)
        except SolveError:
            # Beside a force that does nearly everything the base has lost its way.
            return self._weighed_from(self._beginning(None), model, values)

    def _beginning(self, beside: Weighed | None) -> "_Start":
        """The base where it is most likely; None: where it was fitted."""
        if beside is not None:
            return _Start(
                self.first,
                beside.theta,
                beside.states,
                beside.processes,
                beside.disturbances,
            )
        unknown = Theta.of(self.first, self.runs)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = self.parameters
        return _Start(self.first, theta, self.states, None, self.disturbances)

    def _weighed_from(
        self, begin: "_Start", model: Model, values: Mapping[str, float]
    ) -> Weighed:
        """A larger model, with its one inner number scanned where steps do not settle.

        Raises:
            SolveError: it cannot be weighed.
        """
        inner = self._inner_names(model)
        if begin.processes is None:
            values = {n: x for n, x in values.items() if n not in self.first.entries}
        try:
            return self._begun_beside(begin, model, values)
        except SolveError:
            if not inner:
                raise
        held = frozenset(inner)
        if len(inner) > 1:
            return self._begun_beside(begin, model, values, held)
        return self._scanned(begin, model, values, held)

    def _begun_beside(
        self,
        begin: "_Start",
        model: Model,
        values: Mapping[str, float],
        held: frozenset[str] = frozenset(),
    ) -> Weighed:
        """A larger model, begun beside the base; ``held``: parameters that stay."""
        unknown = Theta.of(model, self.runs)
        names = Theta.of(self.first, self.runs).names
        known = {**dict(zip(names, begin.theta.tolist(), strict=True)), **values}
        default = unknown.spread(np.array([model.values[n] for n in model.free]))
        theta = unknown.from_values(known, default)
        theta = np.clip(theta, unknown.lower, unknown.upper)
        by_run = theta[unknown.table]
        grid = self.aligned.for_model(model).grid
        states = with_memory(model, grid, begin.states, by_run)
        start = replace(begin, model=model, theta=theta, states=states, held=held)
        return self._weighed(start, self.base.log_likelihood)

    def _scanned(
        self,
        begin: "_Start",
        model: Model,
        values: Mapping[str, float],
        held: frozenset[str],
    ) -> Weighed:
        """A model whose one inner number is held at values, uphill from the first.

        For one along which no steps settle, such as a delay below a sample.

        Raises:
            SolveError: it cannot be weighed with the first value.
        """
        (name,) = held
        first = values.get(name, model.values[name])
        found: dict[int, Weighed] = {}

        def at(place: float) -> Weighed:
            moved = {**values, name: first * SCAN_FACTOR**place}
            return self._begun_beside(begin, model, moved, held)

        found[0] = at(0)
        for step in (-1, 1):
            place = 0
            while abs(place) < MOST_SCANNED:
                try:
                    found[place + step] = at(place + step)
                except SolveError:
                    break
                place += step
                if found[place].log_evidence < found[place - step].log_evidence:
                    break
        best = max(found, key=lambda place: found[place].log_evidence)
        if {best - 1, best + 1} <= found.keys():
            below, here, above = (
                found[k].log_evidence for k in (best - 1, best, best + 1)
            )
            vertex = best + (below - above) / (2 * (below - 2 * here + above))
            with suppress(SolveError):
                top = at(vertex)
                if top.log_evidence > here:
                    return top
        return found[best]

    def without_force(self, comparisons: Sequence[Comparison]) -> Weighed:
        """A fitted model without any force, begun at its free runs.

        Args:
            comparisons: of the fit with the measurements, those of the fit first.

        Raises:
            SolveError: no such states were found.
        """
        model = comparisons[0].model
        unknown = Theta.of(model, self.runs)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = np.hstack([one.record.theta for one in comparisons])
        states = np.concatenate([run for one in comparisons for run in one.simulated])
        noise = replace(self.base.disturbances, forces=())
        return self._weighed(_Start(model, theta, states, None, noise))

    def with_functions(self, equation: int) -> Weighed | None:
        """The base with an unknown smooth function of one state in an equation.

        The most likely of them; None where there is none.
        """
        base = self.base
        best = None
        rates = self.aligned.grid.rates(base.states)
        size = float(np.sqrt(np.mean(rates[:, equation] ** 2)))
        memory = self.first.memory
        for state, name in enumerate(self.first.states):
            if name in memory:
                continue
            function = StateFunction(equation, state, size)
            start = _Start(
                self.first,
                base.theta,
                base.states,
                base.processes,
                base.disturbances.with_functions((function,)),
            )
            try:
                found = self._weighed(start)
            except SolveError:
                continue
            if best is None or found.log_evidence > best.log_evidence:
                best = found
        return best

    def likelihood(self, weighed: Weighed) -> MarginalLikelihood:
        """The record linearised where a model is most likely."""
        start = _Start(
            weighed.model,
            weighed.theta,
            weighed.states,
            weighed.processes,
            weighed.disturbances,
        )
        problem = self._problem(start)
        z = problem.values.point.scaled
        linear = linearized(problem.values, z, problem.values.at(z))
        return MarginalLikelihood(
            linear, weighed.disturbances.structure, problem.moving
        )

    def _problem(self, start: "_Start") -> JointProblem:
        model = start.model
        grid = self.aligned.for_model(model).grid
        unknown = Theta.of(model, self.runs)
        is_held = (start.theta <= unknown.lower) | (start.theta >= unknown.upper)
        held = {model.free[owner] for owner in unknown.owner[is_held]}
        point = point_at(model, grid, unknown, start.theta, start.states, held)
        grid = self._with_memory_at_rest(grid, start.states)
        values = LikelihoodValues(model, grid, SCHEME, point, unknown)
        return JointProblem(values, start.disturbances, np.arange(len(unknown)))

    def _with_memory_at_rest(self, grid: Grid, states: np.ndarray) -> Grid:
        """The memory of an effect is known to begin near rest, as if measured."""
        n_old = self.states.shape[1]
        if grid.y.shape[1] == n_old:
            return grid
        y = grid.y.copy()
        y[grid.first, n_old:] = states[grid.first, n_old:]
        return replace(grid, y=y)

    def _weighed(self, start: "_Start", worth: float = -np.inf) -> Weighed:
        """Steps with given sizes and better sizes by turns, until both stay.

        Inner numbers of what is new are held in the first of them.

        Args:
            start: where to begin.
            worth: log likelihood that the base has.
        """
        with np.errstate(all="ignore"):
            return self._weighed_quietly(start, worth)

    def _weighed_quietly(self, start: "_Start", worth: float) -> Weighed:
        start = start.padded(self.states.shape[1])
        problem = self._problem(start)
        z = problem.values.point.scaled
        processes = start.processes
        best = None
        names = problem.values.unknown.names
        held = [names.index(name) for name in start.held]
        inner = [names.index(one) for one in self._inner_names(start.model)]
        if held:
            problem = replace(problem, moving=np.delete(problem.moving, held))
        elif inner:
            first = replace(problem, moving=np.delete(problem.moving, inner))
            joint = first.optimum(z, STEPS_OF_A_ROUND, _beside(first, z, processes))
            z, processes = joint.point.z, joint.point.processes
        for number in range(MOST_ROUNDS):
            joint = problem.optimum(z, STEPS_OF_A_ROUND, _beside(problem, z, processes))
            z, processes = joint.point.z, joint.point.processes
            problem = self._without_bounds_met(problem, z)
            likelihood = MarginalLikelihood(
                joint.linear, problem.disturbances.structure, problem.moving
            )
            sizes = self._better_sizes(likelihood, problem.disturbances)
            change = _largest_change(problem.disturbances, sizes)
            problem = replace(problem, disturbances=sizes)
            found = _Found(joint, likelihood, sizes)
            gain = np.inf if best is None else found.evidence - best.evidence
            if best is None or found.is_better_than(best):
                best = found
            is_settled = change < SETTLED_SIZES or abs(gain) < SETTLED_EVIDENCE
            if is_settled and joint.has_converged:
                break
            if number + 1 == ROUNDS_TO_REST and not best.is_valid:
                break
            if best.is_valid and best.evidence < worth - HOPELESS:
                break
        assert best is not None
        if not best.is_valid:
            raise SolveError(
                "the model could not be weighed: no states obey it beside a force "
                f"(largest violation {best.joint.violation:.2g}, last step of "
                f"{best.joint.length:.2g} standard deviations)."
            )
        return self._result(problem, best)

    def _inner_names(self, model: Model) -> list[str]:
        """New free parameters in which a model is not linear."""
        names = []
        for name in model.free:
            if name not in self.first.entries and not model.entries[name].prunable:
                names.append(name)
        return names

    def _without_bounds_met(self, problem: JointProblem, z: np.ndarray) -> JointProblem:
        """Parameters that a step has left at a bound stay there."""
        values = problem.values
        n = len(values.unknown)
        is_met = (z[:n] <= values.lower[:n]) | (z[:n] >= values.upper[:n])
        moving = problem.moving[~is_met[problem.moving]]
        return replace(problem, moving=moving)

    def _better_sizes(
        self, likelihood: MarginalLikelihood, sizes: Disturbances
    ) -> Disturbances:
        """Sizes and times moved to the largest evidence of the linearised record."""
        problem = likelihood.problem
        grid = problem.grid
        rates = np.sqrt(np.mean(grid.rates(problem.nodes) ** 2, axis=0)) + TINY
        n_more = problem.n_states - len(self.least_noise)
        functions = [float(rates[f.equation]) for f in sizes.functions]
        coordinates = Coordinates(
            origin=sizes,
            channels=self.channels,
            least_noise=np.r_[self.least_noise, np.zeros(n_more)],
            shortest=SHORTEST_FORCE * float(np.median(grid.h)),
            longest=self.longest,
            largest_functions=tuple(functions),
            is_tied=len(self.channels) + len(sizes.processes) > MOST_SIZES,
        )
        found = climbed(likelihood, coordinates, self.channels, CLIMBS_OF_A_ROUND)
        sizes = coordinates.at(found.vector)
        forces = []
        for force in sizes.forces:
            rate = float(rates[force.place])
            size = float(np.clip(force.size, NO_FORCE * rate, LARGEST_FORCE * rate))
            forces.append(replace(force, size=size))
        return replace(sizes, forces=tuple(forces))

    @property
    def longest(self) -> float:
        """Correlation time of a force, at most: a share of a trajectory."""
        times = [force.time for force in self.disturbances.processes]
        return max(times, default=np.inf)

    def _result(self, problem: JointProblem, found: "_Found") -> Weighed:
        point = problem.values.point
        unknown = problem.values.unknown
        values = point.unscaled(found.joint.point.z)
        theta = values["theta"]
        states = values["x"].reshape(point.x.shape)
        model = problem.values.model
        means = unknown.means(theta).tolist()
        price = self._price(problem, states)
        likelihood, sizes = found.likelihood, found.sizes
        borders = likelihood.borders_by_run(sizes)
        fitted = Border.sum(borders[: self.n_fitted])
        n_fitted_values = self._n_values(self.n_fitted)
        share = n_fitted_values / self._n_values(len(borders))
        k = len(theta)
        training = _profiled(fitted, sizes)
        training -= k * np.log(n_fitted_values) / 2 + price * share
        evidence = found.evidence
        evidence -= k * np.log(self._n_values(len(borders))) / 2 + price
        covariance = np.full((k, k), np.nan)
        scale = point.theta_scale[likelihood.moving]
        within = likelihood.at(sizes).covariance * np.outer(scale, scale)
        covariance[np.ix_(likelihood.moving, likelihood.moving)] = within
        n_intervals = likelihood.problem.grid.n_intervals
        n_forces = len(sizes.forces)
        processes = found.joint.point.processes
        forces = processes[: n_forces * n_intervals].reshape(n_forces, n_intervals)
        rates = likelihood.problem.grid.rates(states)
        places = [force.place for force in sizes.forces]
        typical = np.sqrt(np.mean(rates[:, places] ** 2, axis=0)) + TINY
        shares = np.sqrt(np.mean(forces**2, axis=1)) / typical
        return Weighed(
            model=model.with_values(dict(zip(model.free, means, strict=True))),
            log_likelihood=found.evidence,
            log_evidence=float(evidence),
            log_training=float(training) if len(borders) > self.n_fitted else evidence,
            names=unknown.names,
            at_bounds=_names_at_bounds(unknown, theta),
            theta=theta,
            covariance=covariance,
            states=states,
            processes=processes,
            disturbances=sizes,
            force_shares=dict(zip(places, shares.tolist(), strict=True)),
        )

    def _price(self, problem: JointProblem, states: np.ndarray) -> float:
        """Of starting states, flat over the range of their motion."""
        n_own = self.states.shape[1]
        spread = np.std(states[:, :n_own], axis=0) + TINY
        return len(self.runs) * float(np.sum(np.log(spread)))

    def _n_values(self, n_runs: int) -> int:
        grid = self.aligned.grid
        return int(grid.measured[grid.trajectory < n_runs].sum())


@dataclass(frozen=True, eq=False)
class _Start:
    """Where a model begins to be weighed."""

    model: Model
    theta: np.ndarray
    states: np.ndarray
    processes: np.ndarray | None
    disturbances: Disturbances
    held: frozenset[str] = frozenset()

    def padded(self, n_old: int) -> "_Start":
        """With a size for the memory that a trajectory begins with."""
        sigma = self.disturbances.sigma[:, :n_old]
        n_more = self.states.shape[1] - n_old
        spread = np.maximum(np.std(self.states[:, n_old:], axis=0), TINY)
        if not n_more:
            return self
        of_memory = np.tile(spread, (len(sigma), 1))
        sizes = replace(self.disturbances, sigma=np.hstack([sigma, of_memory]))
        return replace(self, disturbances=sizes)


@dataclass(frozen=True, eq=False)
class _Found:
    """Where steps ended, the record linearised there, and the sizes that it asks for.

    Attributes:
        joint: parameters, states and forces.
        likelihood: of the record linearised there.
        sizes: the most likely ones.
    """

    joint: JointEstimate
    likelihood: MarginalLikelihood
    sizes: Disturbances

    @cached_property
    def evidence(self) -> float:
        """Log likelihood, states and forces integrated out."""
        return self.likelihood.log_likelihood(self.sizes)

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


def _states_of(record: Record) -> np.ndarray:
    """Of a missing force, with the memory of the model, (n_nodes, n_states)."""
    estimate = record.estimate
    return with_memory(record.model, estimate.grid, estimate.x, record.theta)


def _at_their_bounds(fit: Fit, parameters: np.ndarray) -> np.ndarray:
    """Parameters of a fit, (n_free, n_trajectories), those at a bound exactly there.

    A solver stops a hair beside it, and that hair says nothing of a parameter's size.
    """
    exact = parameters.copy()
    for place, name in enumerate(fit.model.free):
        if name in fit.outcome.at_bounds:
            bound = fit.model.entries[name].parameter.nearest_bound
            exact[place] = [bound(value) for value in parameters[place]]
    return exact


def _names_at_bounds(unknown: Theta, theta: np.ndarray) -> tuple[str, ...]:
    is_met = (theta <= unknown.lower) | (theta >= unknown.upper)
    return tuple(np.array(unknown.names)[is_met].tolist())


def _profiled(border: Border, sizes: Disturbances) -> float:
    """Log likelihood of a part of the record at its own best parameters."""
    of_functions = np.array([function.size for function in sizes.functions])
    information = border.with_priors(of_functions)
    marginal = border.marginal(of_functions)
    inner = information[border.n_theta :, border.n_theta :]
    log_det = np.linalg.slogdet(information)[1] - np.linalg.slogdet(inner)[1]
    return float(marginal.log_evidence + log_det / 2)


def _beside(
    problem: JointProblem, z: np.ndarray, processes: np.ndarray | None
) -> JointPoint | None:
    """Disturbances to begin with: those of before, functions of states at zero."""
    if processes is None:
        return None
    n = 0
    if problem.disturbances.functions:
        linear = linearized(problem.values, z, problem.values.at(z))
        linear = replace(linear, linear_share=0.0)
        for function in problem.disturbances.functions:
            n += linear.function_values[function.state].shape[1]
    return JointPoint(z, processes, np.zeros(n))


def _largest_change(before: Disturbances, after: Disturbances) -> float:
    """Of the logarithm of a size."""
    changes = [float(np.max(np.abs(np.log(after.sigma / before.sigma))))]
    for old, new in zip(before.processes, after.processes, strict=True):
        changes.append(abs(float(np.log(new.size / old.size))))
    return max(changes)


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
