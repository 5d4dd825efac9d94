"""TODO."""

from dataclasses import dataclass, field

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with what screening expects of it, and, if it was re-fitted, what came
    out.

    ``p_value`` is adjusted for all candidates (Benjamini and Hochberg) and for the
    values that were scanned.
    """

    effect: Effect
    coefficient: float
    std_error: float
    drop: float  # expected fall of the misfit, in units of the noise variance
    values: dict[str, float] = field(default_factory=dict)
    confusable_with: tuple[str, ...] = ()
    p_value: float = np.nan
    delta_bic: float = np.nan
    fit: Fit | None = field(repr=False, default=None)
    trained: Comparison | None = field(repr=False, default=None)
    comparison: Comparison | None = field(repr=False, default=None)

    @property
    def held_out_rmse(self) -> float:
        """Free-run error of the re-fitted model on the data held out (on the training
        data where none were).
        """
        return np.nan if self.comparison is None else self.comparison.rmse
