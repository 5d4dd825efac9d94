"""Causes that may explain a missing force, and what each of them explains.

A cause is a set of functions: a constant, odd functions of the equation's effort
(dissipated), functions of the states that it exchanges energy with (conserved: what
goes in comes back on the same way), of the inputs, of the time.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN, MOST_OF_IT, NAMED_CAUSE
from phsi_opt.force_analysis.cross_validation import (
    explained_share,
    odd_basis,
    piecewise_linear_basis,
    product_basis,
)
from phsi_opt.force_analysis.dependence import PARAMETERS
from phsi_opt.force_analysis.force_record import Force
from phsi_opt.force_analysis.waves import PositionWave, functions_of_time
from phsi_opt.model.structure import exchange_partners

SECOND_CAUSE = 0.2  # beside a stronger cause
TIED_CAUSES = 0.05  # difference up to which two causes are alike

# Of two causes that are alike, the first is named.
CAUSES = ("constant", "dissipated", "conserved", "inputs", "time")


@dataclass(frozen=True, eq=False)
class Causes:
    """What explains a missing force, judged on stretches of time that were left out.

    Attributes:
        contributions: part of the force's mean square that each cause adds to the
            stronger ones, strongest first. The model's parameters come before all
            others; further ones are there while they add a fifth.
        gains: what each cause adds to other values of the parameters alone.
        goes_together: whether inputs and effort are not told apart, as it is where a
            controller is at work.
    """

    contributions: Mapping[str, float]
    gains: Mapping[str, float]
    goes_together: bool = False

    @property
    def shares(self) -> dict[str, float]:
        """The contribution of every cause, and what is unexplained; they sum to one."""
        causes = (PARAMETERS, *CAUSES)
        shares = {cause: self.contributions.get(cause, 0.0) for cause in causes}
        return {**shares, "unexplained": 1 - sum(shares.values())}

    @property
    def named(self) -> list[str]:
        """The causes worth naming, strongest first."""
        if sum(self.contributions.values()) < CLEAR_PATTERN:
            return []
        named = []
        for cause, share in self.contributions.items():
            if share > (NAMED_CAUSE if cause in CAUSES else MOST_OF_IT):
                named.append(cause)
        return named

    @property
    def clear(self) -> str:
        """The cause that the force clearly follows; "" where there is none."""
        shares = self.shares
        strongest = max(CAUSES, key=shares.__getitem__)
        return strongest if shares[strongest] >= CLEAR_PATTERN else ""

    @property
    def first(self) -> str:
        """The strongest cause beside the parameters, where it is worth naming."""
        first = next((cause for cause in self.contributions if cause in CAUSES), "")
        return first if first in self.named else ""

    @property
    def alike(self) -> list[str]:
        """The other causes that would explain as much as the first one."""
        if self.first in ("", "constant"):
            return []
        least = self.gains[self.first] - TIED_CAUSES
        others = [cause for cause, gain in self.gains.items() if gain > least]
        return [cause for cause in others if cause not in self.contributions]


def causes_of(force: Force, wave: PositionWave | None = None) -> Causes:
    """Whether a force w dissipates power w dH/dx, conserves it, or is driven.

    A wave along a position counts to what is 'conserved'.
    """
    bases = _bases(force, wave)
    least = _share(force, bases, [PARAMETERS])
    contributions = {PARAMETERS: least}
    shares = _shares_beside(force, bases, contributions)
    gains = {cause: share - least for cause, share in shares.items()}
    strongest = _strongest(shares, least)
    while strongest is not None:
        contributions[strongest] = shares[strongest] - sum(contributions.values())
        shares = _shares_beside(force, bases, contributions)
        strongest = _strongest(shares, sum(contributions.values()) + SECOND_CAUSE)
    causes = Causes(contributions, gains)
    is_driven = causes.first == "inputs" and "dissipated" not in contributions
    return replace(causes, goes_together=is_driven and _is_closed_loop(force))


def _bases(force: Force, wave: PositionWave | None) -> dict[str, np.ndarray]:
    """Functions (n_intervals, k) by cause, as the estimate would show them.

    Those of the time are not among them: their frequency differs from fold to fold.
    """
    model = force.record.model
    functions = {
        "constant": np.ones((len(force.w), 1)),
        "dissipated": odd_basis(force.effort),
    }
    partners = exchange_partners(model, force.equation)
    if partners:
        functions["conserved"] = _joint_basis(force, partners)
    if model.inputs:
        functions["inputs"] = _joint_basis(force, model.inputs)
    bases = {cause: force.shown(columns) for cause, columns in functions.items()}
    if wave is not None:
        bases["conserved"] = np.hstack([bases["conserved"], wave.waves])
    return {**bases, PARAMETERS: force.by_parameters}


def _joint_basis(force: Force, names: Sequence[str]) -> np.ndarray:
    """Functions of each variable; of two variables also those of both."""
    values = list(map(force.record.variable, names))
    bases = list(map(piecewise_linear_basis, values))
    if len(values) == 2:
        bases.append(product_basis(*values))
    return np.hstack(bases)


def _share(
    force: Force, bases: Mapping[str, np.ndarray], causes: Sequence[str]
) -> float:
    """Part of the force's mean square that causes predict together."""
    sought = partial(functions_of_time, force) if "time" in causes else None
    functions = [bases[cause] for cause in causes if cause != "time"]
    error = force.left_out_error(functions, sought, "inputs" in causes)
    return explained_share(error, force.squares)


def _shares_beside(
    force: Force, bases: Mapping[str, np.ndarray], known: Collection[str]
) -> dict[str, float]:
    """What known causes and one further cause predict together, by that cause."""
    shares = {}
    for cause in CAUSES:
        if cause not in known and (cause in bases or cause == "time"):
            shares[cause] = _share(force, bases, [*known, cause])
    return shares


def _strongest(shares: Mapping[str, float], least: float) -> str | None:
    """The cause of the largest share, the first of those that are as good.

    None where no share is above ``least``.
    """
    best = max(shares.values(), default=0.0)
    for cause, share in shares.items():
        if share > least and share >= best - TIED_CAUSES / 2:
            return cause
    return None


def _is_closed_loop(force: Force) -> bool:
    """Whether input and effort go together, as where a controller is at work."""
    model = force.record.model
    inputs = map(force.record.variable, model.inputs)
    bases = [piecewise_linear_basis(u) for u in inputs if np.ptp(u) > 0]
    variance = np.var(force.effort)
    if not model.has_energy or not bases or not variance > 0:
        return False
    functions = np.hstack(bases)
    fitted = functions @ np.linalg.lstsq(functions, force.effort, rcond=None)[0]
    return bool(1 - np.var(force.effort - fitted) / variance >= MOST_OF_IT)
