"""The model that is diagnosed: its free runs, and how larger models are fitted."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from phsi_opt.comparison.compare import Comparison, is_failing, is_like_noise
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
        executor: where re-fits are made side by side; None: here.
    """

    trained: Comparison
    judged: Comparison
    loss: MaximumLikelihood
    say: Callable[[str], None]
    executor: Executor | None = None

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
    def judging_record(self) -> Record | None:
        """The base model along the data held out; None where there are none."""
        return self.judged.record if self.is_held_out else None

    @property
    def is_noise(self) -> bool:
        """Whether the free runs are off by no more than noise."""
        return is_like_noise(self.trained) and not is_failing(self.judged)

    @property
    def comparisons(self) -> list[Comparison]:
        """The free runs on the training record, and on the one held out if any."""
        return [self.trained, self.judged] if self.is_held_out else [self.trained]

    def share_explained(self, rmse: float) -> float:
        """Share of the judging squared error above the noise floor that is gone.

        With an error ``rmse`` that is left. NaN where the model leaves noise alone.
        """
        before = self.judged
        above_floor = before.rmse**2 - before.noise_floor**2
        if not above_floor > 0:
            return np.nan
        return (before.rmse**2 - rmse**2) / above_floor


def n_intervals(fit: Fit) -> int:
    """Number of intervals of a fit, over all gaps between samples."""
    return sum(int(steps.sum()) for steps in fit.steps)
