"""The model that is diagnosed: its free runs, and how larger models are fitted."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.comparison.model_selection import is_like_noise, leaves_noise
from phsi_opt.criteria import (
    CLOCK_MARGIN,
    FAR_RUN_SHARE,
    N_PAIR_REFITS,
    N_PAIR_REFITS_ALONG_SOLUTIONS,
    N_REFITS,
    N_REFITS_ALONG_SOLUTIONS,
    ONE_ATTEMPT_INTERVALS,
)
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.record import Record
from phsi_opt.model.effect import Effect
from phsi_opt.optimization.settings import FEASIBLE_PATH
from phsi_opt.statistics import TINY
from phsi_opt.transcription.losses import MaximumLikelihood


@dataclass(frozen=True, eq=False)
class DiagnosedModel:
    """What every re-fit of a diagnosis is made from and measured against.

    Attributes:
        trained: the base model's free run on the training record.
        judged: the same on the record that judges; ``trained`` where none is held out.
        loss: how larger models are fitted.
        say: called with a line of text as the work goes on.
        is_later: whether effects were added to it before: what remains beside them may
            be the error that every model has.
        executor: where re-fits are made side by side; None: here.
    """

    trained: Comparison
    judged: Comparison
    loss: MaximumLikelihood
    say: Callable[[str], None]
    is_later: bool = False
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
    def judged_misfit(self) -> float:
        """Squared residuals of the judging free run, in units of the noise variance."""
        return self.judged.misfit

    @property
    def is_far_off(self) -> bool:
        """Whether the free run is off by a good share of what a sensor shows.

        Such a model may have lost its way; one that follows the record has not.
        """
        left = 1 - self.trained.table["fit_percent"] / 100
        return bool((left > FAR_RUN_SHARE).any())

    def is_left_with_noise(self, trained: Comparison | None) -> bool:
        """Whether noise is all that a larger model leaves on the training record.

        Of one that was not re-fitted (None) that is not known.
        """
        return trained is not None and leaves_noise(self.trained, trained)

    @property
    def may_be_far_from_linear(self) -> bool:
        """Whether an effect may be missing along which no steps of a look settle.

        Not of a model that leaves noise, which is near all that there is. Nor beside a
        sharp corner: re-fits of such effects (four of EMPS and the demonstration) took
        2 to 7 s each and failed, or found what may as well be zero.
        """
        return not self.is_along_solutions and not is_like_noise(self.trained)

    @property
    def most_refits(self) -> int:
        """Effects that are re-fitted alone, at most."""
        return N_REFITS_ALONG_SOLUTIONS if self._is_slow else N_REFITS

    @property
    def most_pair_refits(self) -> int:
        """Pairs of effects that are re-fitted, at most."""
        return N_PAIR_REFITS_ALONG_SOLUTIONS if self._is_slow else N_PAIR_REFITS

    @property
    def _is_slow(self) -> bool:
        """Whether re-fits go along solutions of a long record."""
        return self.is_long and self.is_along_solutions

    @property
    def is_along_solutions(self) -> bool:
        """Whether the base was found beside a sharp corner."""
        return self.fit.outcome.way == FEASIBLE_PATH

    def rmse_of(self, misfit: float, comparison: Comparison) -> float:
        """Free-run error that goes with a misfit, on the scale of a comparison's.

        Exact where one channel is measured; else channels keep their shares.
        """
        own = max(comparison.misfit, TINY)
        return comparison.rmse * float(np.sqrt(misfit / own))

    def share_explained(self, rmse: float) -> float:
        """Share of the judging squared error above the noise floor that is gone.

        With an error ``rmse`` that is left. NaN where the model leaves noise alone.
        """
        before = self.judged
        above_floor = before.rmse**2 - before.noise_floor**2
        if not above_floor > 0:
            return np.nan
        return (before.rmse**2 - rmse**2) / above_floor

    def handicap(self, effects: Sequence[Effect]) -> float:
        """By how much effects must beat others in BIC.

        `CLOCK_MARGIN` for one that needs the clock in a model without inputs: runs that
        start in phase are a clock of their own.
        """
        is_autonomous = not self.fit.model.inputs
        if is_autonomous and any(effect.needs_clock for effect in effects):
            return CLOCK_MARGIN
        return 0.0

    @property
    def is_long(self) -> bool:
        """Whether the record is so long that a re-fit has one attempt."""
        return n_intervals(self.fit) > ONE_ATTEMPT_INTERVALS


def n_intervals(fit: Fit) -> int:
    """Number of intervals of a fit, over all gaps between samples."""
    return sum(int(steps.sum()) for steps in fit.steps)
