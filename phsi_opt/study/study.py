"""The loop: compare, diagnose, add, watch the error fall; stop when nothing is left.

It stops when no further effect is decisive, and says why.
"""

import datetime as dt
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phsi_opt.arguments import require_choice, require_count, require_known, typed
from phsi_opt.comparison.compare import Comparison
from phsi_opt.data.checks import Hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Grade, at_limit
from phsi_opt.diagnosis.diagnose import candidate_of, diagnose_comparison
from phsi_opt.diagnosis.experiments import Experiment, next_experiment
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import BRIEF, thorough_fit
from phsi_opt.errors import (
    DataError,
    ModelError,
    PhsiOptError,
    SolveError,
    shown,
    some_of,
)
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identifiability import cautions
from phsi_opt.interrupts import interruptible
from phsi_opt.model.catalogue import EffectChoice, Given, effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.presentation.content import HELD_OUT, TRAINING, StudyContent
from phsi_opt.presentation.summary import Summarised, Summary
from phsi_opt.screening.effect_size import new_names
from phsi_opt.study.record import Step, StudyRecord
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.writing import make_folder, write_whole, written_path

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

REPORT_SUFFIXES = (".html", ".md", ".txt")
# What an earlier study found of the last step, by the effects to consider; None: none.
Recall = Callable[[StudyRecord, EffectChoice], Diagnosis | None]


