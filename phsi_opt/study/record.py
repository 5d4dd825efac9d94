"""What a study is at one moment; all that is told of it is made from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from phsi_opt.comparison.compare import Comparison
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect
from phsi_opt.presentation.content import ErrorStep, unestablished_words
from phsi_opt.presentation.summary import Part, Summary, printed_table
from phsi_opt.transcription.losses import MaximumLikelihood

if TYPE_CHECKING:
    import pandas as pd

# What the history calls the fields of an `ErrorStep`.
COLUMNS_OF_ERRORS = ("effect", "train_rmse", "held_out_rmse", "noise_floor", "bic")


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a study: a model, its fit, and how far its free runs are off.

    Attributes:
        label: what was done.
        added: the effects that the model has since beyond the base model.
        fit: of the model.
        train: its free run on the training record.
        held_out: its free run on data held out; None where there are none.
    """

    label: str
    added: tuple[Effect, ...]
    fit: Fit
    train: Comparison
    held_out: Comparison | None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.label!r})"

    @property
    def judged(self) -> Comparison:
        """The comparison that judges, on data held out or else the training record."""
        return self.held_out or self.train


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """A study as it stands.

    Attributes:
        steps: what was done so far, the base model first.
        diagnoses: by the number of the step whose model they look at.
        stopped: why it stopped last; "" where it was not asked to go on.
        train: measurements that are fitted; ``held_out``: those that judge, or None.
        loss: how the models were fitted.
    """

    steps: tuple[Step, ...]
    diagnoses: Mapping[int, Diagnosis]
    stopped: str
    train: Measurements
    held_out: Measurements | None
    loss: MaximumLikelihood

    @property
    def last(self) -> Step:
        """The present step."""
        return self.steps[-1]

    @property
    def present(self) -> Diagnosis | None:
        """The diagnosis of the present model; None before there is one."""
        return self.diagnoses.get(len(self.steps) - 1)

    @property
    def unestablished(self) -> tuple[Candidate, ...]:
        """What was added although diagnoses considered it, and none established it."""
        considered: dict[str, Candidate] = {}
        established: set[str] = set()
        for _, diagnosis in sorted(self.diagnoses.items()):
            considered |= {one.name: one for one in diagnosis.ranking}
            for finding in diagnosis.findings:
                established |= set(map(str, finding.effects))
        names = list(map(str, self.last.added))
        open_ = [name for name in names if name not in established]
        return tuple(considered[name] for name in open_ if name in considered)

    def errors(self, size: float = 1.0) -> tuple[ErrorStep, ...]:
        """The free-run errors step by step, times a size."""
        found = []
        for step in self.steps:
            held_out = None if step.held_out is None else size * step.held_out.rmse
            errors = (size * step.train.rmse, held_out, size * step.judged.noise_floor)
            found.append(ErrorStep(step.label, *errors, step.fit.bic))
        return tuple(found)

    @property
    def history(self) -> "pd.DataFrame":
        """A row per step; NaN where nothing is held out."""
        rows = [tuple(vars(one).values()) for one in self.errors()]
        table = printed_table(rows, columns=list(COLUMNS_OF_ERRORS))
        table.insert(0, "step", range(len(rows)))
        return table.astype({"held_out_rmse": float})

    @property
    def unit(self) -> str:
        """Unit of the errors, that of the channel where one is measured."""
        return self.last.train.error_unit

    @property
    def summary(self) -> Summary:
        """The effects that were added, the history, and why the study stopped."""
        added = ", ".join(map(str, self.last.added))
        title = f"Study of {type(self.last.fit.model).__name__}"
        title += f", added: {added}" if added else ", nothing added yet"
        unit = f", {self.unit}" if self.unit else ""
        parts = [Part(f"errors of free runs{unit}", table=self.history)]
        names = tuple(one.name for one in self.unestablished)
        said = "\n".join(filter(None, (self.stopped, unestablished_words(names))))
        if said:
            parts.append(Part(text=said))
        return Summary(title, tuple(parts))
