"""What remains of a missing force when effects were added."""

from dataclasses import dataclass

import numpy as np

from phsi_opt.criteria import NAMED_CAUSE
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.units import force_unit, spaced
from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY


@dataclass(frozen=True)
class Remainder:
    """The force of an equation before and after effects were added.

    Attributes:
        equation: the one whose force is strongest, over its uncertainty, before.
        before: root mean square of its force; ``after``: with the effects.
        unit: of both.
        share: of the motion's own rates that the strongest force with the effects is.
    """

    equation: str
    before: float
    after: float
    unit: str
    share: float

    @classmethod
    def of(cls, base: DiagnosedModel, fit: Fit) -> "Remainder":
        """Of a base model and the fit of a larger one, on the training record."""
        record = base.record
        before = record.estimate
        place = int(np.argmax(_shares_of_motion(before)))
        equation = base.fit.model.states[before.prior.rows[place]]
        unit = force_unit(equation, record.data.units)
        strong = float(_root_mean_squares(before)[place])
        try:
            after = Record.of_aligned(fit, record.aligned).estimate
        except PhsiOptError:
            return cls(equation, strong, strong, unit, share_of_motion(before))
        rows = list(after.prior.rows)
        place = rows.index(fit.model.states.index(equation))
        left = float(_root_mean_squares(after)[place])
        return cls(equation, strong, left, unit, share_of_motion(after))

    @property
    def gone(self) -> float:
        """Share of the force's mean square that is gone."""
        return 1 - (self.after / max(self.before, TINY)) ** 2

    def __str__(self) -> str:
        unit = spaced(self.unit)
        if self.gone < NAMED_CAUSE:
            return f"(rms {self.before:.3g}{unit}) nothing is gone"
        return (
            f"{100 * self.gone:.0f} % is gone (rms {self.before:.3g} before, "
            f"{self.after:.3g}{unit} after)"
        )


def weakest_equations(model: Model, estimate: ForceEstimate) -> list[str]:
    """Equations that may lack a force, the one first that lacks most of its motion's.

    Args:
        model: whose missing force it is.
        estimate: of that force.
    """
    shares = _shares_of_motion(estimate)
    rows = np.array(estimate.prior.rows)[np.argsort(-shares, kind="stable")]
    return [model.states[row] for row in rows]


def share_of_motion(estimate: ForceEstimate) -> float:
    """The strongest force over the rates of its equation, both root mean squares."""
    shares = _shares_of_motion(estimate)
    return float(np.max(shares)) if shares.size else 0.0


def _shares_of_motion(estimate: ForceEstimate) -> np.ndarray:
    return _root_mean_squares(estimate) / _typical(estimate)


def _root_mean_squares(estimate: ForceEstimate) -> np.ndarray:
    """Of each force, (n_forced,)."""
    return np.asarray(np.sqrt(np.mean(estimate.w**2, axis=0)))


def _typical(estimate: ForceEstimate) -> np.ndarray:
    """Sizes of the rates that the forces add to, (n_forced,)."""
    rates = estimate.grid.rates(estimate.x)[:, list(estimate.prior.rows)]
    return np.sqrt(np.mean(rates**2, axis=0)) + TINY
