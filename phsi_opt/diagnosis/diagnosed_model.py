"""The model that is diagnosed: its free runs, and how larger models are fitted."""

from collections.abc import Callable
from dataclasses import dataclass

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import ONE_ATTEMPT_INTERVALS
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.record import Record
from phsi_opt.transcription.losses import MaximumLikelihood


@dataclass(frozen=True, eq=False)
class DiagnosedModel:
    """What every re-fit of a diagnosis is made from and measured against.

    Attributes:
        trained: the base model's free run on the training record.
        judged: the same on the record that judges; ``trained`` where none is held out.
        loss: how larger models are fitted.
        say: called with a line of text as the work goes on.
    """

    trained: Comparison
    judged: Comparison
    loss: MaximumLikelihood
    say: Callable[[str], None]

    @property
    def fit(self) -> Fit:
        """The fit of the base model."""
        return self.trained.fit

    @property
    def record(self) -> Record:
        """The base model along the training record."""
        return self.trained.record

    @property
    def is_held_out(self) -> bool:
        """Whether data that were not fitted judge."""
        return self.judged is not self.trained

    @property
    def is_long(self) -> bool:
        """Whether the record is so long that a re-fit has one attempt."""
        return n_intervals(self.fit) > ONE_ATTEMPT_INTERVALS


def n_intervals(fit: Fit) -> int:
    """Number of intervals of a fit, over all gaps between samples."""
    return sum(int(steps.sum()) for steps in fit.steps)
