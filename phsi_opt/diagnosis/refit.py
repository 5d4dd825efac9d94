"""The model that is diagnosed, and larger models fitted beside it.

A re-fit begins where the effect was weighed and ends with free runs on both records.

The corner of dry friction is made sharper step by step: a solver needs it rounded at
first, but beside a body that sticks the rounding shows, and the size of the friction
comes out wrong. So the width w is made smaller on a finer grid as long as the
likelihood asks for it: the deviance D is nearly linear in a small w, so that all
sharper corners together let it fall by its slope dD / dlog w, which the multipliers of
the dynamics tell.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import starmap

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
    CORNER_WIDTHS,
    HOLD_DELAY,
    MOST_SHARP_STATES,
    ONE_ATTEMPT_INTERVALS,
    OTHER_OPTIMUM_DEVIANCE,
    REFIT_ITERATIONS,
    REFIT_TOLERANCE,
    SHARPER_CORNER_DEVIANCE,
    STEPS_AT_CORNER,
    STRAYED_STATES,
    STRONG_EVIDENCE,
    THOROUGH_ITERATIONS,
)
from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.errors import PhsiOptError, SolveError, some_of
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import estimate_by, identify
from phsi_opt.estimation.likelihood_estimate import (
    DisturbedEstimate,
    LikelihoodEstimate,
)
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import corner_widths, resolve_guesses
from phsi_opt.model.effect import is_delay, is_scanned
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.screening.weighing import EvidenceRecord
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood, l1_weights
from phsi_opt.transcription.sensors import outputs_at_samples

# All limits are counts: a loaded machine gives the same verdict.
BRIEF = SolverSettings(
    tolerance=REFIT_TOLERANCE, max_iterations=REFIT_ITERATIONS, thorough=False
)
# Share of the present width over which the slope of the deviance is taken.
NEARBY_WIDTH = 0.99


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

        def compared(record: Record) -> Comparison:
            return compare_record(Record.of_aligned(fit, change(record.aligned)))

        trained = judged = compared(self.record)
        if self.is_held_out:
            judged = compared(self.judged.record)
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
        """The fit."""
        return self.trained.fit

    @property
    def record(self) -> Record:
        """The fit along the training record."""
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

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        held_out = self.judged.record if self.is_held_out else None
        return EvidenceRecord.of(self.record, held_out)

    def share_explained(self, larger: "DiagnosedModel") -> float:
        """Share of the judging squared error above the noise floor that is gone."""
        if not self.judged.rmse > self.judged.noise_floor:
            return np.nan
        return explained_share(self.judged, larger.judged)


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
    why = (
        f"that explains what would be {shortest.name} ({shortest.size}) without a "
        f"further parameter (log evidence {gain:.0f} against {evidence:.0f})"
    )
    if gain < max(evidence - STRONG_EVIDENCE, STRONG_EVIDENCE):
        gain = _gain_beside(likeliest, record, base, shortest) if changed else 0.0
        why = f"beside it {shortest.name} is likelier (log evidence {gain:.0f})"
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


def better_base(base: DiagnosedModel, record: EvidenceRecord) -> DiagnosedModel | None:
    """The model from a clearly better optimum, found beside a force; None: none."""
    fit = base.fit
    if not fit.model.free or not base.record.is_of_training:
        return None
    weighed = record.base
    values = {name: weighed.model.values[name] for name in fit.model.free}
    states = base.record.estimate.grid.split(weighed.states[: record.n_fitted_nodes])
    start = replace(fit, model=fit.model.with_values(values), states=states)
    base.say("re-fitting the model from the estimate with a random disturbance")
    aligned = base.record.aligned
    try:
        better = identify(start.model, aligned, base.loss, start=start)
        if not deviance(better) < deviance(fit) - OTHER_OPTIMUM_DEVIANCE:
            return None
        return base.with_fit(better)
    except PhsiOptError:
        return None


def refit(base: DiagnosedModel, candidate: Candidate) -> DiagnosedModel | None:
    """The base model with an effect more, fitted; None where that fails, which is said.

    Its free runs are judged beside the noise and the starting states of the base.
    """
    base.say(f"re-fitting with {candidate.name}")
    try:
        return Refitting(base, candidate).result()
    except PhsiOptError as error:
        base.say(f"not re-fitted: {error}")
        return None


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

    def __init__(self, base: DiagnosedModel, candidate: Candidate) -> None:
        """The larger model, with the values beside which the effect was weighed."""
        self.base = base
        self.candidate = candidate
        estimate = base.record.estimate
        model = base.fit.model.add(candidate.effect)
        model = resolve_guesses(model, estimate.grid, estimate.x)
        free = {n for n, entry in model.entries.items() if not entry.parameter.fixed}
        values = candidate.values.items()
        known = {name: value for name, value in values if name in free}
        self.model = model.with_values(known)
        self.aligned = base.record.aligned.for_model(self.model)

    def result(self) -> DiagnosedModel:
        """The fit with its free runs.

        Raises:
            PhsiOptError: the model cannot be fitted.
        """
        fit = self.sharpened(self.begun())
        return self.base.with_run(self.with_steps_as_fine_as_its_run(fit))

    def begun(self) -> Fit:
        """The brief re-fit from where the effect was weighed."""
        base = self.base
        estimate = base.record.estimate
        model = base.fit.model
        sigma = dict(zip(model.states, base.record.sigma.tolist(), strict=True))
        measured = self.aligned.data.measured
        states = self.candidate.states
        if states is None:
            states = with_memory(model, estimate.grid, estimate.x, base.record.theta)
        values = self.candidate.values
        known = {name: values[name] for name in model.free if name in values}
        # The fast part of a memory, that of a short delay, is not seen by steps as long
        # as the samples.
        refinement = 2 if self.candidate.effect.memory else 1
        start = replace(
            base.fit,
            model=model.with_values(known),
            states=estimate.grid.split(states[:, : model.n_states]),
            noise={name: sigma[name] for name in model.states if name in measured},
            steps=tuple(refinement * steps for steps in base.fit.steps),
        )
        return identify(
            self.model, self.aligned, base.loss, start=start, settings=BRIEF
        )

    def with_steps_as_fine_as_its_run(self, fit: Fit) -> Comparison:
        """The fit's free run; with finer steps where it leaves the fit's states."""
        record = self.base.record
        trained = compare_record(record.refitted(fit))
        has_corner = is_scanned(self.candidate.effect) or corner_widths(fit.model)
        may_stray = has_corner or fit.model.memory
        if not may_stray or _n_intervals(fit.steps) > ONE_ATTEMPT_INTERVALS:
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

    # ---- sharper corners -------------------------------------------------------------

    def corners(self, model: Model) -> dict[str, Share]:
        """Widths of the corners that the base has not, with their guesses."""
        widths = corner_widths(model)
        known = self.base.fit.model.entries
        return {name: guess for name, guess in widths.items() if name not in known}

    def sharpened(self, fit: Fit) -> Fit:
        """A fit with rounded corners, with these as sharp as the record asks for."""
        corners = self.corners(fit.model)
        blunt = fit.model.values
        n_stages = max((len(guess.sharper) for guess in corners.values()), default=0)

        def estimate_at(stage: float) -> LikelihoodEstimate | DisturbedEstimate | None:
            widths = {}
            for name, guess in corners.items():
                factors = np.cumprod([1.0, *guess.sharper])
                factor = np.interp(stage, np.arange(len(factors)), factors)
                widths[name] = blunt[name] * float(factor)
            n_steps = STEPS_AT_CORNER * max(math.ceil(stage), 2) // 2
            return self.at_widths(fit, widths, n_steps)

        falls = [0.0]
        for stage in range(1, n_stages + 1):
            estimate = estimate_at(stage)
            if estimate is None:
                break
            falls.append(self._fall(estimate))
            sharper = estimate.fit()
            if deviance(sharper) > deviance(fit) + SHARPER_CORNER_DEVIANCE:
                break
            fit = sharper
            if falls[-1] < SHARPER_CORNER_DEVIANCE:
                break
        # The slope tells little on a grid on which no corner is resolved.
        if falls[-1] < -SHARPER_CORNER_DEVIANCE and falls[-2] > 0:  # a secant step back
            share = falls[-1] / (falls[-1] - falls[-2])
            estimate = estimate_at(len(falls) - 1 - share)
            if estimate is not None and deviance(estimate.fit()) < deviance(fit):
                return estimate.fit()
        return fit

    def _fall(self, estimate: LikelihoodEstimate | DisturbedEstimate) -> float:
        """By how much the deviance would fall with corners sharp without end."""
        model = estimate.model
        values = model.values
        widths = {name: NEARBY_WIDTH * values[name] for name in self.corners(model)}
        change = estimate.deviance_change(model.with_values(widths))
        return change / float(np.log(NEARBY_WIDTH))

    def at_widths(
        self, fit: Fit, widths: dict[str, float], n_steps: int
    ) -> LikelihoodEstimate | DisturbedEstimate | None:
        """The estimate with other widths of its corners; None: failed, or too large."""
        steps = fit.steps
        for name, guess in self.corners(fit.model).items():
            width = fit.model.values[name]
            steps = finer_at_corner(
                fit, self.aligned.data, guess.of, width, steps, n_steps
            )
        n_states = _n_intervals(steps) * fit.model.n_states
        if fit.model.memory and n_states > MOST_SHARP_STATES:
            return None
        model = fit.model.with_values(widths)
        task = Task(model, self.aligned, l1_weights(None), None, BRIEF)
        with suppress(PhsiOptError):
            found = estimate_by(self.base.loss, task, replace(fit, steps=steps))
            assert isinstance(found, LikelihoodEstimate | DisturbedEstimate)
            return found if found.is_success else None
        return None


def finer_at_corner(
    fit: Fit,
    data: Measurements,
    of: str,
    width: float,
    steps: Sequence[np.ndarray],
    n_steps: int = STEPS_AT_CORNER,
) -> tuple[np.ndarray, ...]:
    """At least ``n_steps`` where a formula ``of``, such as a velocity, is near zero."""
    formula = fit.model.function(of)
    theta = fit.model.theta
    refined = []
    for run, x, n in zip(data.trajectories, fit.states, steps, strict=True):
        at_samples = formula.map("v", "serial", len(x), [3], [])
        v = np.array(at_samples(x.T, run.u.T, run.t[None, :], theta)).ravel()
        passes_zero = v[1:] * v[:-1] < 0
        is_within = np.minimum(np.abs(v[1:]), np.abs(v[:-1])) < CORNER_WIDTHS * width
        # The corner may move to the gap beside.
        is_near = np.convolve(passes_zero | is_within, np.ones(3))[1:-1] > 0
        refined.append(np.where(is_near, np.maximum(n, n_steps), n))
    return tuple(refined)


def _n_intervals(steps: Sequence[np.ndarray]) -> int:
    return sum(int(of_run.sum()) for of_run in steps)


def distance_from_states(trained: Comparison) -> float:
    """Root mean square distance of a free run from its fit, in noise deviations."""
    record = trained.record
    fitted = outputs_at_samples(
        record.model, record.grid, record.fit.states, record.theta
    )
    apart = []
    for run, x, trajectory in zip(
        trained.shown, fitted, record.data.trajectories, strict=True
    ):
        scaled = (run - x) / trained.sigma
        apart.append(scaled[np.isfinite(trajectory.x)])
    return float(np.sqrt(np.mean(np.concatenate(apart) ** 2)))
