"""What a model may lack, with all that a diagnosis knows of it."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import DECISIVE_EVIDENCE, STRONG_EVIDENCE
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect
from phsi_opt.screening.effect_size import Size


class Grade(StrEnum):
    """How clearly an effect is there, by the logarithm of its Bayes factor."""

    DECISIVE = "decisive"
    STRONG = "strong"
    WEAK = "weak"
    NONE = "none"

    @classmethod
    def of(cls, log_bayes: float) -> "Grade":
        """Of a logarithm of a Bayes factor; not a number counts as none."""
        if log_bayes >= DECISIVE_EVIDENCE:
            return cls.DECISIVE
        if log_bayes >= STRONG_EVIDENCE:
            return cls.STRONG
        return cls.WEAK if log_bayes > 0 else cls.NONE


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect, with what screening expects, what it weighs, and what a re-fit gave.

    Attributes:
        effect: what may be missing.
        coefficient: its size in ``unit``: of the fit where it is named, else beside the
            force that it leaves, else expected.
        std_error: of the coefficient.
        values: of the model's parameters, from which a re-fit starts.
        states: (n_nodes, n_states) along the training record, likewise.
        log_bayes: logarithm of the Bayes factor of the model with it over the model
            without, both beside a force, by the training data; expected where it was
            not weighed.
        log_predictive: what it adds to the log predictive density of the data held out;
            NaN where there are none, or it was not weighed.
        was_weighed: whether it was weighed, and not only expected to gain nothing.
        probability: of it among all effects that were weighed and no effect, equally
            likely before.
        force_left: root mean square of the force beside it over that without it.
        confusable_with: names of the effects that the data cannot tell from it.
        train_rmse: free-run error on the training data; NaN without a re-fit.
        held_out_rmse: the same on the data held out; NaN where there are none.
        share: of the squared error above the noise floor that it explains, on the data
            that judge.
        lost: why it is not named; empty for what is.
        unit: of the coefficient; "" where it is not known.
        fit: the re-fit; ``trained`` and ``comparison``: its free runs on the training
            record and on the one that judges. None where it was not re-fitted.
    """

    effect: Effect
    coefficient: float
    std_error: float
    values: dict[str, float] = field(default_factory=dict, repr=False)
    states: np.ndarray | None = field(default=None, repr=False)
    log_bayes: float = np.nan
    log_predictive: float = np.nan
    was_weighed: bool = False
    probability: float = np.nan
    force_left: float = np.nan
    confusable_with: tuple[str, ...] = ()
    train_rmse: float = np.nan
    held_out_rmse: float = np.nan
    share: float = np.nan
    lost: str = ""
    unit: str = ""
    fit: Fit | None = field(default=None, repr=False)
    trained: Comparison | None = field(default=None, repr=False)
    comparison: Comparison | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, lost={self.lost!r})"

    @property
    def name(self) -> str:
        """The same in words."""
        return str(self.effect)

    @property
    def size(self) -> Size:
        """The coefficient with its standard error and unit."""
        return Size(self.coefficient, self.std_error, self.unit)

    @property
    def log_evidence(self) -> float:
        """Gain of the log evidence by all data, those held out included."""
        held_out = 0.0 if np.isnan(self.log_predictive) else self.log_predictive
        return self.log_bayes + held_out

    @property
    def grade(self) -> Grade:
        """How clearly it is there."""
        return Grade.of(self.log_evidence) if self.was_weighed else Grade.NONE
