"""The model that is diagnosed, and larger models fitted beside it.

A re-fit begins where the effect was weighed and ends with free runs on both records.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from itertools import starmap
from typing import Protocol

import numpy as np

from phsi_opt.comparison.compare import (
    Comparison,
    compare_record,
    deviance,
    explained_share,
    is_failing,
    is_like_noise,
)
from phsi_opt.criteria import (
    HOLD_DELAY,
    ONE_ATTEMPT_INTERVALS,
    OTHER_OPTIMUM_DEVIANCE,
    REFIT_ITERATIONS,
    REFIT_TOLERANCE,
    STRAYED_STATES,
    STRONG_EVIDENCE,
    THOROUGH_ITERATIONS,
)
from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.errors import PhsiOptError, SolveError, some_of
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import fit_of_task, identify
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.maximum_likelihood import from_fit
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import corner_widths, resolve_guesses
from phsi_opt.model.effect import Effect, is_delay, is_scanned
from phsi_opt.model.laws import effects_words
from phsi_opt.model.model import Model
from phsi_opt.model_error.joint_estimate import STEPS_OF_A_PROBLEM
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.presentation.numbers import change_words, decimal
from phsi_opt.presentation.units import spaced
from phsi_opt.screening.effect_size import with_no_size
from phsi_opt.screening.weighing import EvidenceRecord
from phsi_opt.statistics import rms
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood, l1_weights
from phsi_opt.transcription.sensors import outputs_at_samples

# All limits are counts: a loaded machine gives the same verdict.
BRIEF = SolverSettings(
    tolerance=REFIT_TOLERANCE, max_iterations=REFIT_ITERATIONS, thorough=False
)


@dataclass(frozen=True, eq=False)
class DiagnosedModel:
    """A fit with its free runs, and how larger models are fitted."""

    trained: Comparison  # on the training record
    judged: Comparison  # on the record that judges; ``trained`` if none is held out
    loss: MaximumLikelihood
    say: Progress = silent
    executor: Executor | None = None  # for weighing candidates in parallel

    @classmethod
    def of(
        cls,
        trained: Comparison,
        judged: Comparison | None,
        loss: MaximumLikelihood | None,
        say: Progress = silent,
        executor: Executor | None = None,
    ) -> "DiagnosedModel":
        """Of a fit that was compared; with a random force, it is made again without.

        Such a force would hide what is missing.
        """
        loss = replace(loss or MaximumLikelihood(), model_error=False)
        base = cls(trained, judged or trained, loss, say, executor)
        fit = base.fit
        if not fit.has_model_error:
            return base
        aligned = base.record.aligned
        return base.with_fit(identify(fit.model, aligned, loss, start=fit))

    def with_fit(
        self, fit: Fit, change: Callable[[AlignedData], AlignedData] = lambda one: one
    ) -> "DiagnosedModel":
        """Another fit of the same records, or of changed ones, with its missing forces.

        Raises:
            SolveError: the missing force could not be estimated.
        """

        return self.on(lambda record: Record.of_aligned(fit, change(record.aligned)))

    def on(self, changed: Callable[[Record], Record]) -> "DiagnosedModel":
        """The free runs on changed records."""
        trained = judged = compare_record(changed(self.record))
        if self.is_held_out:
            judged = compare_record(changed(self.judged.record))
        return replace(self, trained=trained, judged=judged)

    def with_run(self, trained: Comparison) -> "DiagnosedModel":
        """A larger model with its free runs, beside the noise of this one."""
        judged = trained
        if self.is_held_out:
            judged = compare_record(self.judged.record.refitted(trained.fit))
        return replace(self, trained=trained, judged=judged)

    def held_as(self, hold: Hold, note: str) -> "DiagnosedModel":
        """The model fitted again to inputs that do otherwise between their samples.

        Raises:
            PhsiOptError: it could not be fitted.
        """

        def held(aligned: AlignedData) -> AlignedData:
            return aligned.held_as(hold, (note,))

        aligned = held(self.record.aligned)
        fit = identify(self.fit.model, aligned, self.loss, start=self.fit)
        return self.with_fit(fit, held)

    @property
    def fit(self) -> Fit:
        return self.trained.fit

    @property
    def record(self) -> Record:
        return self.trained.record

    @property
    def is_held_out(self) -> bool:
        """Whether data that were not fitted judge."""
        return self.judged is not self.trained

    @property
    def is_noise(self) -> bool:
        """Whether the free runs are off by no more than noise."""
        return is_like_noise(self.trained) and not is_failing(self.judged)

    @property
    def comparisons(self) -> list[Comparison]:
        """The free runs on the training record, and on the one held out if any."""
        return [self.trained, self.judged] if self.is_held_out else [self.trained]

    def evidence_record(self) -> EvidenceRecord:
        """The records, beside which larger models are weighed.

        The base begins at its fit, and where the fit began; the likelier counts.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        held_out = self.judged.record if self.is_held_out else None
        record = EvidenceRecord.of(self.record, held_out)
        if self.is_noise:
            return record
        return record.better_at(self.fit.start) or record

    def share_explained(self, larger: "DiagnosedModel") -> float:
        """Share of the judging squared error above the noise floor that is gone."""
        if not self.judged.rmse > self.judged.noise_floor:
            return np.nan
        return explained_share(self.judged, larger.judged)

    @property
    def labels(self) -> Mapping[str, str]:
        """What people read for states and inputs."""
        return self.record.data.labels

    def told(self, *effects: Effect) -> str:
        """Effects as people read them."""
        return effects_words(effects, self.labels)

    @property
    def error_words(self) -> str:
        """How far the model is off, such as "training error 0.3 m, noise floor ..."."""
        judged = self.judged
        error = f"{decimal(judged.rmse, 3, '#')}{spaced(judged.error_unit)}"
        return f"{self._where} error {error}, noise floor {judged.floor_words()}"

    def change_words(self, other: "DiagnosedModel") -> str:
        """The errors before and after another fit."""
        after = other.judged
        errors = (self.judged.rmse, after.rmse)
        change = change_words(*errors, spaced(after.error_unit))
        return f"the {self._where} error {change}, noise floor {after.floor_words()}"

    @property
    def _where(self) -> str:
        return "held-out" if self.is_held_out else "training"