class Study(Summarised):
    """A model, the measurements to which it is fitted, and the effects added so far.

    The model given is never changed; ``study.model`` is the present one. Every error is
    the root mean square of the free-run residual over the measured channels, in the
    unit of the channel if there is a single one, otherwise in standard deviations.

    Args:
        model: the base model.
        train: measurements to fit.
        held_out: measurements for tests, not used for fitting (recommended). They help
            to choose effects.
        final: measurements used neither to fit nor to choose effects: when no further
            effect is to be added, base and present model are compared with them.
        effects: the effects that diagnoses consider, each an `Effect`, a name such as
            ``"coulomb friction"`` (in every equation that can have it) or
            ``"coulomb friction on p"``; default: `catalogue` of the model.
        without: effects to exclude, in the same form.
        loss: how to fit; default `MaximumLikelihood`.
        title: of reports, such as the machine; default: what was measured.
        progress: called with a line of text about the progress, such as ``print``.
        fit: a fit of the base model to the training data; default: a new one.

    Attributes:
        base: the base model.
        record: the present state of the study, from which reports are made.

    Raises:
        DataError: a state or input of the model is not in the measurements, a run is in
            two parts of the data, or ``fit`` is of other measurements.
        ModelError: one of the ``effects``, or of those to leave out, is unknown.
        SolveError: the base model could not be fitted, not even by `PHSILoss`.
    """

    @typed
    @interruptible
    def __init__(
        self,
        model: Model,
        train: Measurements,
        held_out: Measurements | None = None,
        *,
        final: Measurements | None = None,
        effects: Given | None = None,
        without: Given = (),
        loss: MaximumLikelihood | None = None,
        title: str = "",
        progress: Progress | None = None,
        fit: Fit | None = None,
    ) -> None:
        self.base = model
        self._choice = EffectChoice(effects, without).checked(model, train.units)
        self._say = progress or silent
        # Effects and inputs that each diagnosis considered, by the number of the step.
        self.considered: dict[int, tuple[EffectChoice, Hold]] = {}
        self.recalled: Recall | None = None
        loss = loss or MaximumLikelihood()
        record = StudyRecord.of(model, train, held_out, loss, final)
        self.record = replace(record, title=title)
        for note in self.record.notes:
            self._say(note)
        if fit is None:
            for caution in cautions(model, train):
                self._say(caution)
            self._say("fitting the base model")
            fit = self.record.fitted_base()
        self._check_data(fit)
        self._take("base model", (), fit)
        if self.record.last.train.warning:
            self._say(self.record.last.train.warning)

    def _summary(self) -> Summary:
        from phsi_opt.study.answers import summary_of

        return summary_of(self.record)

    @property
    def steps(self) -> list[Step]:
        """The steps so far, the base model first."""
        return list(self.record.steps)

    @property
    def stopped(self) -> str:
        """Why `auto` stopped; "" if it was not called."""
        return self.record.stopped

    @property
    def train(self) -> Measurements:
        """The measurements for fitting, in the order of the model."""
        return self.record.train

    @property
    def held_out(self) -> Measurements | None:
        """The held-out measurements, in the order of the model."""
        return self.record.held_out

    @property
    def final(self) -> Measurements | None:
        """The measurements for the final test, in the order of the model."""
        return self.record.final

    @property
    def fit(self) -> Fit:
        """The present fit."""
        fit = self.record.last.cautioned
        return fit if fit.data is not None else replace(fit, data=self.train)

    @property
    def model(self) -> Model:
        """The present model, with its fitted values."""
        return self.fit.model

    @property
    def added(self) -> tuple[Effect, ...]:
        """The effects added to the base model, oldest first."""
        return self.record.last.added

    @interruptible
    def compare(self, on: str | None = None) -> Comparison:
        """The free run of the present model.

        Args:
            on: ``"held out"`` or ``"training"``; default: the held-out data, or the
                training data if there are none.

        Raises:
            DataError: ``on="held out"``, but no data were held out.
        """
        step = self.record.last
        if on not in (None, TRAINING, HELD_OUT):
            raise DataError(f"on={on!r} is neither {HELD_OUT!r} nor {TRAINING!r}.")
        found = {None: step.judged, TRAINING: step.train, HELD_OUT: step.held_out}[on]
        if found is None:
            raise DataError(
                f"on={on!r}, but no data were held out; give Study(..., held_out=...)."
            )
        return found

    @typed
    @interruptible
    def diagnose(self, *, executor: Executor | None = None) -> Diagnosis:
        """Diagnose the present model; computed once per step.

        Args:
            executor: computes the evidence of candidates in parallel; as in `auto`.

        Raises:
            DataError: the executor is not valid.
        """
        return self._diagnosed(self._choice, executor)

    def _diagnosed(self, choice: EffectChoice, executor: Executor | None) -> Diagnosis:
        record = self.record
        number = len(record.steps) - 1
        if record.present is not None and self.considered[number][0] == choice:
            return record.present
        step = record.last
        known = self.recalled and self.recalled(record, choice)
        found = known or diagnose_comparison(
            step.train,
            step.held_out,
            choice=choice,
            loss=record.loss,
            progress=self._say,
            executor=executor,
        )
        self.considered[number] = (choice, record.train.hold)
        if found.data.hold != record.train.hold:
            record = record.held_as(found.data.hold, found.record.aligned.notes)
        if found.fit is not step.fit:  # such as to inputs held otherwise
            step = record.step(f"{step.label}, re-fitted", step.added, found.fit)
        steps = (*record.steps[:-1], step)
        diagnoses = {**record.diagnoses, number: found}
        self.record = replace(record, steps=steps, diagnoses=diagnoses)
        return found

    @typed
    @interruptible
    def add(
        self,
        effect: str | Effect | None = None,
        equation: str | None = None,
        *,
        fit: Fit | None = None,
    ) -> Fit:
        """Add an effect, re-fit, and return the fit.

        Args:
            effect: an `Effect`, or its name in the ranking or the catalogue; default:
                what the diagnosis of the present model proposes, which may be several.
            equation: the equation of an effect that is given by name; not needed if
                only one equation can have it.
            fit: a fit of the model with the effect to the training data; default: a new
                one.

        Raises:
            DataError: ``fit`` is of other measurements.
            ModelError: there is no such effect, it is in the model already, or none is
                proposed.
            SolveError: the larger model could not be fitted.
        """
        present = self.record.present
        if effect is None:
            if present is None or not present.proposed:
                raise ModelError(
                    "no effect is proposed: call diagnose() first, or name the effect."
                )
            return self._add_all(present.proposed, present.proposed_fit)
        ranking = () if present is None else present.ranking
        if isinstance(effect, str):
            ranked = {one.name: one.effect for one in ranking}
            units = self.train.units
            effect = ranked.get(effect) or effect_named(
                self.model, effect, equation, units
            )
        if fit is not None:
            self._check_data(fit)
            return self._take(str(effect), (*self.added, effect), fit)
        if present and present.proposed_fit and present.proposed == (effect,):
            return self._add_all(present.proposed, present.proposed_fit)
        found = next((one for one in ranking if one.effect == effect), None)
        self._say(f"adding {self.record.told(effect)}")
        if found is None or found.fit is None:
            step = self.record.last
            found = candidate_of(step.train, effect, self.record.loss)
        fit = self.record.larger(effect, found)
        return self._take(str(effect), (*self.added, effect), fit)

    def _take(self, label: str, added: tuple[Effect, ...], fit: Fit) -> Fit:
        return self._go_on(self.record.step(label, added, fit))

    def _check_data(self, fit: Fit) -> None:
        if fit.provenance.get("data_sha256") != self.train.digest:
            raise DataError(
                "fit was made from other measurements than the training data of the "
                "study; leave it out, and the model is fitted anew."
            )

    def _go_on(self, step: Step) -> Fit:
        self.record = replace(self.record, steps=(*self.record.steps, step))
        return step.cautioned

    def _fit_with(
        self, effects: tuple[Effect, ...], settings: SolverSettings | None = None
    ) -> Fit:
        model = self.record.model_with(effects)
        return self.record.fitted(model, self.fit, settings)

    @interruptible
    def remove(self, effect: str | Effect, equation: str | None = None) -> Fit:
        """Remove an effect of an earlier step, re-fit the model, and return the fit.

        Args:
            effect: an `Effect` that was added, or its name.
            equation: its equation, if effects of this name were added to several
                equations.

        Raises:
            ModelError: no such effect was added, or several.
            SolveError: the smaller model could not be fitted.
        """
        known = self._added_effect(effect, equation)
        self._say(f"removing {self.record.told(known)}")
        kept = self._without(known)
        return self._take(f"without {known}", kept, self._fit_with(kept))

    def undo(self) -> Fit:
        """Undo the last step, with the effect that it added; return the previous fit.

        Raises:
            ModelError: the study is at its base model.
        """
        record = self.record
        if len(record.steps) == 1:
            raise ModelError(
                "there is nothing to undo: the study is at its base model."
            )
        steps = record.steps[:-1]
        left = {k: one for k, one in record.diagnoses.items() if k < len(steps)}
        self.record = replace(record, steps=steps, diagnoses=left, stopped="")
        return self.fit

    @typed
    @interruptible
    def auto(
        self,
        max_steps: int = 4,
        effects: Given | None = None,
        without: Given = (),
        *,
        reach: str = Grade.DECISIVE,
        executor: Executor | None = None,
    ) -> str:
        """Diagnose and add effects as long as one is decisive; return why it stopped.

        After each step, earlier effects are removed if the evidence without them is at
        least as high, or if a parameter of theirs has ended at a limit.

        Args:
            max_steps: largest number of steps.
            effects: the effects to consider, as in `Study`; default: those that the
                study considers.
            without: effects to exclude, in addition to those that the study excludes.
            reach: ``"decisive"``, or ``"strong"`` to add an effect whose evidence is
                strong if none is decisive; study and reports then mark it as not
                established.
            executor: computes the evidence of candidates in parallel (see `sweep`);
                None: in this process, one after the other. The results are the same. It
                is not shut down.

        Returns:
            Why it stopped; kept in ``stopped``.

        Raises:
            DataError: the executor is not valid.
            ModelError: one of the ``effects``, or of those to leave out, is unknown, or
                another argument has a value that is not allowed.
        """
        require_count("max_steps", max_steps)
        require_choice("reach", reach, (Grade.DECISIVE, Grade.STRONG))
        further = EffectChoice(effects, without).checked(self.base, self.train.units)
        chosen = self._choice.effects if further.effects is None else further.effects
        choice = EffectChoice(chosen, (*self._choice.without, *further.without))
        for _ in range(max_steps):
            diagnosis = self._diagnosed(choice, executor)
            said = diagnosis.said
            self._say(said)
            proposed = diagnosis.proposed
            if not proposed and reach == Grade.STRONG:
                proposed = diagnosis.strong
            if not proposed:
                return self._stop(said)
            earlier = self.added
            try:
                self._add_all(proposed, diagnosis.proposed_fit)
            except SolveError as error:
                which = self.record.told(*proposed)
                return self._stop(f"{said}; {which} could not be added: {error}")
            self._check_earlier(earlier)
        return self._stop(
            f"the limit of {max_steps} steps was reached; call auto again to continue"
        )

    def _stop(self, why: str) -> str:
        self.record = replace(self.record, stopped=why)
        return why

    @typed
    @interruptible
    def next_experiment(
        self,
        limits: Mapping[str, Any] | None = None,
        start: Mapping[str, Any] | None = None,
        sharpen: str | None = None,
        *,
        seed: int = 0,
    ) -> Experiment:
        """Design the experiment that tells most.

        If the last diagnosis found effects that the data do not distinguish, it
        distinguishes two of them: it maximises the expected log Bayes factor. Else it
        reduces the standard errors of the present model, with what the diagnosis
        proposes (D-optimality). Input and start are the variables of one nonlinear
        program. The log Bayes factor to expect is checked by simulating and re-fitting.

        Args:
            limits: lower and upper value by input, state, or formula of these (such as
                ``"p/m"``); the longest duration as ``"t"``. What is not given stays
                within its range in the training data. In SI units.
            start: by state a number, or a lower and an upper one to choose from. States
                that are not given start as in the longest run, or, in a model without
                inputs, anywhere within their limits.
            sharpen: a parameter of the present model, whose standard error is reduced
                whatever was found.
            seed: of the inputs that the search begins with.

        Returns:
            Times, inputs, start and what to expect; ``to_csv`` writes it for the rig.

        Raises:
            ModelError: limits that contradict each other, or of something unknown.
            SolveError: no experiment that keeps within the limits was found.

        Examples:
            >>> study.next_experiment({"u": (-5, 5), "t": 10.0})  # doctest: +SKIP
            Apply steps for 10 s, u from -5 to 5 N: ...
        """
        found = list(self.record.diagnoses.values())
        tied = next((one for one in reversed(found) if one.tied), None)
        present = self.record.present
        fit = (present and present.proposed_fit) or self.fit
        fits = {"the present model": fit}
        noise = dict(fit.noise)
        if tied is not None and sharpen is None:
            fits = tied.tied
            noise = tied.noise
        self._say("designing the next experiment")
        return next_experiment(fits, self.train, noise, limits, start, sharpen, seed)

    @property
    def history(self) -> "pd.DataFrame":
        """The steps so far.

        Columns: step, effect, train_rmse, held_out_rmse (NaN without data held out),
        noise_floor, the unit of these errors, bic (NaN for a fit by `PHSILoss`).
        """
        return self.record.history

    def plot(
        self,
        ax: "Axes | None" = None,
        trajectory: str | int | None = None,
        state: str | None = None,
    ) -> "Axes":
        """Draw measurements and free runs of base and present model.

        The residuals are below, with two standard deviations of the noise.

        Args:
            ax: Axes to draw on; None: a new figure.
            trajectory: its name or its number among the held-out runs, then those for
                fitting; default: where base and present model differ most.
            state: the measured state; default: the one in which they differ most.

        Raises:
            DataError: there is no such trajectory or state.
        """
        from phsi_opt.presentation.charts import drawn, run_chart

        content = self.content()
        runs = content.runs
        if trajectory is None:
            trajectory = content.shown
        named = list(map(attrgetter("name"), runs))
        number = named.index(trajectory) if trajectory in named else trajectory
        if not isinstance(number, int) or not -len(runs) <= number < len(runs):
            raise DataError(
                f"there is no trajectory {shown(trajectory)}; there are {len(runs)}: "
                f"{some_of(named)}."
            )
        states = list(self.train.measured)  # in the order of the channels
        if state is None:
            state = states[content.shown_channel]
        require_known(state, states, f"state {shown(state)} is not measured", DataError)
        chart = run_chart(content, runs[number], states.index(state))
        return drawn(chart, chart.title, ax)

    def plot_history(self, ax: "Axes | None" = None) -> "Axes":
        """Training and held-out error per step, with the noise floor."""
        from phsi_opt.presentation.charts import drawn, errors_chart

        chart = errors_chart(self.record.errors(), self.unit)
        return drawn(chart, "Free-run error after each added effect", ax)

    def plot_effect(
        self,
        effect: str | Effect,
        equation: str | None = None,
        ax: "Axes | None" = None,
    ) -> "Axes":
        """Draw the force that is missing if an added effect is removed.

        All other values are those of the present model, so the figure shows the whole
        effect, against the variable on which it depends.

        Args:
            effect: one that was added, or its name.
            equation: its equation, if effects of this name were added to several
                equations.
            ax: Axes to draw on; None: a new figure.

        Raises:
            ModelError: no such effect was added, or several, or it is a sensor effect.
            SolveError: the states could not be estimated with the model without the
                effect.
        """
        from phsi_opt.presentation.charts import drawn, follows_chart

        law = self.record.law(self._added_effect(effect, equation))
        return drawn(follows_chart(law), law.heading, ax)

    @property
    def unit(self) -> str:
        """Unit of the errors, that of the channel where one is measured."""
        return self.record.unit

    @typed
    @interruptible
    def report(self, path: str | Path) -> Path:
        """Write the study as a report, and return the path.

        An HTML file contains the verdict, errors, equations, measurements and model,
        where the model fails, ranked effects, checks and settings. It needs no network;
        in print, static pictures replace the charts.

        Args:
            path: ``.html`` for a report with charts; ``.md`` or ``.txt`` for text.

        Raises:
            DataError: the file has another ending, or cannot be written.
        """
        from phsi_opt.presentation.html_report import html_report, markdown_report
        from phsi_opt.study.content import study_content

        place = written_path(path)
        if place.suffix not in REPORT_SUFFIXES:
            raise DataError(
                f"a report is written as {' or '.join(REPORT_SUFFIXES)}; "
                f"{place.name!r} is none of these."
            )
        if place.suffix != ".html":
            return write_whole(place, markdown_report(self.content()))
        today = f"{dt.date.today()}"
        content = study_content(self.record, self.record.laws(), written=today)
        return write_whole(place, html_report(content, self.record.data_chart()))

    @typed
    @interruptible
    def export_figures(
        self, folder: str | Path, kinds: Sequence[str] = ("csv", "svg")
    ) -> list[Path]:
        """Write every figure of the report into files, and return their paths.

        Args:
            folder: of the files; it is made where it is not there.
            kinds: of the files: "csv" has the numbers of a figure, "svg", "png" and
                "pdf" are the figure itself.

        Raises:
            DataError: there is no such kind, or a file cannot be written.

        Examples:
            >>> paths = study.export_figures("figures", ["csv"])
            >>> print(paths[0].name)
            errors.csv
        """
        from phsi_opt.presentation.charts import saved
        from phsi_opt.presentation.html_report import figures_of
        from phsi_opt.study.content import study_content

        known = ("csv", "svg", "png", "pdf")
        for kind in kinds:
            require_known(kind, known, f"kind {shown(kind)} of file", DataError)
        every = 10**9  # samples: none is left out
        content = study_content(self.record, self.record.laws(), most=every)
        place = Path(folder)
        make_folder(place)
        paths = []
        for name, chart in figures_of(content, self.record.data_chart()).items():
            for kind in dict.fromkeys(kinds):
                path = place / f"{name}.{kind}"
                paths.append(write_whole(path, saved(chart, kind)))
        return paths

    def content(self, *, forces: bool = False) -> StudyContent:
        """The contents of a report: numbers, arrays and words.

        Args:
            forces: whether to include the missing force of the present model along all
                runs, also held-out ones, which requires an additional estimate.
        """
        from phsi_opt.study.content import study_content

        return study_content(self.record, forces=forces)

    def _added_effect(self, effect: str | Effect, equation: str | None) -> Effect:
        if isinstance(effect, Effect):
            equation, effect = effect.equation, effect.name
        named = [known for known in self.added if known.name == effect]
        found = [known for known in named if equation in (None, known.equation)]
        if len(found) != 1:
            listed = ", ".join(map(str, self.added)) or "none"
            raise ModelError(
                f"{len(found)} effects named {effect!r} on "
                f"{equation or 'any equation'} were added; added are {listed}."
            )
        return found[0]

    def _without(self, effect: Effect) -> tuple[Effect, ...]:
        return tuple(known for known in self.added if known is not effect)

    def _add_all(self, effects: tuple[Effect, ...], fit: Fit | None) -> Fit:
        """Add effects that were fitted together, a step each."""
        if fit is None:
            return self.add(effects[0])
        self._say(f"adding {self.record.told(*effects)}")
        added = (*self.added, *effects)
        label = str(effects[-1])
        present = self.record.present
        for effect in effects[:-1]:
            with suppress(SolveError):  # such a path has a step less
                larger = (*self.added, effect)
                self._take(str(effect), larger, self._fit_with(larger, BRIEF))
        first = present.ranking[0] if present else None
        if first is None or first.fit is not fit or first.trained is None:
            return self._take(label, added, fit)
        judged = None if self.held_out is None else first.comparison
        return self._go_on(Step(label, added, fit, first.trained, judged))

    def _check_earlier(self, earlier: Sequence[Effect]) -> None:
        record = self.record
        for effect in earlier:
            kept = self._without(effect)
            told = record.told(effect)
            try:
                fit = self._fit_with(kept, BRIEF)
                gain = record.evidence(fit) - record.evidence(self.fit)
            except PhsiOptError as error:
                self._say(f"{told} stays: no fit of the model without it ({error})")
                continue
            names = new_names(fit.model, effect, self.fit.names)
            at_bounds = self.fit.outcome.at_bounds
            lost = at_limit(self.fit.model, names, at_bounds, self.train.labels)
            if gain > 0 or lost:
                self._say(f"{told} is removed: {lost or 'it has become superfluous'}")
                fit = thorough_fit(record.training, record.loss, fit)
                self._take(f"without {effect}", kept, fit)
