"""What a model may lack, with all that a diagnosis knows of it."""

from dataclasses import dataclass, field

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect, or two together, with what is expected and what a re-fit gave.

    Attributes:
        effect: what may be missing.
        coefficient: its size, expected or re-fitted, in ``unit``.
        std_error: of the coefficient.
        values: of its parameters, from which a re-fit starts.
        partner: a second effect beside it.
        confusable_with: names of the effects that the data cannot tell from it.
        p_value: of the likelihood ratio, adjusted for all candidates (Benjamini and
            Hochberg 1995) and for the values that were scanned. Residuals count as
            noise in it; ``lost`` may tell another, of the size beside model error.
        delta_bic: change of BIC by the effect; without a re-fit the expected one.
        train_rmse: free-run error on the training data, expected or re-fitted.
        held_out_rmse: the same on the data held out; NaN where neither is known.
        share: of the squared error above the noise floor that it explains, on the data
            that judge.
        lost: why it is not named; empty for what is.
        unit: of the coefficient; "" where it is not known.
        was_tried: whether a re-fit was attempted.
        fit: the re-fit; ``trained`` and ``comparison``: its free runs on the training
            record and on the one that judges. None where it was not re-fitted.
    """

    effect: Effect
    coefficient: float
    std_error: float
    values: dict[str, float] = field(default_factory=dict)
    partner: Effect | None = None
    confusable_with: tuple[str, ...] = ()
    p_value: float = np.nan
    delta_bic: float = np.nan
    train_rmse: float = np.nan
    held_out_rmse: float = np.nan
    share: float = np.nan
    lost: str = ""
    unit: str = ""
    was_tried: bool = False
    fit: Fit | None = None
    trained: Comparison | None = None
    comparison: Comparison | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, lost={self.lost!r})"

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that are added, one or two."""
        return (self.effect,) if self.partner is None else (self.effect, self.partner)

    @property
    def name(self) -> str:
        """The same in words."""
        return " and ".join(str(effect) for effect in self.effects)
