"""What a missing force follows: the variable that predicts it best.

That is a state, an input, a pair of states or the time. Whether the force follows a
variable is judged on stretches of time that were left out: a function of that variable
is fitted to the other stretches and has to predict the force on these, so that nothing
is earned by flexibility. The estimate is smooth where the record is noisy, dry friction
has lost its corners; so a function is looked at as the same estimate would show it.

What to keep in mind: parameters of the model were fitted without the effect and have
imitated what they could of it. Dry friction comes as friction less the damping that
stood in for it, a cubic spring as the cubic less a linear one. So the model's
parameters move along here: what other values of them would explain is counted apart,
under 'parameters'. Size and sign of the force in the tables are those of the
difference.
"""

from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import NAMED_CAUSE
from phsi_opt.force_analysis.cross_validation import (
    explained_share,
    piecewise_linear_basis,
    product_basis,
)
from phsi_opt.force_analysis.force_record import Force, ForceRecord
from phsi_opt.force_analysis.waves import PositionWave, functions_of_time
from phsi_opt.presentation.summary import printed_table
from phsi_opt.statistics import TINY

# Rank correlation above which an effort is a monotone function of a state, and is not
# named beside it.
MONOTONE_RANK_CORRELATION = 0.9999

if TYPE_CHECKING:
    import pandas as pd

TIME_NAME = "t"
# Rows of the table that are no variables.
CONSTANT = "constant"
PARAMETERS = "parameters"
NO_VARIABLES = (CONSTANT, PARAMETERS)
# Singular values, as a share of the largest, below which functions count as dependent.
LEAST_SINGULAR_VALUE = 1e-6


def dependence(force: Force, wave: PositionWave | None = None) -> "pd.DataFrame":
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
    parameters as well. A wave along a position counts to the functions of that.
    """
    total = force.squares
    bases = [force.shown(np.ones((len(force.w), 1)))]
    least = force.left_out_error(bases)
    rows = [(CONSTANT, explained_share(least, total), least, NAMED_CAUSE)]
    if force.by_parameters.shape[1]:
        error = force.left_out_error([force.by_parameters])
        rows.append((PARAMETERS, explained_share(error, total), error, NAMED_CAUSE))
        rows.sort(key=lambda row: row[2])
        bases_with_slopes = [*bases, force.by_parameters]
        error = force.left_out_error(bases_with_slopes)
        if error < least:
            bases = bases_with_slopes
            least = error
    for variable in variables(force):
        if variable == TIME_NAME:
            error = force.left_out_error(bases, partial(functions_of_time, force))
        else:
            is_input = variable in force.record.model.inputs
            functions = [*bases, _functions(force, variable, wave)]
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


def _functions(force: Force, variable: str, wave: PositionWave | None) -> np.ndarray:
    """Of a variable, or of a pair 'q, p', as they would be shown, (n_intervals, k)."""
    values = list(map(force.record.variable, variable.split(", ")))
    if len(values) == 2:
        return force.shown(product_basis(*values))
    functions = force.shown(piecewise_linear_basis(values[0]))
    if wave is not None and wave.position == variable:
        return np.hstack([functions, wave.waves])
    return functions


def variables(force: Force) -> list[str]:
    """Names of what a force may follow, pairs of states as 'q, p'.

    Pairs with the equation's own state come before others; six are looked at.
    """
    record = force.record
    states = [name for name in record.model.states if _varies(record, name)]
    known = [_ranks(record.variable(name)) for name in states]
    efforts = []  # that are no monotone function of a state, nor of another effort
    for name in record.model.efforts:
        ranks = _ranks(record.variable(name))
        alike = max((abs(ranks @ other) for other in known), default=0.0)
        if _varies(record, name) and not alike > MONOTONE_RANK_CORRELATION:
            efforts.append(name)
            known.append(ranks)
    inputs = [name for name in record.model.inputs if _varies(record, name)]
    pairs = sorted(combinations(states, 2), key=lambda ab: force.equation not in ab)
    joined = map(", ".join, pairs[:6])
    return [*states, *efforts, *inputs, TIME_NAME, *joined]


def _varies(record: ForceRecord, name: str) -> bool:
    return bool(np.ptp(record.variable(name)) > 0)


def _ranks(z: np.ndarray) -> np.ndarray:
    """Centred ranks of length one; their products are rank correlations."""
    import pandas as pd

    ranked = pd.Series(z).rank().to_numpy()
    centred = ranked - ranked.mean()
    return centred / max(float(np.linalg.norm(centred)), TINY)


def without_parameters(
    force: Force, variable: str, wave: PositionWave | None = None
) -> np.ndarray:
    """The force less what other values of the model's parameters explain.

    It is what to plot against a variable, (n_intervals,): of the parameters' slopes
    only that is taken off which is no function of the variable.
    """
    slopes = force.by_parameters
    functions = _functions(force, variable, wave)
    of_slopes = np.linalg.lstsq(functions, slopes, rcond=LEAST_SINGULAR_VALUE)[0]
    independent = slopes - functions @ of_slopes
    joint = np.hstack([functions, independent])
    coefficients = np.linalg.lstsq(joint, force.w, rcond=LEAST_SINGULAR_VALUE)[0]
    return force.w - independent @ coefficients[functions.shape[1] :]


def leading(follows: "pd.DataFrame", equation: str) -> "pd.Series | None":
    """The row of `dependence` to name: the best variable of an equation.

    A single variable is named where a pair of states is hardly better; None where the
    force was compared with no variable.
    """
    rows = follows[follows["equation"] == equation]
    rows = rows[~rows["variable"].isin(NO_VARIABLES)]
    good = rows[rows["share"] > rows["share"].max() - NAMED_CAUSE]
    if good.empty:
        return None
    single = good[~good["variable"].str.contains(",")]
    return good.iloc[0] if single.empty else single.iloc[0]
