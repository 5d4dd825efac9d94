"""What remains of a missing force when effects were added."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.criteria import NAMED_CAUSE
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.units import force_unit, spaced
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY


@dataclass(frozen=True)
class ForceLeft:
    """The force of an equation before and after effects were added.

    Attributes:
        equation: in which it acts.
        before: root mean square of the force; ``after``: with the effects.
        unit: of both.
    """

    equation: str
    before: float
    after: float
    unit: str

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


@dataclass(frozen=True)
class Remainder:
    """The forces of all equations before and after effects were added.

    Attributes:
        forces: by equation, the one first whose force is strongest, beside its motion,
            before. It decides whether effects are named.
        share: of the motion's own rates that the strongest force with the effects is.
    """

    forces: tuple[ForceLeft, ...]
    share: float

    @classmethod
    def of(cls, base: DiagnosedModel, fit: Fit) -> "Remainder":
        """Of a base model and the fit of a larger one, on the training record."""
        before = base.record.estimate
        strong = _by_equation(base.fit.model, before)
        try:
            after = Record.of_aligned(fit, base.record.aligned).estimate
            left = _by_equation(fit.model, after)
        except PhsiOptError:
            after = before
            left = strong
        forces = []
        for equation in weakest_equations(base.fit.model, before):
            unit = force_unit(equation, base.record.data.units)
            sizes = strong[equation], left[equation]
            forces.append(ForceLeft(equation, *sizes, unit))
        return cls(tuple(forces), share_of_motion(after))

    @property
    def gone(self) -> float:
        """Share of the strongest force's mean square that is gone."""
        return self.forces[0].gone

    @property
    def after(self) -> float:
        """Root mean square of what is left of the strongest force."""
        return self.forces[0].after

    def words(self, effects: Sequence[Effect] = ()) -> str:
        """What is gone in the equations that effects act in.

        Args:
            effects: none, or none in an equation that may lack a force: the strongest
                force is told.
        """
        acting = [effect.equation for effect in effects if effect.slot != "sensor"]
        told = [force for force in self.forces if force.equation in acting]
        told = told or [self.forces[0]]
        if len(self.forces) == 1:
            return str(told[0])
        return " and ".join(f"in d{force.equation}/dt {force}" for force in told)


def _by_equation(model: Model, estimate: ForceEstimate) -> dict[str, float]:
    """Root mean square of each force by the state of its equation."""
    equations = [model.states[row] for row in estimate.rows]
    return dict(zip(equations, _root_mean_squares(estimate).tolist(), strict=True))


def weakest_equations(model: Model, estimate: ForceEstimate) -> list[str]:
    """Equations that may lack a force, the one first that lacks most of its motion's.

    Args:
        model: whose missing force it is.
        estimate: of that force.
    """
    shares = _shares_of_motion(estimate)
    rows = np.array(estimate.rows)[np.argsort(-shares, kind="stable")]
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
    rates = estimate.grid.rates(estimate.x)[:, list(estimate.rows)]
    return np.sqrt(np.mean(rates**2, axis=0)) + TINY
