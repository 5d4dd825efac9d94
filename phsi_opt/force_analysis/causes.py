"""Kinds of causes that may explain a missing force, and what each of them explains.

A kind is a set of functions: a constant, odd functions of the equation's effort,
functions of the states that it exchanges energy with, of the inputs, of the time.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.criteria import SECOND_CAUSE, TIED_CAUSES
from phsi_opt.force_analysis.cross_validation import CrossValidation, explained_share
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.piecewise_linear import (
    odd_basis,
    piecewise_linear_basis,
    product_basis,
)
from phsi_opt.force_analysis.position_waves import PositionWave
from phsi_opt.force_analysis.time_basis import leave_out_error_with_time
from phsi_opt.model.structure import exchange_partners

# Of two kinds that are alike, the first is named.
CAUSES = ("constant", "dissipated", "conserved", "inputs", "time")


@dataclass(frozen=True, eq=False)
class Causes:
    """Functions of every kind that may explain the force of one equation.

    Attributes:
        force: the record.
        equation: the state in whose equation the force acts.
        validation: the force with the stretches that are left out; ``of_inputs``: with
            those where inputs are among the functions.
        bases: functions (n_intervals, k) by kind, as the estimate would show them;
            'parameters' are the slopes in the model's parameters. Those of the time are
            not among them: their frequency differs from fold to fold.
        wave: along a position, among what is 'conserved'; None where there is none.
    """

    force: ForceRecord
    equation: str
    validation: CrossValidation
    of_inputs: CrossValidation
    bases: Mapping[str, np.ndarray]
    wave: PositionWave | None = None

    @classmethod
    def of(
        cls, force: ForceRecord, equation: str, wave: PositionWave | None = None
    ) -> "Causes":
        """The kinds that an equation has; inputs and exchange where there are any."""
        model = force.fit.model
        functions = {
            "constant": np.ones((len(force.t), 1)),
            "dissipated": odd_basis(force.effort_of(equation)),
        }
        partners = exchange_partners(model, equation)
        if partners:
            functions["conserved"] = _joint_basis(force, partners)
        if model.inputs:
            functions["inputs"] = _joint_basis(force, model.inputs)
        bases = {}
        for kind, columns in functions.items():
            bases[kind] = force.as_estimated(equation, columns)
        if wave is not None:
            bases["conserved"] = np.hstack([bases["conserved"], wave.waves])
        bases["parameters"] = force.by_parameters(equation)
        w = force.force_on(equation)
        validation = CrossValidation.of(w, force.run)
        of_inputs = CrossValidation.of_inputs(w, force.run, force.inputs)
        return cls(force, equation, validation, of_inputs, bases, wave)

    def joint_share(self, kinds: Sequence[str]) -> float:
        """Part of the force's mean square that these kinds predict together.

        It is judged on stretches of time that were left out.
        """
        bases = [self.bases[kind] for kind in kinds if kind != "time"]
        validation = self.of_inputs if "inputs" in kinds else self.validation
        if "time" in kinds:
            error = leave_out_error_with_time(self.force, validation, bases)
        else:
            error = validation.leave_out_error(bases)
        return explained_share(error, validation.total)

    @cached_property
    def gains(self) -> dict[str, float]:
        """What each kind adds to other values of the model's parameters."""
        by_parameters = self.joint_share(("parameters",))
        gains = {}
        for kind in CAUSES:
            if kind in self.bases or kind == "time":
                together = self.joint_share(("parameters", kind))
                gains[kind] = together - by_parameters
        return gains

    @cached_property
    def contributions(self) -> dict[str, float]:
        """What each kind adds to the stronger ones, strongest first.

        The model's parameters come before all kinds. Further kinds are there while they
        add what is worth naming.
        """
        by_parameters = self.joint_share(("parameters",))
        contributions = {"parameters": by_parameters}
        shares = {kind: by_parameters + gain for kind, gain in self.gains.items()}
        strongest = _strongest(shares, by_parameters)
        while strongest is not None:
            contributions[strongest] = shares[strongest] - sum(contributions.values())
            shares = self._shares_beside(contributions)
            least = sum(contributions.values()) + SECOND_CAUSE
            strongest = _strongest(shares, least)
        return contributions

    def _shares_beside(self, known: Collection[str]) -> dict[str, float]:
        """What known kinds and one further kind predict together, by that kind."""
        shares = {}
        for kind in self.gains:
            if kind not in known:
                shares[kind] = self.joint_share((*known, kind))
        return shares


def _strongest(shares: Mapping[str, float], least: float) -> str | None:
    """The kind of the largest share, the first of those that are as good.

    None where no share is above ``least``.
    """
    above = {kind: share for kind, share in shares.items() if share > least}
    best = max(above.values(), default=0.0)
    for kind, share in above.items():
        if share >= best - TIED_CAUSES / 2:
            return kind
    return None


def _joint_basis(force: ForceRecord, names: Sequence[str]) -> np.ndarray:
    """Functions of each variable; of two variables also those of both."""
    values = [force.variable(name) for name in names]
    bases = [piecewise_linear_basis(z) for z in values]
    if len(names) == 2:
        bases.append(product_basis(values[0], values[1]))
    return np.hstack(bases)
