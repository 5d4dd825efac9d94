"""What a study is at one moment; texts, reports and pages are made from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.study.history import history_table
from phsi_opt.study.step import Step
from phsi_opt.transcription.losses import MaximumLikelihood

if TYPE_CHECKING:
    import pandas as pd


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
    def unestablished(self) -> tuple[Candidate, ...]:
        """What was added although diagnoses considered it, and none established it."""
        considered: dict[str, Candidate] = {}
        established: set[str] = set()
        for _, diagnosis in sorted(self.diagnoses.items()):
            considered |= {one.name: one for one in diagnosis.ranking}
            for finding in diagnosis.findings:
                established |= set(map(str, finding.effects))
        found = []
        for effect in self.last.added:
            name = str(effect)
            if name in considered and name not in established:
                found.append(considered[name])
        return tuple(found)

    @property
    def history(self) -> "pd.DataFrame":
        """A row per step (see `history_table`)."""
        return history_table(self.steps)

    @property
    def unit(self) -> str:
        """Unit of the errors, that of the channel where one is measured."""
        return self.last.train.error_unit