def held_base(
    base: DiagnosedModel, record: EvidenceRecord, named: Sequence[Candidate]
) -> DiagnosedModel | None:
    """The model with inputs that do otherwise between samples; None: no likelier one.

    It needs no parameter: it is preferred if the evidence does not clearly speak for
    the delay that is to be named, or if the delay is clearly likelier beside it.
    """
    limit = HOLD_DELAY * float(np.median(base.record.grid.h))
    delays = [one for one in named if is_delay(one.effect)]
    shortest = min(delays, key=lambda one: one.coefficient, default=None)
    if shortest is None or shortest.coefficient > limit:
        return None
    base.say("trying what the inputs do between samples")
    data = base.record.data
    hold = dict(zip(data.inputs, hold_of_each(data.hold, data.inputs), strict=True))
    likeliest = record
    changed: dict[str, str] = {}
    for name, old in hold.items():
        other = "linear" if old == "zero" else "zero"
        with suppress(SolveError):
            found = record.held_as({**hold, **changed, name: other})
            if found.base.log_evidence > likeliest.base.log_evidence:
                likeliest = found
                changed[name] = other
    gain = likeliest.base.log_evidence - record.base.log_evidence
    evidence = shortest.log_evidence
    told = base.told(shortest.effect)
    why = (
        f"that explains what would be {told} ({shortest.size}) without a "
        f"further parameter (log evidence {gain:.0f} against {evidence:.0f})"
    )
    if gain < max(evidence - STRONG_EVIDENCE, STRONG_EVIDENCE):
        gain = _gain_beside(likeliest, record, base, shortest) if changed else 0.0
        why = f"beside it {told} is likelier (log evidence {gain:.0f})"
    if gain < STRONG_EVIDENCE:
        return None
    held = some_of(list(starmap('{} (hold = "{}")'.format, changed.items())))
    note = f"between samples another course is taken of {held}: {why}"
    base.say(note)
    try:
        return base.held_as({**hold, **changed}, note)
    except PhsiOptError:
        return None


