"""The fits of a study's steps: every model on the same aligned records."""

from dataclasses import dataclass

from phsi_opt.comparison.compare import compare_record
from phsi_opt.comparison.model_selection import deviance
from phsi_opt.criteria import OTHER_OPTIMUM_DEVIANCE
from phsi_opt.data.copies import check_can_judge
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.refit_effort import ADDED
from phsi_opt.errors import PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.estimation.record import Record
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.study.effect_law import EffectLaw, effect_law
from phsi_opt.study.record import Step
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood

MOST_LAWS = 3  # effects whose law a report shows: each is an estimate of its own


@dataclass(frozen=True, eq=False)
class StudyFitting:
    """Fits models of one study, and compares them with its records.

    Attributes:
        base: the model that effects are added to.
        train: the training record.
        held_out: the record that judges; None where nothing was held out.
        loss: how to fit.
    """

    base: Model
    train: AlignedData
    held_out: AlignedData | None
    loss: MaximumLikelihood

    @classmethod
    def of(
        cls,
        base: Model,
        train: Measurements,
        held_out: Measurements | None,
        loss: MaximumLikelihood,
    ) -> "StudyFitting":
        """The measurements in the model's order.

        Raises:
            DataError: a state or input of the model is not in the measurements, or a
                run is in both.
        """
        fitted = AlignedData.of(base, train)
        if held_out is None:
            return cls(base, fitted, None, loss)
        judging = AlignedData.of(base, held_out)
        check_can_judge(fitted.data, judging.data)
        return cls(base, fitted, judging, loss)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of the measurements."""
        held_out = () if self.held_out is None else self.held_out.notes
        return self.train.notes + tuple(f"held out: {note}" for note in held_out)

    def of_base(self) -> Fit:
        """The base model, fitted."""
        return identify_aligned(self.base, self.train, self.loss)

    def step(self, label: str, added: tuple[Effect, ...], fit: Fit) -> Step:
        """A fit with its free runs on both records."""
        train = compare_record(Record.of_aligned(fit, self.train))
        held_out = None
        if self.held_out is not None:
            held_out = compare_record(Record.of_aligned(fit, self.held_out))
        return Step(label, added, fit, train, held_out)

    def refined(self, brief: Fit) -> Fit:
        """A brief re-fit made thorough; kept itself where that fails or is worse."""
        try:
            thorough = identify_aligned(
                brief.model, self.train, self.loss, start=brief, settings=ADDED
            )
        except SolveError:
            return brief
        if deviance(thorough) < deviance(brief) + OTHER_OPTIMUM_DEVIANCE:
            return thorough
        return brief

    def larger(self, fit: Fit, effect: Effect, found: Candidate | None) -> Fit:
        """The model of a fit with one effect, from what a diagnosis found of it."""
        if found is not None and found.fit is not None:
            return self.refined(found.fit)
        model = fit.model.add(effect)
        values = {} if found is None else found.values
        known = {name: values[name] for name in model.free if name in values}
        model = model.with_values(known)
        return identify_aligned(model, self.train, self.loss, start=fit)

    def with_effects(self, fit: Fit, effects: tuple[Effect, ...]) -> Fit:
        """The base model with effects, all parameters re-estimated from a fit."""
        model = self.base
        for effect in effects:
            model = model.add(effect)
        known = {}
        for name, value in fit.model.values.items():
            if name in model.entries:
                known[name] = value
        return identify_aligned(
            model.with_values(known), self.train, self.loss, start=fit
        )

    def law(self, fit: Fit, added: tuple[Effect, ...], effect: Effect) -> EffectLaw:
        """What the model of a fit lacks without one of the effects added (see there).

        Raises:
            ModelError: the effect is one of a sensor.
            SolveError: the model without the effect does not reach the measurements.
        """
        return effect_law(self.base, fit.model, added, effect, self.train)

    def laws(self, fit: Fit, added: tuple[Effect, ...]) -> tuple[EffectLaw, ...]:
        """The laws of the effects added first, as far as they can be shown."""
        found = []
        for effect in added[:MOST_LAWS]:
            try:
                found.append(self.law(fit, added, effect))
            except PhsiOptError:
                continue  # a sensor's, or a model that is too far off without it
        return tuple(found)
