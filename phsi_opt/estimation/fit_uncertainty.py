"""How well the parameters of a fit are known, and what to know before using them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from phsi_opt.estimation.model_error_table import ModelErrorRow
from phsi_opt.model_error.standard_errors import Source


@dataclass(frozen=True, eq=False, kw_only=True)
class FitUncertainty:
    """What a fit says of its estimates beside their values.

    Attributes:
        covariance: (n_names, n_names) of the estimates; NaN where it is not known.
        source: what the standard errors come from.
        covariances: (n_names, n_names) by source, all that were worked out.
        freedom: (n_names,) degrees of freedom of the variances; None: those that the
            residuals leave.
        model_error_rows: what was found beside the model.
        log_evidence: of the model, beside what was found.
        warnings: sentences to read before the numbers are used.
    """

    covariance: np.ndarray
    source: Source = Source.NOISE
    covariances: Mapping[Source, np.ndarray] = field(default_factory=dict)
    freedom: np.ndarray | None = None
    model_error_rows: tuple[ModelErrorRow, ...] = ()
    log_evidence: float = np.nan
    warnings: tuple[str, ...] = ()
