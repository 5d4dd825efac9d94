"""Which terms of a descent the data do not need: the solver's own test.

The rule is that of `phsi_opt.estimation.pruning`, with the sandwich covariance of the
PHSI loss at the values that the descent has reached. It says nothing of whether they
are an optimum.
"""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.baselines.descent_settings import Descent
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.estimation.uncertainty import of_defects
from phsi_opt.initialization.scaling import first_point
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.known_defects import KnownDefects

# Share of the epochs before which nothing is tested: the values are still on their way,
# and the L1 term on H is off only from there on (the thesis' code).
TESTED_FROM = 0.5


@dataclass(frozen=True, eq=False)
class SignificanceTest:
    """The test of one descent.

    Attributes:
        pruning: the rule.
        grid: intervals whose two ends are measured.
        scheme: of the defects.
        n_tests: number of terms of the dictionary that the descent began with.
        first_epoch: epoch from which on it is made.
    """

    pruning: Pruning
    grid: Grid
    scheme: str
    n_tests: int
    first_epoch: int

    @classmethod
    def of(
        cls, model: Model, grid: Grid, settings: Descent
    ) -> "SignificanceTest | None":
        """The test that the settings ask for; None: none."""
        if settings.significance is None:
            return None
        pruning = Pruning(
            settings.threshold, settings.prune_slots, significance=settings.significance
        )
        return cls(
            pruning=pruning,
            grid=grid,
            scheme=settings.integrator,
            n_tests=len(pruning.candidates(model)),
            first_epoch=int(np.ceil(TESTED_FROM * settings.epochs)),
        )

    def insignificant(self, model: Model, defects: np.ndarray) -> set[str]:
        """Names of the coefficients for which zero explains the data as well.

        Args:
            model: the terms that are left, with the values of the descent.
            defects: (n_intervals, n_states) at these values, with a force network.
        """
        theta = model.theta
        scale = first_point(model, self.grid, theta).theta_scale
        slopes = KnownDefects(model, self.grid, self.scheme).at(theta)
        found = of_defects(
            model,
            self.grid,
            self.scheme,
            theta,
            scale,
            (),
            replace(slopes, d=defects),
        )
        return self.pruning.insignificant(
            model, model.values, found.covariance, self.n_tests
        )
