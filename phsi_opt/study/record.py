"""What a study is at one moment: the data, the steps, and how further steps are fitted.

Immutable. All that is said of a study is made from it, and `Study` replaces it by the
next one.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from typing import TYPE_CHECKING

from phsi_opt.comparison.compare import Comparison, compare_record, deviance
from phsi_opt.data.checks import Hold
from phsi_opt.data.copies import check_can_judge
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import is_worse, thorough_fit
from phsi_opt.errors import ModelError, PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.equation_force import DIFFERENCE
from phsi_opt.force_analysis.force_record import Points
from phsi_opt.force_analysis.pictures import follows_of
from phsi_opt.later import Later
from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import effects_words
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.presentation.content import ErrorStep, Follows
from phsi_opt.presentation.numbers import (
    capitalised,
    change_words,
    number,
    number_of,
    proper_names,
)
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.units import scale_of_errors, spaced
from phsi_opt.screening.effect_size import Size, fitted_size, with_no_size
from phsi_opt.screening.weighing import EvidenceRecord
from phsi_opt.transcription.grid import AlignedData, checked_data
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss

if TYPE_CHECKING:
    import pandas as pd

    from phsi_opt.presentation.charts import Chart

# What the history calls the fields of an `ErrorStep`.
COLUMNS_OF_ERRORS = ("effect", "train_rmse", "held_out_rmse", "noise_floor", "bic")
NOT_FOLLOWED = (
    "No motion of the model was found that follows the measurements; its parameters "
    "are fitted to the changes between neighbouring samples (PHSILoss)."
)


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a study: a model, its fit, and the errors of its free runs."""

    label: str  # what was done
    # The effects that the model has since beyond the base model.
    added: tuple[Effect, ...]
    fit: Fit  # of the model
    train: Comparison  # its free run on the training record
    held_out: Comparison | None = None  # on data held out

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.label!r})"

    @property
    def judged(self) -> Comparison:
        """The comparison that judges, on data held out or else the training record."""
        return self.held_out or self.train

    @property
    def cautioned(self) -> Fit:
        """The fit, with what its free run on the training record warns of."""
        if self.train.warning in self.fit.caution:
            return self.fit
        caution = f"{self.train.warning} {self.fit.caution}".rstrip()
        return replace(self.fit, doubts=Later.known(caution))


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """A study as it stands."""

    base: Model  # the model that effects are added to
    training: AlignedData  # the data that are fitted
    judging: AlignedData | None  # those held out, or None
    loss: MaximumLikelihood  # how to fit
    steps: tuple[Step, ...] = ()  # what was done so far, the base model first
    # By the number of the step whose model they look at.
    diagnoses: Mapping[int, Diagnosis] = field(default_factory=dict)
    stopped: str = ""  # why it stopped last; "" where it was not asked to go on
    title: str = ""  # of reports; "": what was measured
    ending: AlignedData | None = None  # data that choose nothing, for the end

    @classmethod
    def of(
        cls,
        base: Model,
        train: Measurements,
        held_out: Measurements | None,
        loss: MaximumLikelihood,
        final: Measurements | None = None,
    ) -> "StudyRecord":
        """Before its first step, with the measurements in the model's order."""
        training = checked_data(base, train)
        judging = ending = None
        if held_out is not None:
            judging = checked_data(base, held_out)
            check_can_judge(training.data, judging.data)
        if final is not None:
            ending = checked_data(base, final)
            for known in filter(None, (training, judging)):
                check_can_judge(known.data, ending.data, "final", "data used before")
        return cls(base, training, judging, loss, ending=ending)

    @property
    def train(self) -> Measurements:
        return self.training.data

    @property
    def held_out(self) -> Measurements | None:
        return None if self.judging is None else self.judging.data

    @property
    def final(self) -> Measurements | None:
        return None if self.ending is None else self.ending.data

    @cached_property
    def final_comparisons(self) -> tuple[Comparison, ...]:
        """Base and present model on the final data, once nothing is to be added."""
        present = self.present
        is_open = present is None or present.proposed
        if self.ending is None or (is_open and not self.stopped):
            return ()
        fits = (self.steps[0].fit, self.last.fit)
        try:
            records = [Record.of_aligned(fit, self.ending) for fit in fits]
            return tuple(map(compare_record, records))
        except SolveError:
            return ()

    @property
    def final_words(self) -> str:
        """What the data for the end say; "" as long as there are no comparisons."""
        if not self.final_comparisons or self.final is None:
            return ""
        base, last = self.final_comparisons
        size, unit = self.error_scale
        noise = number(size * last.noise_floor, 3)
        change = f"is {number(size * last.rmse, 3)}{spaced(unit)}"
        if len(self.steps) > 1:
            change = change_words(size * base.rmse, size * last.rmse, spaced(unit))
        which = number_of(len(self.final), "run")
        if len(self.final) == 1:
            which = self.final.trajectories[0].title
        return f"In the final test ({which}), the error {change} (noise {noise})."

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.training.notes, *map("held out: {}".format, self.judging_notes))

    @property
    def judging_notes(self) -> tuple[str, ...]:
        """Those of the data held out alone."""
        notes = () if self.judging is None else self.judging.notes
        return tuple(note for note in notes if note not in self.training.notes)

    def data_chart(self) -> "Chart":
        return self.train.chart(self.held_out, self.final)

    def told(self, *effects: Effect) -> str:
        return effects_words(effects, self.train.labels)

    def called(self, label: str) -> str:
        """The label of a step, with its effects as people read them."""
        for step in self.steps:
            for effect in step.added:
                label = label.replace(str(effect), self.told(effect))
        return label

    @property
    def last(self) -> Step:
        return self.steps[-1]

    @property
    def present(self) -> Diagnosis | None:
        """The diagnosis of the present model; None before there is one."""
        return self.diagnoses.get(len(self.steps) - 1)

    @property
    def unestablished(self) -> tuple[Candidate, ...]:
        """Effects that were added and that diagnoses considered but did not name."""
        considered: dict[str, Candidate] = {}
        established: set[str] = set()
        for _, diagnosis in sorted(self.diagnoses.items()):
            considered |= {one.name: one for one in diagnosis.ranking}
            for finding in diagnosis.findings:
                established |= set(map(str, finding.effects))
        names = considered.keys() - established
        added = map(str, self.last.added)
        return tuple(considered[name] for name in added if name in names)

    def held_as(self, hold: Hold, notes: tuple[str, ...]) -> "StudyRecord":
        """With inputs that do otherwise between their samples."""
        training = self.training.held_as(hold, notes)
        judging = self.judging and self.judging.held_as(hold, notes)
        ending = self.ending and self.ending.held_as(hold, notes)
        return replace(self, training=training, judging=judging, ending=ending)

    # ---- what is said of it ----------------------------------------------------------

    @property
    def unit(self) -> str:
        return self.last.train.error_unit

    @property
    def error_scale(self) -> tuple[float, str]:
        """A factor on errors, and the unit in which they are told."""
        return scale_of_errors(self.unit, self.steps[0].judged.rmse)

    def errors(self, size: float = 1.0) -> tuple[ErrorStep, ...]:
        """The free-run errors step by step, times a size."""
        found = []
        last = len(self.steps) - 1
        finals = dict(zip((0, last), self.final_comparisons, strict=False))
        for k, step in enumerate(self.steps):
            final = size * finals[k].rmse if k in finals else None
            held_out = size * step.held_out.rmse if step.held_out else None
            errors = (size * step.train.rmse, held_out, size * step.judged.noise_floor)
            low, high = step.judged.noise_floor_interval
            ends = (size * low, size * high)
            label = self.called(step.label)
            found.append(ErrorStep(label, *errors, step.fit.bic, ends, final))
        return tuple(found)

    @property
    def history(self) -> "pd.DataFrame":
        """A row per step; NaN where nothing is held out."""
        rows = []
        for step, one in zip(self.steps, self.errors(), strict=True):
            rows.append((step.label, one.train, one.held_out, one.floor, one.bic))
        table = printed_table(rows, columns=list(COLUMNS_OF_ERRORS))
        table.insert(0, "step", range(len(rows)))
        table.insert(5, "unit", self.unit)
        return table.astype({"held_out_rmse": float})

    # ---- fits of further models ------------------------------------------------------

    def _records(self, fit: Fit) -> list[Record]:
        """A fit on the training data and, where there are some, on data held out."""
        data = filter(None, (self.training, self.judging))
        return [Record.of_aligned(fit, one) for one in data]

    def step(self, label: str, added: tuple[Effect, ...], fit: Fit) -> Step:
        """A fit with its free runs on both records."""
        return Step(label, added, fit, *map(compare_record, self._records(fit)))

    def evidence(self, fit: Fit) -> float:
        """Log evidence of a fitted model beside a force, by all measurements."""
        trained, *judged = self._records(fit)
        judging = judged[0] if judged else None
        return EvidenceRecord.of(trained, judging).base.log_evidence

    def fitted(
        self,
        model: Model,
        start: Fit | None = None,
        settings: SolverSettings | None = None,
    ) -> Fit:
        """A model fitted to the training data, from the estimates of another fit."""
        return identify(model, self.training, self.loss, start=start, settings=settings)

    def fitted_base(self) -> Fit:
        """By the changes between samples where no motion follows the record."""
        try:
            return self.fitted(self.base)
        except SolveError as error:
            try:
                fit = identify(self.base, self.training, PHSILoss())
            except PhsiOptError:
                raise error from None
            return replace(fit, doubts=Later.known(NOT_FOLLOWED))

    def larger(self, effect: Effect, found: Candidate | None) -> Fit:
        """The present model with one effect, from what a diagnosis found of it."""
        present = self.last.fit
        if found is not None and found.fit is not None:
            fit = thorough_fit(self.training, self.loss, found.fit)
        else:
            model = present.model.add(effect)
            values = {} if found is None else found.values
            known = {name: values[name] for name in model.free if name in values}
            fit = self.fitted(model.with_values(known), present)
        if is_worse(fit, present):
            fit = self.fitted(with_no_size(present.model, effect), present)
        if is_worse(fit, present):
            raise SolveError(
                f"{self.told(effect)} is not added: with it no fit was found that is "
                f"as good as the present one (-2 log likelihood {deviance(fit):.6g} "
                f"against {deviance(present):.6g}), so these data do not show it; try "
                "other starting values, or another effect."
            )
        return fit

    def model_with(self, effects: Iterable[Effect]) -> Model:
        """The base model with effects, and the present values of its parameters."""
        model = self.base
        for effect in effects:
            model = model.add(effect)
        values = self.last.fit.model.values
        known = {name: one for name, one in values.items() if name in model.entries}
        return model.with_values(known)

    def size(self, effect: Effect) -> Size:
        others = [other for other in self.last.added if other is not effect]
        return fitted_size(self.model_with(others), self.last.fit, effect)

    def law(self, effect: Effect) -> Follows:
        """The force that the present model lacks without one of the effects added.

        A law of one variable, or of a difference, is shown against that; others against
        what predicts them best. All other values are those of the present fit: a base
        model that was fitted without the effect would make up for a part of it.
        """
        if effect.slot == "sensor":
            raise ModelError(
                f"{effect} acts in a sensor; no force is missing without it."
            )
        others = [other for other in self.last.added if other is not effect]
        frozen = self.model_with(others).frozen()
        fit = identify(frozen, self.training, MaximumLikelihood())
        analysis = ForceAnalysis.of(Record.of_aligned(fit, self.training))
        first = frozen.states[frozen.rows(effect.equation)[0]]
        force = analysis.force_in(first)
        larger = self.model_with(self.last.added).frozen()
        points = force.record.points
        if effect.memory or larger.delays:  # which the smaller model does not have
            middles = Points.middles(self._records(self.last.fit)[0])
            points = replace(middles, theta=points.theta)
        law = None
        variable = ""
        if len(points.t) == len(force.w):
            known = list(map(larger.states.index, frozen.states))
            of_known = replace(force.record.points, x=points.x[:, known])
            rates = points.values(larger.rhs())[:, known]
            law = (rates - of_known.values(frozen.rhs()))[:, force.row]
            variable = _natural_variable(effect, larger)
            record = replace(force.record, model=larger, points=points)
            force = replace(force, record=record)
        told = self.told(effect)
        heading = f"{capitalised(force.quantity)} that is missing without {told}"
        said = (
            f"The added law: the {force.quantity} missing in {force.equation_words} if "
            f"{told} is removed from the present model and all other values are kept"
        )
        heading, said = map(proper_names, (heading, said))
        return follows_of(force, variable, heading, said, law)

    def laws(self) -> tuple[Follows, ...]:
        """The laws of the three effects added first, as far as they can be shown."""
        found = []
        variables = {*_variables(self.last.fit.model)}
        for effect in self.last.added[:3]:
            if effect.slot != "R" and not effect.names & variables:
                continue  # a constant
            try:
                found.append(self.law(effect))
            except PhsiOptError:
                continue  # a sensor's, or a model that is too far off without it
        return tuple(found)


def _variables(model: Model) -> tuple[str, ...]:
    return (*model.states, *model.inputs, *model.efforts, "t")


def _natural_variable(effect: Effect, model: Model) -> str:
    """The variable, or the difference of two, of which its law is a function."""
    if effect.slot == "R":
        return DIFFERENCE.join(
            model.efforts[row] for row in model.rows(effect.equation)
        )
    names = [name for name in _variables(model) if name in effect.names]
    body = effect.term.terms[0].body
    for pair in permutations(names, 2):
        if len(names) == 2 and DIFFERENCE.join(pair) in body:
            return DIFFERENCE.join(pair)
    return names[0] if len(names) == 1 and names[0] not in model.memory else ""