def _gain_beside(
    one: EvidenceRecord, other: EvidenceRecord, base: DiagnosedModel, delay: Candidate
) -> float:
    """How much likelier a delay is beside one record than beside another."""
    model = base.fit.model.add(delay.effect)
    values = {name: delay.values[name] for name in model.free}
    try:
        both = [record.weighed(model, values) for record in (one, other)]
    except SolveError:
        return 0.0
    return both[0].log_evidence - both[1].log_evidence


class WeighedEffects(Protocol):
    """Effects that were weighed together, and from where a re-fit with them begins."""

    @property
    def name(self) -> str:
        """In words."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """What the model is given."""

    @property
    def values(self) -> Mapping[str, float]:
        """Of the parameters of the model with them."""

    @property
    def states(self) -> np.ndarray | None:
        """States along the record, (n_nodes, n_states); None if they are the base's."""


@np.errstate(over="ignore", invalid="ignore")  # of a size that nothing determines
def refit(base: DiagnosedModel, candidate: WeighedEffects) -> DiagnosedModel | None:
    """The base model with effects more, fitted; None where that fails, which is said.

    Its free runs are judged beside the noise and the starting states of the base.
    """
    told = base.told(*candidate.effects)
    base.say(f"re-fitting with {told}")
    try:
        larger = Refitting(base, candidate)
        return base.with_run(larger.with_steps_as_fine_as_its_run(larger.begun()))
    except PhsiOptError:
        base.say(f"{told} was skipped: its re-fit failed")
        return None


def fitted_by_steps(
    base: DiagnosedModel, candidate: WeighedEffects
) -> DiagnosedModel | None:
    """The same where a few steps lead to an optimum, which may be a worse one."""
    try:
        fit = Refitting(base, candidate).by_steps()
        return base.with_run(compare_record(base.record.refitted(fit)))
    except PhsiOptError:
        return None


def is_worse(larger: Fit, smaller: Fit) -> bool:
    """Whether a larger model fits worse than the smaller one that it contains."""
    return deviance(larger) > deviance(smaller) + OTHER_OPTIMUM_DEVIANCE


def thorough_fit(aligned: AlignedData, loss: MaximumLikelihood, brief: Fit) -> Fit:
    """A brief re-fit made thorough; itself where that fails or is worse."""
    settings = SolverSettings(max_iterations=THOROUGH_ITERATIONS)
    with suppress(SolveError):
        thorough = identify(brief.model, aligned, loss, start=brief, settings=settings)
        if deviance(thorough) < deviance(brief) + OTHER_OPTIMUM_DEVIANCE:
            return thorough
    return brief


def thorough_refit(brief: DiagnosedModel) -> DiagnosedModel:
    """A brief re-fit made thorough, with its free runs as a study has them."""
    fit = thorough_fit(brief.record.aligned, brief.loss, brief.fit)
    try:
        return brief.with_fit(fit)
    except SolveError:
        return brief


