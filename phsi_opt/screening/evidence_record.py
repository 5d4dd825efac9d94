"""Measurements of a fit, with those held out, beside which models are weighed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import STRONG_EVIDENCE
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise
from phsi_opt.data.resolution import quantisation_noise
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.force_search import LEAST_NOISE_BESIDE_SCATTER
from phsi_opt.estimation.missing_force import ROUNDER
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.model.model import Model
from phsi_opt.model_error.disturbances import Disturbances, StateFunction
from phsi_opt.model_error.marginal_likelihood import MarginalLikelihood
from phsi_opt.screening.weighing import Start, Weighed, Weighing
from phsi_opt.statistics import TINY
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.parameter_vector import Theta

SMALLER = 0.01  # factor on the force of a second attempt


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
        known: the base where it is weighed already; None: it is not.
    """

    aligned: AlignedData
    n_fitted: int
    first: Model
    parameters: np.ndarray
    states: np.ndarray = field(repr=False)
    disturbances: Disturbances = field(repr=False)
    channels: tuple[int, ...]
    least_noise: np.ndarray
    known: Weighed | None = field(default=None, repr=False)

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
        return self._weighing.runs

    @property
    def n_fitted_nodes(self) -> int:
        """Number of nodes of the measurements that the fit was made from."""
        return int(np.sum(self.aligned.grid.trajectory < self.n_fitted))

    @cached_property
    def _weighing(self) -> Weighing:
        times = [force.time for force in self.disturbances.processes]
        rates = self.aligned.grid.rates(self.states)
        return Weighing(
            aligned=self.aligned,
            n_fitted=self.n_fitted,
            n_states=self.states.shape[1],
            channels=self.channels,
            least_noise=self.least_noise,
            longest=max(times, default=np.inf),
            rates=np.sqrt(np.mean(rates**2, axis=0)) + TINY,
        )

    @cached_property
    def base(self) -> Weighed:
        """The model of the fit, weighed.

        From the missing force, or from one that is far smaller where that fails.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        if self.known is not None:
            return self.known
        unknown = Theta.of(self.first, self.runs)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = self.parameters
        start = Start(self.first, theta, self.states, None, self.disturbances)
        try:
            return self._weighing.weighed(start)
        except SolveError:
            forces = self.disturbances.forces
            smaller = tuple(replace(one, size=SMALLER * one.size) for one in forces)
            small = replace(self.disturbances, forces=smaller)
            return self._weighing.weighed(replace(start, disturbances=small))

    def better_from(self, larger: Weighed) -> "EvidenceRecord | None":
        """With the base begun where a larger model is; None where that is no likelier.

        A model has the evidence of the best point that it can have, and a larger one
        that has gained by more than its own size has found a better one.
        """
        own = [larger.names.index(name) for name in self.base.names]
        n_states = self.states.shape[1]
        sigma = larger.disturbances.sigma[:, :n_states]
        start = Start(
            self.first,
            larger.theta[own],
            larger.states[:, :n_states],
            larger.processes,
            replace(larger.disturbances, sigma=sigma),
        )
        worth = self.base.log_likelihood + STRONG_EVIDENCE
        try:
            found = self._weighing.weighed(start, worth)
        except SolveError:
            return None
        if found.log_evidence < self.base.log_evidence + STRONG_EVIDENCE:
            return None
        return replace(self, known=found)

    def weighed(self, model: Model, values: Mapping[str, float]) -> Weighed:
        """A model that is larger than the base, begun where the base is likeliest.

        Args:
            model: the base with something more.
            values: of what is new, from which to start.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        base = self.base
        unknown = Theta.of(model, self.runs)
        names = Theta.of(self.first, self.runs).names
        known = dict(zip(names, base.theta.tolist(), strict=True))
        for name, value in values.items():
            known.setdefault(name, value)
        default = unknown.spread(np.array([model.values[n] for n in model.free]))
        theta = unknown.from_values(known, default)
        theta = np.clip(theta, unknown.lower, unknown.upper)
        grid = self.aligned.for_model(model).grid
        states = with_memory(model, grid, base.states, theta[unknown.table])
        start = Start(model, theta, states, base.processes, base.disturbances)
        return self._weighing.weighed(start, base.log_likelihood)

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
        runs: list[np.ndarray] = []
        for one in comparisons:
            runs += one.simulated
        states = np.concatenate(runs)
        noise = replace(self.base.disturbances, forces=())
        return self._weighing.weighed(Start(model, theta, states, None, noise))

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
            sizes = base.disturbances.with_functions((function,))
            start = replace(base.start, disturbances=sizes)
            try:
                found = self._weighing.weighed(start)
            except SolveError:
                continue
            if best is None or found.log_evidence > best.log_evidence:
                best = found
        return best

    def likelihood(self, weighed: Weighed) -> MarginalLikelihood:
        """The record linearised where a model is most likely.

        Without a tilt: what an effect does to the volume is not known before it is
        weighed, and that of the parameters alone would be no fair start.
        """
        problem = self._weighing.problem(weighed.start)
        return problem.optimum(problem.values.point.scaled, 0).likelihood


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
