"""The loop: compare, diagnose, add, watch the error fall; stop when nothing more is
significant, and say why.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from phsi_opt.comparison.compare import Comparison, compare, compared
from phsi_opt.comparison.model_selection import delta_bic, deviance, share_of
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnose import diagnose
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.errors import ModelError, PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.losses import MaximumLikelihood

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# A brief re-fit is an optimum on its own grid: from there a thorough one converges
# soon, or hardly ever (in up to 43 iterations where it was measured).
REFINING = SolverSettings(max_iterations=100)
# rise of -2 log likelihood that is another optimum, and not what steps that are finer
# cost
NO_WORSE = 10.0


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a study: what was done, the effects that the model has since, the
    fit, and both comparisons.
    """

    label: str
    effects: tuple[Effect, ...]
    fit: Fit
    train: Comparison
    held_out: Comparison | None


class Study:
    """A model, the measurements it is fitted to, and the effects added so far.

    Args:
        model: the base model. train: measurements to fit. held_out: measurements to
            judge by (recommended).
        loss: how to fit, default `MaximumLikelihood`. progress: called with a line of
            text as the work goes on.

    The model given is never changed; ``study.model`` is the present one. Every error is
    the root mean square of the free-run residual over the measured channels, in the
    channel's unit where there is one, else in standard deviations.
    """

    def __init__(
        self,
        model: Model,
        train: Measurements,
        held_out: Measurements | None = None,
        *,
        loss: MaximumLikelihood | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        self.base = model
        self.train = aligned(model, train)
        self.held_out = None if held_out is None else aligned(model, held_out)
        self._loss, self._say = (
            loss or MaximumLikelihood(),
            progress or (lambda line: None),
        )
        self._diagnoses: dict[int, Diagnosis] = {}
        self.stopped = ""
        self._say("fitting the base model")
        self.steps: list[Step] = [
            self._step("base model", (), identify(model, self.train, self._loss))
        ]

    @property
    def fit(self) -> Fit:
        """The present fit."""
        return self.steps[-1].fit

    @property
    def model(self) -> Model:
        """The present model, with its fitted values."""
        return self.fit.model

    def compare(self) -> Comparison:
        """The present model against the data held out (the training data where none
        were).
        """
        return self.steps[-1].held_out or self.steps[-1].train

    def diagnose(self) -> Diagnosis:
        """What the present model lacks; worked out once per step."""
        key = len(self.steps)
        if key not in self._diagnoses:
            self._diagnoses[key] = diagnose(
                self.fit, self.train, self.held_out, loss=self._loss, progress=self._say
            )
        return self._diagnoses[key]

    def add(self, effect: str | Effect, equation: str | None = None) -> Fit:
        """Add an effect (by its name in the catalogue and the equation, or an
        `Effect`), re-fit, and return the fit.
        """
        if isinstance(effect, str):
            if equation is None:
                raise ModelError(
                    f"which equation does {effect!r} act in? Write study.add({effect!r}, '<state>')."
                )
            effect = effect_named(self.model, effect, equation)
        known = self._diagnoses.get(len(self.steps))
        found = (
            None
            if known is None
            else next((c for c in known.ranked if c.effect == effect), None)
        )
        self._say(f"adding {effect}")
        if found is None or found.fit is None:
            alone = diagnose(self.fit, self.train, effects=[effect], loss=self._loss)
            found = next(iter(alone.ranked), None)
        fit = self._fitted(effect, found)
        self.steps.append(self._step(str(effect), (*self.effects, effect), fit))
        return fit

    def remove(self, effect: str | Effect, equation: str | None = None) -> Fit:
        """Take out an effect of an earlier step, re-fit all that is left together, and
        return the fit.
        """
        name = effect if isinstance(effect, str) else effect.name
        place = equation if isinstance(effect, str) else effect.equation
        found = [
            e for e in self.effects if e.name == name and place in (None, e.equation)
        ]
        if len(found) != 1:
            raise ModelError(
                f"{len(found)} effects named {name!r} on {place or 'any equation'} were added; added are "
                f"{', '.join(map(str, self.effects)) or 'none'}."
            )
        self._say(f"removing {found[0]}")
        kept = tuple(e for e in self.effects if e is not found[0])
        self.steps.append(self._step(f"without {found[0]}", kept, self._fit_with(kept)))
        return self.fit

    def undo(self) -> Fit:
        """Take back the last step, with all that it added, and return the fit before
        it.
        """
        if len(self.steps) == 1:
            raise ModelError(
                "there is nothing to undo: the study is at its base model."
            )
        self._diagnoses.pop(len(self.steps), None)
        self.steps.pop()
        self.stopped = ""
        return self.fit

    def auto(self, max_steps: int = 4) -> str:
        """Diagnose and add while an effect is significant; returns (and keeps in
        ``stopped``) why it stopped.

        An effect is added when the diagnosis names it, or when it explains most of what
        is missing; two in one step where the diagnosis found each needed beside the
        other. After each step, effects that were added before and that BIC no longer
        asks for are taken out again.
        """
        for _ in range(max_steps):
            diagnosis = self.diagnose()
            self._say(f"{diagnosis.verdict}: {diagnosis.reason}")
            if not diagnosis.together:
                self.stopped = f"{diagnosis.verdict}: {diagnosis.reason}"
                return self.stopped
            try:
                self._add_proposed(diagnosis)
            except SolveError as error:
                which = " and ".join(map(str, diagnosis.together))
                self.stopped = f"{diagnosis.verdict}: {diagnosis.reason}; {which} could not be added: {error}"
                return self.stopped
            self._check_earlier()
        self.stopped = (
            f"the limit of {max_steps} steps was reached; call auto again to go on"
        )
        return self.stopped

    @property
    def history(self) -> pd.DataFrame:
        """step, effect, train_rmse, held_out_rmse, noise_floor, bic (`held_out_rmse` is
        NaN without held-out data).
        """
        rows = []
        for number, step in enumerate(self.steps):
            judged = step.held_out or step.train
            held_out = float("nan") if step.held_out is None else step.held_out.rmse
            rows.append(
                (
                    number,
                    step.label,
                    step.train.rmse,
                    held_out,
                    judged.noise_floor,
                    step.fit.bic,
                )
            )
        return pd.DataFrame(
            rows,
            columns=[
                "step",
                "effect",
                "train_rmse",
                "held_out_rmse",
                "noise_floor",
                "bic",
            ],
        )

    def plot_history(self, ax: "Axes | None" = None) -> "Axes":
        """Training and held-out error per step, with the noise floor."""
        from phsi_opt.presentation.pictures import plot_history

        return plot_history(self.history, ax, self.unit)

    @property
    def unit(self) -> str:
        """Unit of the errors: that of the channel where one is measured."""
        measured = self.train.measured
        return (
            self.train.units.get(measured[0], "")
            if len(measured) == 1
            else "standard deviations"
        )

    def report(self, path: str | Path) -> Path:
        """Write the study as text (Markdown, ``.md`` or ``.txt``): equations, history,
        verdict; returns the path.
        """
        from phsi_opt.presentation.report import write_report

        return write_report(self, Path(path))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that the present model has beyond the base model, in the order in
        which they were added.
        """
        return self.steps[-1].effects

    def _add_proposed(self, diagnosis: Diagnosis) -> None:
        """The effect that the diagnosis proposes; two in one step: each was needed
        beside the other.
        """
        if len(diagnosis.together) > 1 and diagnosis.nearest is not None:
            self._add_together(diagnosis.together, diagnosis.nearest)
        else:
            self.add(diagnosis.together[0])

    def _add_together(self, effects: tuple[Effect, ...], nearest: Fit) -> None:
        """Add effects in one step, from their brief re-fit."""
        label = " and ".join(map(str, effects))
        self._say(f"adding {label}")
        self.steps.append(
            self._step(label, (*self.effects, *effects), self._refined(nearest))
        )

    def _refined(self, brief: Fit) -> Fit:
        """A brief re-fit of a diagnosis made thorough; kept itself where that fails or
        is worse.
        """
        try:
            thorough = identify(
                brief.model, self.train, self._loss, start=brief, settings=REFINING
            )
        except SolveError:
            return brief
        return thorough if deviance(thorough) < deviance(brief) + NO_WORSE else brief

    def _check_earlier(self) -> None:
        """Take out each earlier effect without which BIC is lower."""
        for effect in self.effects[:-1]:
            try:
                without = self._fit_with(
                    tuple(e for e in self.effects if e is not effect)
                )
            except PhsiOptError:
                continue
            train = self.steps[-1].train
            smaller = compared(
                without,
                self.train,
                train.noise[: without.model.n_states],
                without.states,
            )
            if delta_bic(self.fit, without, share_of(smaller, train)) < 0:
                self._say(f"{effect} has become superfluous")
                kept = tuple(e for e in self.effects if e is not effect)
                self.steps.append(self._step(f"without {effect}", kept, without))

    def _fitted(self, effect: Effect, found: Candidate | None) -> Fit:
        """The model with the effect, from what the diagnosis found of it."""
        if found is not None and found.fit is not None:
            return self._refined(found.fit)
        values = {} if found is None else found.values
        return identify(
            self.model.add(effect).with_values(values),
            self.train,
            self._loss,
            start=self.fit,
        )

    def _fit_with(self, effects: tuple[Effect, ...]) -> Fit:
        """The base model with the effects, all parameters re-estimated together from
        their present values.
        """
        model = self.base
        for effect in effects:
            model = model.add(effect)
        known = {
            name: value
            for name, value in self.model.values.items()
            if name in model.entries
        }
        return identify(
            model.with_values(known), self.train, self._loss, start=self.fit
        )

    def _step(self, label: str, effects: tuple[Effect, ...], fit: Fit) -> Step:
        held_out = None if self.held_out is None else compare(fit, self.held_out)
        return Step(label, effects, fit, compare(fit, self.train), held_out)