class Refitting:
    """One larger model on the way from its start to a fit with its free runs."""

    def __init__(self, base: DiagnosedModel, candidate: WeighedEffects) -> None:
        """The larger model, with the values beside which the effects were weighed."""
        self.base = base
        self.candidate = candidate
        estimate = base.record.estimate
        model = reduce(Model.add, candidate.effects, base.fit.model)
        model = resolve_guesses(model, estimate.grid, estimate.x)
        free = {n for n, entry in model.entries.items() if not entry.parameter.fixed}
        values = candidate.values.items()
        known = {name: value for name, value in values if name in free}
        self.model = model.with_values(known)
        self.aligned = base.record.aligned.for_model(self.model)
        self.task = Task(self.model, self.aligned, l1_weights(None), None, BRIEF)

    def begun(self) -> Fit:
        """The brief re-fit from where the effect was weighed.

        Raises:
            PhsiOptError: the model cannot be fitted.
        """
        loss = self.base.loss
        fit = self._no_worse(fit_of_task(loss, self.task, self.start))
        corners = tuple(corner_widths(fit.model))
        if not corners:
            return fit
        return fit_of_task(
            loss, replace(self.task, model=fit.model, corners=corners), fit
        )

    def by_steps(self) -> Fit:
        """The optimum to which a few full steps lead.

        Raises:
            PhsiOptError: they lead to none.
        """
        problem = LikelihoodProblem.of(self.task, self.base.loss)
        there = from_fit(problem, self.start)
        found = problem.solve(there, most_steps=STEPS_OF_A_PROBLEM)
        if not found.is_success:
            raise SolveError(f"steps led nowhere: {found.solution.outcome}")
        return found.fit()

    @property
    def start(self) -> Fit:
        """The base, in the states beside which the effects were weighed."""
        base = self.base
        estimate = base.record.estimate
        model = base.fit.model
        states = self.candidate.states
        if states is None:
            states = with_memory(model, estimate.grid, estimate.x, base.record.theta)
        values = self.candidate.values
        known = {name: values[name] for name in model.free if name in values}
        # The fast part of a memory, that of a short delay, is not seen by steps as long
        # as the samples.
        has_memory = any(effect.memory for effect in self.candidate.effects)
        refinement = 2 if has_memory else 1
        return replace(
            base.fit,
            model=model.with_values(known),
            states=estimate.grid.split(states[:, : model.n_states]),
            noise=base.trained.noise,
            steps=tuple(refinement * steps for steps in base.fit.steps),
        )

    def _no_worse(self, fit: Fit) -> Fit:
        """A fit that is as good as the base, begun elsewhere where it must be.

        Raises:
            PhsiOptError: there is none.
        """
        base = self.base
        if not base.record.is_of_training:
            return fit  # the base was fitted to other data
        if is_worse(fit, base.fit):
            fit = thorough_fit(self.aligned, base.loss, fit)
        if not is_worse(fit, base.fit):
            return fit
        small = with_no_size(base.fit.model, *self.candidate.effects)
        fit = fit_of_task(base.loss, replace(self.task, model=small), base.fit)
        if is_worse(fit, base.fit):
            raise SolveError("no fit was found that is as good as the one without it.")
        return fit

    def with_steps_as_fine_as_its_run(self, fit: Fit) -> Comparison:
        """The fit's free run; with finer steps where it leaves the fit's states."""
        record = self.base.record
        trained = compare_record(record.refitted(fit))
        is_wave = any(map(is_scanned, self.candidate.effects))
        may_stray = is_wave or corner_widths(fit.model) or fit.model.memory
        if not may_stray or sum(map(np.sum, fit.steps)) > ONE_ATTEMPT_INTERVALS:
            return trained
        if distance_from_states(trained) < STRAYED_STATES:
            return trained
        settings = replace(BRIEF, thorough=True)
        with suppress(PhsiOptError):
            finer = identify(
                fit.model, self.aligned, self.base.loss, start=fit, settings=settings
            )
            again = compare_record(record.refitted(finer))
            if again.rmse < trained.rmse:
                return again
        return trained


def distance_from_states(trained: Comparison) -> float:
    """Root mean square distance of a free run from its fit, in noise deviations."""
    record = trained.record
    fitted = outputs_at_samples(
        record.model, record.grid, record.fit.states, record.theta
    )
    apart = np.concatenate(trained.shown) - np.concatenate(fitted)
    return rms((apart / trained.sigma)[np.isfinite(record.data.stacked("x"))])
