"""A larger model re-fitted: begun where it was weighed, then run freely."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.comparison.compare import Comparison, compare_record, deviance
from phsi_opt.criteria import (
    ONE_ATTEMPT_INTERVALS,
    OTHER_OPTIMUM_DEVIANCE,
    STRAYED_STATES,
)
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel, n_intervals
from phsi_opt.diagnosis.friction_sharpening import CornerSharpening
from phsi_opt.diagnosis.refit_effort import ADDED, BRIEF, THOROUGH
from phsi_opt.errors import PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import corner_widths, resolve_guesses
from phsi_opt.model.effect import is_scanned
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.sensors import outputs_at_samples


@dataclass(frozen=True, eq=False)
class Refit:
    """A larger model, fitted.

    Attributes:
        fit: of the larger model.
        trained: its free run on the training record.
        judged: its free run on the record that judges.
    """

    fit: Fit
    trained: Comparison
    judged: Comparison


def refit(base: DiagnosedModel, candidate: Candidate) -> Refit | None:
    """The base model with an effect more, fitted; None where that fails, which is said.

    From where the effect was weighed.
    """
    base.say(f"re-fitting with {candidate.name}")
    try:
        return _Refitting(base, candidate).result()
    except PhsiOptError as error:
        base.say(f"not re-fitted: {error}")
        return None


def thorough_fit(aligned: AlignedData, loss: MaximumLikelihood, brief: Fit) -> Fit:
    """A brief re-fit made thorough; itself where that fails or is worse."""
    try:
        thorough = identify_aligned(
            brief.model, aligned, loss, start=brief, settings=ADDED
        )
    except SolveError:
        return brief
    if deviance(thorough) < deviance(brief) + OTHER_OPTIMUM_DEVIANCE:
        return thorough
    return brief


def thorough_refit(base: DiagnosedModel, brief: Refit) -> Refit:
    """A brief re-fit made thorough, with its free runs as a study has them."""
    aligned = brief.trained.record.aligned
    fit = thorough_fit(aligned, base.loss, brief.fit)
    try:
        trained = judged = compare_record(Record.of_aligned(fit, aligned))
        if base.is_held_out:
            held_out = brief.judged.record.aligned
            judged = compare_record(Record.of_aligned(fit, held_out))
    except SolveError:
        return brief
    return Refit(fit, trained, judged)


class _Refitting:
    """One larger model on the way from its start to a fit with its free runs."""

    def __init__(self, base: DiagnosedModel, candidate: Candidate) -> None:
        self.base = base
        self.candidate = candidate
        estimate = base.record.estimate
        model = base.fit.model.add(candidate.effect)
        model = resolve_guesses(model, estimate.grid, estimate.x)
        known = {}
        for name, value in candidate.values.items():
            if name in model.entries and not model.entries[name].parameter.fixed:
                known[name] = value
        self.model = model.with_values(known)
        self.aligned = base.record.aligned.for_model(self.model)
        self.sharpening = CornerSharpening(base, self.aligned)
        # The fast part of a memory, that of a short delay, is not seen by steps as long
        # as the samples.
        self.refinement = 2 if candidate.effect.memory else 1

    def result(self) -> Refit:
        """The fit with its free runs.

        Raises:
            PhsiOptError: the model cannot be fitted.
        """
        blunt = self.begun()
        fit = self.sharpening.sharpened(blunt)
        trained = self.with_steps_as_fine_as_its_run(fit)
        judged = trained
        if self.base.is_held_out:
            judged = compare_record(self.base.judged.record.refitted(trained.fit))
        return Refit(trained.fit, trained, judged)

    def compared(self, fit: Fit) -> Comparison:
        """The free run of a fit on the training record."""
        return compare_record(self.base.record.refitted(fit))

    def with_steps_as_fine_as_its_run(self, fit: Fit) -> Comparison:
        """The fit's free run; with finer steps where the run leaves the fit's states.

        Steps as long as the samples are too long for a sharp corner, and for the fast
        part of a short memory.
        """
        trained = self.compared(fit)
        has_corner = is_scanned(self.candidate.effect) or corner_widths(fit.model)
        if not (has_corner or fit.model.memory):
            return trained
        if n_intervals(fit) > ONE_ATTEMPT_INTERVALS:
            return trained
        if distance_from_states(trained) < STRAYED_STATES:
            return trained
        with suppress(PhsiOptError):
            finer = identify_aligned(
                fit.model,
                self.aligned,
                self.base.loss,
                start=fit,
                settings=THOROUGH,
            )
            again = self.compared(finer)
            if again.rmse < trained.rmse:
                return again
        return trained

    def begun(self) -> Fit:
        """The brief re-fit from where the effect was weighed."""
        base = self.base
        estimate = base.record.estimate
        model = base.fit.model
        noise = {}
        for name, sigma in zip(model.states, base.record.sigma, strict=True):
            if name in self.aligned.data.measured:
                noise[name] = float(sigma)
        states = self.candidate.states
        if states is None:
            states = with_memory(model, estimate.grid, estimate.x, base.record.theta)
        start = replace(
            base.fit,
            model=model.with_values(self._base_values()),
            states=estimate.grid.split(states[:, : model.n_states]),
            noise=noise,
            steps=tuple(self.refinement * steps for steps in base.fit.steps),
        )
        return identify_aligned(
            self.model, self.aligned, base.loss, start=start, settings=BRIEF
        )

    def _base_values(self) -> dict[str, float]:
        """Values of the base's own free parameters beside the effect."""
        values = self.candidate.values
        return {n: values[n] for n in self.base.fit.model.free if n in values}


def distance_from_states(trained: Comparison) -> float:
    """Distance of a free run from the states of its fit, in noise deviations.

    The root mean square over the measured values of what the sensors show.
    """
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
