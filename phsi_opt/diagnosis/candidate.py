"""One effect that a model may lack, with all that a diagnosis knows of it."""

from dataclasses import dataclass, field

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with what screening expects of it, and what came out of its re-fit.

    Attributes:
        effect: what may be missing.
        coefficient: its size, expected or re-fitted, in the unit of its parameter.
        std_error: of the coefficient.
        drop: expected fall of the misfit, in units of the noise variance.
        values: of its parameters, from which a re-fit starts.
        confusable_with: names of the effects that the data cannot tell from it.
        p_value: adjusted for all candidates (Benjamini and Hochberg 1995) and for the
            values that were scanned.
        delta_bic: change of BIC by the effect; NaN where it was not re-fitted.
        was_tried: whether a re-fit was attempted.
        fit: the re-fit; ``trained`` and ``comparison``: its free runs on the training
            record and on the one that judges. None where it was not re-fitted.
    """

    effect: Effect
    coefficient: float
    std_error: float
    drop: float
    values: dict[str, float] = field(default_factory=dict)
    confusable_with: tuple[str, ...] = ()
    p_value: float = np.nan
    delta_bic: float = np.nan
    was_tried: bool = False
    fit: Fit | None = field(repr=False, default=None)
    trained: Comparison | None = field(repr=False, default=None)
    comparison: Comparison | None = field(repr=False, default=None)

    @property
    def held_out_rmse(self) -> float:
        """Free-run error of the re-fit on the data held out; NaN without a re-fit.

        On the training data where none were held out.
        """
        return np.nan if self.comparison is None else self.comparison.rmse
