"""Larger models re-fitted: begun where screening expects them, then run freely."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.comparison.compare import Comparison, compare_record
from phsi_opt.comparison.model_selection import delta_bic
from phsi_opt.criteria import (
    BIC_TIE,
    NEAR_NOISE_ERROR,
    ONE_ATTEMPT_INTERVALS,
    STRAYED_STATES,
)
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel, n_intervals
from phsi_opt.diagnosis.friction_sharpening import CornerSharpening, with_effects
from phsi_opt.diagnosis.refit_effort import (
    BESIDE_SHARP,
    BRIEF,
    IN_EVERY_WAY,
    THOROUGH,
)
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import FEASIBLE_PATH, SolverSettings
from phsi_opt.transcription.sensors import outputs_at_samples


@dataclass(frozen=True, eq=False)
class RefitRequest:
    """What is to be re-fitted, and where it may begin.

    Attributes:
        effects: added to the base model.
        values: of their parameters, from which to start.
        base_values: of the base's own parameters, from which to start.
        states: (n_nodes, n_states) where to start; default: those of the missing force.
        rival: a fit that dry friction must clearly beat before it is sharpened.
        known: fits that have part of these effects, to begin at beside a sharp corner.
        is_likely: solve in every way there is.
        sharpens: dry friction that is worth it; else that is left to its turn.
    """

    effects: Sequence[Effect]
    values: Mapping[str, float]
    base_values: Mapping[str, float] = field(default_factory=dict)
    states: np.ndarray | None = None
    rival: Fit | None = None
    known: Sequence[Fit] = ()
    is_likely: bool = False
    sharpens: bool = True


@dataclass(frozen=True, eq=False)
class _Attempt:
    """Where a re-fit begins: values of the base model, states (n_nodes, n_states)."""

    model: Model
    states: np.ndarray


@dataclass(frozen=True, eq=False)
class Refit:
    """A larger model, fitted.

    Attributes:
        fit: of the larger model.
        trained: its free run on the training record.
        judged: its free run on the record that judges.
        before_sharpening: the fit before dry friction was sharpened; None where it
            began at a sharp one.
    """

    fit: Fit
    trained: Comparison
    judged: Comparison
    before_sharpening: Fit | None

    def beside(self, base: DiagnosedModel) -> "Refit":
        """The same beside the records of a base model, where it was made of copies."""
        trained = replace(self.trained, record=base.record.refitted(self.fit))
        judged = trained
        if base.is_held_out:
            record = base.judged.record.refitted(self.fit)
            judged = replace(self.judged, record=record)
        return replace(self, trained=trained, judged=judged)


def refit(
    base: DiagnosedModel, request: RefitRequest, blunt: Fit | None = None
) -> Refit | None:
    """`refitted`; None where that fails, which is said."""
    try:
        return refitted(base, request, blunt)
    except PhsiOptError as error:
        base.say(f"not re-fitted: {error}")
        return None


def refitted(
    base: DiagnosedModel, request: RefitRequest, blunt: Fit | None = None
) -> Refit:
    """Fit the base model with effects more.

    Args:
        base: the model that is diagnosed.
        request: what is added.
        blunt: the fit before dry friction is sharpened, where it is known.

    Raises:
        PhsiOptError: the larger model cannot be fitted.
    """
    return _Refitting(base, request).result(blunt)


def is_worth_sharpening(base: DiagnosedModel, request: RefitRequest, fit: Fit) -> bool:
    """Whether the dry friction of a fit is asked for with a sharp corner."""
    return _Refitting(base, request).is_worth_sharpening(fit)


class _Refitting:
    """One larger model on the way from its start to a fit with its free runs."""

    def __init__(self, base: DiagnosedModel, request: RefitRequest) -> None:
        self.base = base
        self.request = request
        model = with_effects(base.fit.model, request.effects)
        estimate = base.record.estimate
        model = resolve_guesses(model, estimate.grid, estimate.x)
        self.model = model.with_values(request.values)
        self.aligned = base.record.aligned.for_model(self.model)
        self.sharpening = CornerSharpening(base, self.aligned, request.effects)
        # The fast part of a memory, that of a short delay, is not seen by steps as long
        # as the samples.
        has_memory = any(effect.memory for effect in request.effects)
        self.refinement = 2 if has_memory else 1

    def result(self, blunt: Fit | None) -> Refit:
        """The fit with its free runs, from before it is sharpened where that is known.

        Raises:
            PhsiOptError: the model cannot be fitted.
        """
        known = self.request.known
        model = self.model
        fit = None
        if blunt is None:
            fit = self.sharpening.extended(model, self.refinement, known)
        if fit is None:
            fit = blunt = self.begun() if blunt is None else blunt
            if self.is_worth_sharpening(fit):
                fit = self.sharpening.sharpened(fit, model)
        is_sharpened = fit is not blunt
        trained = self.with_steps_as_fine_as_its_run(fit)
        if is_sharpened:
            trained = self.with_estimated_widths(trained)
        judged = trained
        if self.base.is_held_out:
            judged = compare_record(self.base.judged.record.refitted(trained.fit))
        return Refit(trained.fit, trained, judged, blunt)

    def is_worth_sharpening(self, fit: Fit) -> bool:
        """Whether dry friction clearly beats its rival, and is to be believed."""
        if not self.request.sharpens:
            return False
        rival = self.request.rival
        if rival is not None and not delta_bic(rival, fit, 1.0) < -BIC_TIE:
            return False
        return self.sharpening.is_believed(fit)

    def compared(self, fit: Fit) -> Comparison:
        """The free run of a fit on the training record."""
        return compare_record(self.base.record.refitted(fit))

    def with_steps_as_fine_as_its_run(self, fit: Fit) -> Comparison:
        """The fit's free run; with finer steps where the run leaves the fit's states.

        Steps as long as the samples are too long for a sharp corner, and for the fast
        part of a short memory.
        """
        trained = self.compared(fit)
        is_along_solutions = fit.outcome.way == FEASIBLE_PATH
        is_enough = is_along_solutions and self.base.is_left_with_noise(trained)
        if is_enough or n_intervals(fit) > ONE_ATTEMPT_INTERVALS:
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

    def with_estimated_widths(self, trained: Comparison) -> Comparison:
        """The same with the widths of its corners estimated, where it is near noise."""
        limit = NEAR_NOISE_ERROR * trained.noise_floor
        is_near = not self.base.is_left_with_noise(trained) and trained.rmse < limit
        if not is_near:
            return trained
        fit = self.sharpening.with_estimated_widths(trained.fit)
        if fit is None:
            return trained
        with suppress(PhsiOptError):
            again = self.compared(fit)
            if again.rmse < trained.rmse:
                return again
        return trained

    def begun(self) -> Fit:
        """The brief re-fit from the states of the missing force.

        From where a second look ended, else from the base's own values; of a long
        record, and with an effect that has a memory, there is one attempt.
        """
        own = self.base.fit.model
        estimate = self.base.record.estimate
        attempts = [_Attempt(own, estimate.x)]
        if self.request.base_values:
            expected = {}
            for name, value in self.request.base_values.items():
                if name in own.entries:
                    expected[name] = value
            states = self.request.states
            if states is None:
                states = estimate.x
            first = _Attempt(own.with_values(expected), states)
            attempts.insert(0, first)
        has_memory = any(effect.memory for effect in self.request.effects)
        if self.base.is_long or has_memory:
            attempts = attempts[:1]
        for attempt in attempts[:-1]:
            with suppress(PhsiOptError):
                return self._identified(attempt)
        return self._identified(attempts[-1])

    def _identified(self, attempt: "_Attempt") -> Fit:
        base = self.base
        estimate = base.record.estimate
        noise = {}
        for name, sigma in zip(base.fit.model.states, estimate.sigma, strict=True):
            if name in self.aligned.data.measured:
                noise[name] = float(sigma)
        start = replace(
            base.fit,
            model=attempt.model,
            states=estimate.grid.split(attempt.states[:, : estimate.x.shape[1]]),
            noise=noise,
            steps=tuple(self.refinement * steps for steps in base.fit.steps),
        )
        return identify_aligned(
            self.model, self.aligned, base.loss, start=start, settings=self._effort()
        )

    def _effort(self) -> SolverSettings:
        """How hard a first solve of the larger model tries."""
        if self.base.is_along_solutions:
            return BESIDE_SHARP
        has_corner = bool(self.sharpening.corners(self.model))
        return IN_EVERY_WAY if has_corner or self.request.is_likely else BRIEF


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
