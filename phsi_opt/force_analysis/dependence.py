"""What a missing force follows: the variable that predicts it best, and its causes.

A variable is a state, an input, a pair of states or the time. A cause is a set of
functions: a constant, odd functions of the equation's effort (dissipated), functions of
the states that it exchanges energy with (conserved: what goes in comes back on the same
way), of the inputs, of the time.

Whether the force follows a variable or a cause is judged on stretches of time that were
left out: functions are fitted to the other stretches and have to predict the force on
these, so that nothing is earned by flexibility. The estimate is smooth where the record
is noisy, dry friction has lost its corners; so a function is looked at as the same
estimate would show it.

What to keep in mind: parameters of the model were fitted without the effect and have
imitated what they could of it. Dry friction comes as friction less the damping that
stood in for it, a cubic spring as the cubic less a linear one. So the model's
parameters move along here: what other values of them would explain is counted apart,
under 'parameters'. Size and sign of the force in the tables are those of the
difference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN, MOST_OF_IT, NAMED_CAUSE
from phsi_opt.force_analysis.cross_validation import (
    explained_share,
    odd_basis,
    piecewise_linear_basis,
    product_basis,
)
from phsi_opt.force_analysis.force_record import Force
from phsi_opt.force_analysis.waves import functions_of_time
from phsi_opt.model.structure import exchange_partners
from phsi_opt.presentation.summary import printed_table
from phsi_opt.statistics import TINY

if TYPE_CHECKING:
    import pandas as pd

TIME_NAME = "t"
# Rows of the table that are no variables.
CONSTANT = "constant"
PARAMETERS = "parameters"
NO_VARIABLES = (CONSTANT, PARAMETERS)
# Of two causes that are alike, the first is named.
CAUSES = ("constant", "dissipated", "conserved", "inputs", "time")


def dependence(force: Force) -> "pd.DataFrame":
    """What the missing force of one equation follows, best first.

    ``variable`` is a state, an effort that is not a monotone function of a state, an
    input, the time ``t`` (slow changes, and a wave with its second harmonic, of one
    phase in all trajectories), or a pair of states ('q, p'). ``share`` is the part of
    the force's variance, beside what the model's own parameters would explain, that a
    piecewise linear function of the variable predicts on stretches of time that were
    left out; 0 where it predicts worse than the mean. Two rows stand behind the
    variables that add a tenth to them: 'constant' and 'parameters', with the parts of
    the mean square that the mean alone, and other values of the model's parameters
    alone, predict. ``explained`` is the rms of what is predicted, of the mean and the
    parameters as well.
    """
    total = force.squares
    bases = [force.shown(np.ones((len(force.w), 1)))]
    least = force.left_out_error(bases)
    rows = [(CONSTANT, explained_share(least, total), least, NAMED_CAUSE)]
    if force.by_parameters.shape[1]:
        error = force.left_out_error([force.by_parameters])
        rows.append((PARAMETERS, explained_share(error, total), error, NAMED_CAUSE))
        rows.sort(key=lambda row: row[2])
        error = force.left_out_error([*bases, force.by_parameters])
        if error < least:
            bases.append(force.by_parameters)
            least = error
    for variable in variables(force):
        if variable == TIME_NAME:
            error = force.left_out_error(bases, partial(functions_of_time, force))
        else:
            is_input = variable in force.record.model.inputs
            functions = [*bases, _functions(force, variable)]
            error = force.left_out_error(functions, with_inputs=is_input)
        error = min(error, least)
        gain = (least - error) / max(total, TINY)
        rows.append((variable, explained_share(error, least), error, gain))
    table = printed_table(rows, columns=["variable", "share", "error", "gain"])
    table.insert(0, "equation", force.equation)
    predicted = np.maximum(total - table.pop("error"), 0.0)
    table["explained"] = np.sqrt(predicted / len(force.w))
    best_first = table.sort_values("gain", ascending=False, kind="stable")
    return best_first.drop(columns="gain")


def _functions(force: Force, variable: str) -> np.ndarray:
    """Of a variable, or of a pair 'q, p', as they would be shown, (n_intervals, k)."""
    values = list(map(force.record.variable, variable.split(", ")))
    if len(values) == 2:
        return force.shown(product_basis(*values))
    return force.shown(piecewise_linear_basis(values[0]))


def variables(force: Force) -> list[str]:
    """Names of what a force may follow, pairs of states as 'q, p'."""
    record = force.record

    def varying(names: Sequence[str]) -> list[str]:
        return [name for name in names if np.ptp(record.variable(name)) > 0]

    states = varying(record.model.states)
    known = [_ranks(record.variable(name)) for name in states]
    efforts = []  # that are no monotone function of a state, nor of another effort
    for name in varying(record.model.efforts):
        ranks = _ranks(record.variable(name))
        alike = max((abs(ranks @ other) for other in known), default=0.0)
        if not alike > 0.9999:  # of rank correlations
            efforts.append(name)
            known.append(ranks)
    pairs = sorted(combinations(states, 2), key=lambda ab: force.equation not in ab)
    joined = map(", ".join, pairs[:6])
    return [*states, *efforts, *varying(record.model.inputs), TIME_NAME, *joined]


def _ranks(z: np.ndarray) -> np.ndarray:
    """Centred ranks of length one; their products are rank correlations."""
    import pandas as pd

    ranked = pd.Series(z).rank().to_numpy()
    centred = ranked - ranked.mean()
    return centred / max(float(np.linalg.norm(centred)), TINY)


def without_parameters(force: Force, variable: str) -> np.ndarray:
    """The force less what other values of the model's parameters explain.

    It is what to plot against a variable, (n_intervals,): of the parameters' slopes
    only that is taken off which is no function of the variable.
    """
    slopes = force.by_parameters
    functions = _functions(force, variable)
    # Of smaller singular values, beside the largest, functions count as dependent.
    solved = partial(np.linalg.lstsq, rcond=1e-6)
    independent = slopes - functions @ solved(functions, slopes)[0]
    joint = np.hstack([functions, independent])
    coefficients = solved(joint, force.w)[0]
    return force.w - independent @ coefficients[functions.shape[1] :]


def leading(follows: "pd.DataFrame") -> "pd.Series | None":
    """The row of `dependence` to name: the best variable.

    A single variable is named where a pair of states is hardly better; None where the
    force was compared with no variable.
    """
    rows = follows[~follows["variable"].isin(NO_VARIABLES)]
    good = rows[rows["share"] > rows["share"].max() - NAMED_CAUSE]
    if good.empty:
        return None
    single = good[~good["variable"].str.contains(",")]
    return good.iloc[0] if single.empty else single.iloc[0]


# ---- causes --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Causes:
    """What explains a missing force, judged on stretches of time that were left out.

    Contributions are the part of the force's mean square that each cause adds to the
    stronger ones, strongest first, after the model's parameters; further causes are
    there while they add a fifth.
    """

    contributions: Mapping[str, float]
    goes_together: bool = False  # inputs and effort, as beside a controller

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
        least = dict.fromkeys(CAUSES, NAMED_CAUSE) | {PARAMETERS: MOST_OF_IT}
        found = self.contributions.items()
        return [cause for cause, share in found if share > least[cause]]


def causes_of(force: Force) -> Causes:
    """Whether a force w dissipates power w dH/dx, conserves it, or is driven."""
    bases = _bases(force)
    contributions: dict[str, float] = {PARAMETERS: _share(force, bases, [PARAMETERS])}
    second = 0.0  # what a cause has to add beside a stronger one
    while True:
        known = sum(contributions.values())
        shares = {}
        for cause in CAUSES:
            if cause not in contributions and cause in (*bases, "time"):
                shares[cause] = _share(force, bases, [*contributions, cause])
        least = known + second
        best = max(shares.values(), default=0.0)
        good = [c for c in shares if shares[c] > least and shares[c] >= best - 0.025]
        if not good:
            break
        contributions[good[0]] = shares[good[0]] - known
        second = 0.2
    causes = Causes(contributions)
    is_driven = list(contributions)[1:2] == ["inputs"] and "inputs" in causes.named
    is_driven = is_driven and "dissipated" not in contributions
    return replace(causes, goes_together=is_driven and _is_closed_loop(force))


def _bases(force: Force) -> dict[str, np.ndarray]:
    """Functions (n_intervals, k) by cause, as the estimate would show them."""
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
