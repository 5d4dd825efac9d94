"""Measurements of a fit, with those held out, beside which models are weighed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import STRONG_EVIDENCE
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise
from phsi_opt.data.resolution import quantisation_noise
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.force_search import LEAST_NOISE_BESIDE_SCATTER
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model
from phsi_opt.model_error.disturbances import StateFunction
from phsi_opt.model_error.marginal_likelihood import MarginalLikelihood
from phsi_opt.screening.weighing import Start, Weighed, Weighing
from phsi_opt.statistics import TINY
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.parameter_vector import Theta


@dataclass(frozen=True, eq=False)
class EvidenceRecord:
    """Measurements beside which models are weighed: those of the fit, and held out.

    Attributes:
        weighing: how.
        base: the model of the fit, weighed.
    """

    weighing: Weighing
    base: Weighed = field(repr=False)

    @classmethod
    def of(cls, trained: Record, judged: Record | None) -> "EvidenceRecord":
        """Of the records of one fit, whose model is weighed from its missing force.

        Args:
            trained: of the fit's own measurements.
            judged: of those held out; None: there are none.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
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
        states = np.concatenate([_states_of(record) for record in records])
        disturbances = replace(estimate.disturbances, sigma=sigma)
        times = [force.time for force in disturbances.processes]
        rates = aligned.grid.rates(states)
        weighing = Weighing(
            aligned=aligned,
            n_fitted=trained.data.n_trajectories,
            n_states=states.shape[1],
            channels=tuple(np.flatnonzero(measured & ~is_given).tolist()),
            least_noise=least,
            longest=max(times, default=np.inf),
            rates=np.sqrt(np.mean(rates**2, axis=0)) + TINY,
        )
        model = trained.model.with_values(estimate.rounded)
        unknown = Theta.of(model, weighing.runs)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = _at_their_bounds(
            trained.fit, np.hstack([record.theta for record in records])
        )
        start = Start(model, theta, states, None, disturbances)
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
        own = [larger.names.index(name) for name in self.base.names]
        n_states = self.weighing.n_states
        sigma = larger.disturbances.sigma[:, :n_states]
        start = Start(
            self.base.model,
            larger.theta[own],
            larger.states[:, :n_states],
            larger.processes,
            replace(larger.disturbances, sigma=sigma),
        )
        worth = self.base.log_likelihood + STRONG_EVIDENCE
        try:
            found = self.weighing.weighed(start, worth)
        except SolveError:
            return None
        if found.log_evidence < self.base.log_evidence + STRONG_EVIDENCE:
            return None
        return replace(self, base=found)

    def weighed(self, model: Model, values: Mapping[str, float]) -> Weighed:
        """A model that is larger than the base, begun where the base is likeliest.

        Args:
            model: the base with something more.
            values: of what is new, from which to start.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        base = self.base
        unknown = Theta.of(model, self.weighing.runs)
        known = dict(zip(base.names, base.theta.tolist(), strict=True))
        for name, value in values.items():
            known.setdefault(name, value)
        default = unknown.spread(np.array([model.values[n] for n in model.free]))
        theta = unknown.from_values(known, default)
        theta = np.clip(theta, unknown.lower, unknown.upper)
        grid = self.weighing.aligned.for_model(model).grid
        states = with_memory(model, grid, base.states, theta[unknown.table])
        start = Start(model, theta, states, base.processes, base.disturbances)
        return self.weighing.weighed(start, base.log_likelihood)

    def without_force(self, comparisons: Sequence[Comparison]) -> Weighed:
        """A fitted model without any force, begun at its free runs.

        Args:
            comparisons: of the fit with the measurements, those of the fit first.

        Raises:
            SolveError: no such states were found.
        """
        model = comparisons[0].model
        unknown = Theta.of(model, self.weighing.runs)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = np.hstack([one.record.theta for one in comparisons])
        runs: list[np.ndarray] = []
        for one in comparisons:
            runs += one.simulated
        states = np.concatenate(runs)
        noise = replace(self.base.disturbances, forces=())
        return self.weighing.weighed(Start(model, theta, states, None, noise))

    def with_functions(self, equation: int) -> Weighed | None:
        """The base with an unknown smooth function of one state in an equation.

        The most likely of them; None where there is none.
        """
        base = self.base
        best = None
        rates = self.weighing.aligned.grid.rates(base.states)
        size = float(np.sqrt(np.mean(rates[:, equation] ** 2)))
        memory = base.model.memory
        for state, name in enumerate(base.model.states):
            if name in memory:
                continue
            function = StateFunction(equation, state, size)
            sizes = base.disturbances.with_functions((function,))
            start = replace(base.start, disturbances=sizes)
            try:
                found = self.weighing.weighed(start)
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
        problem = self.weighing.problem(weighed.start)
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
