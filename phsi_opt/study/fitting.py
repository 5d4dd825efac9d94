"""The fits of a study's steps: every model on the same aligned records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from phsi_opt.comparison.compare import compare_record
from phsi_opt.data.copies import check_can_judge
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.refit import thorough_fit
from phsi_opt.errors import ModelError, PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.pictures import follows_of
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.presentation.content import Follows
from phsi_opt.presentation.numbers import proper_names
from phsi_opt.screening.weighing import EvidenceRecord
from phsi_opt.study.record import Step
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood


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

    def evidence(self, fit: Fit) -> float:
        """Log evidence of a fitted model beside a force, by all measurements.

        Raises:
            SolveError: no states and forces were found that obey the dynamics.
        """
        trained = Record.of_aligned(fit, self.train)
        judged = None
        if self.held_out is not None:
            judged = Record.of_aligned(fit, self.held_out)
        return EvidenceRecord.of(trained, judged).base.log_evidence

    def step(self, label: str, added: tuple[Effect, ...], fit: Fit) -> Step:
        """A fit with its free runs on both records."""
        train = compare_record(Record.of_aligned(fit, self.train))
        held_out = None
        if self.held_out is not None:
            held_out = compare_record(Record.of_aligned(fit, self.held_out))
        return Step(label, added, fit, train, held_out)

    def larger(self, fit: Fit, effect: Effect, found: Candidate | None) -> Fit:
        """The model of a fit with one effect, from what a diagnosis found of it."""
        if found is not None and found.fit is not None:
            return thorough_fit(self.train, self.loss, found.fit)
        values = {} if found is None else found.values
        model = fit.model.add(effect)
        free = set(model.free)
        known = {name: value for name, value in values.items() if name in free}
        model = model.with_values(known)
        return identify_aligned(model, self.train, self.loss, start=fit)

    def with_effects(self, fit: Fit, effects: Sequence[Effect]) -> Fit:
        """The base model with effects, all parameters re-estimated from a fit."""
        model = self._model(effects, fit.model.values)
        return identify_aligned(model, self.train, self.loss, start=fit)

    def _model(self, effects: Sequence[Effect], values: Mapping[str, float]) -> Model:
        """The base model with effects, with those of the values that it has."""
        model = self.base
        for effect in effects:
            model = model.add(effect)
        known = {name: one for name, one in values.items() if name in model.entries}
        return model.with_values(known)

    def law(self, fit: Fit, added: tuple[Effect, ...], effect: Effect) -> Follows:
        """What the model of a fit lacks without one of the effects added.

        A loss is shown against its effort, others against what predicts them best.

        A base model that was fitted without the effect imitates it: its damping stands
        in for a friction, and the missing force is the difference. Here the values are
        those of the fit, so that the whole effect is missing.

        Raises:
            ModelError: the effect is one of a sensor, or its equation can lack no
                force.
            SolveError: no states were found that obey the smaller model.
        """
        if effect.slot == "sensor":
            raise ModelError(
                f"{effect} acts in a sensor; no force is missing without it."
            )
        others = [other for other in added if other is not effect]
        frozen = self._model(others, fit.model.values).frozen()
        found = identify_aligned(frozen, self.train, MaximumLikelihood())
        analysis = ForceAnalysis.of(Record.of_aligned(found, self.train))
        force = analysis.force_in(effect.equation)
        effort = frozen.efforts[frozen.states.index(effect.equation)]
        said = (
            f"The law that was added: what d{effect.equation}/dt lacks where {effect} "
            "is left out of the present model and all other values stay"
        )
        return follows_of(
            force,
            effort if effect.slot == "R" else "",
            proper_names(f"Force that is missing without {effect}"),
            proper_names(said),
        )

    def laws(self, fit: Fit, added: tuple[Effect, ...]) -> tuple[Follows, ...]:
        """The laws of the three effects added first, as far as they can be shown.

        Each is an estimate of its own.
        """
        found = []
        for effect in added[:3]:
            try:
                found.append(self.law(fit, added, effect))
            except PhsiOptError:
                continue  # a sensor's, or a model that is too far off without it
        return tuple(found)
