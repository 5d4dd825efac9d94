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

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import MONOTONE_RANK_CORRELATION, NAMED_CAUSE
from phsi_opt.force_analysis.cross_validation import CrossValidation, explained_share
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.piecewise_linear import (
    piecewise_linear_basis,
    product_basis,
)
from phsi_opt.force_analysis.position_waves import PositionWave
from phsi_opt.force_analysis.time_basis import leave_out_error_with_time
from phsi_opt.presentation.table_making import printed_table
from phsi_opt.statistics import TINY, mean_ranks

if TYPE_CHECKING:
    import pandas as pd

# Rows of `depends_on` that are no variables.
CONSTANT = "constant"
PARAMETERS = "parameters"
NO_VARIABLES = (CONSTANT, PARAMETERS)
MOST_PAIRS = 6  # pairs of states that are looked at
MOST_RANKED = 2000  # values whose ranks are compared
# Singular values, as a share of the largest, below which functions count as dependent.
LEAST_SINGULAR_VALUE = 1e-6


def depends_on(force: ForceRecord, waves: Mapping[str, PositionWave]) -> "pd.DataFrame":
    """What every missing force follows, best first.

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

    Args:
        force: along the record.
        waves: along positions, by equation, where there are any; they count to the
            functions of that position.

    Returns:
        A row per equation and variable: equation, variable, share, explained.
    """
    import pandas as pd

    tables = []
    for equation in force.equations:
        tables.append(dependence(force, equation, waves.get(equation)))
    return pd.concat(tables, ignore_index=True)


def dependence(
    force: ForceRecord, equation: str, wave: PositionWave | None = None
) -> "pd.DataFrame":
    """What the missing force of one equation follows (see `depends_on`)."""
    w = force.force_on(equation)
    validation = CrossValidation.of(w, force.run)
    of_inputs = CrossValidation.of_inputs(w, force.run, force.inputs)
    total = validation.total
    baseline = _baseline(force, equation, validation)
    rows = list(baseline.rows)
    for variable in variables(force, equation):
        is_input = variable in force.fit.model.inputs
        judge = of_inputs if is_input else validation
        error = _leave_out_error(force, equation, variable, judge, baseline, wave)
        gain = (baseline.error - error) / max(total, TINY)
        share = explained_share(error, baseline.error)
        rows.append(_Prediction(variable, share, error, gain))
    frame = printed_table(rows)
    frame.insert(0, "equation", equation)
    predicted = np.maximum(total - frame.pop("error"), 0.0)
    frame["explained"] = np.sqrt(predicted / len(validation.w))
    best_first = frame.sort_values("gain", ascending=False, kind="stable")
    return best_first.drop(columns="gain")


@dataclass(frozen=True)
class _Prediction:
    """How well a variable predicts a force on stretches left out.

    Attributes:
        variable: its name, or 'constant' or 'parameters'.
        share: of the sum of squares, between 0 and 1.
        error: sum of squares that is left.
        gain: by which rows are ordered: what the variable adds to the baseline, as a
            share of the force's sum of squares.
    """

    variable: str
    share: float
    error: float
    gain: float


@dataclass(frozen=True, eq=False)
class _Baseline:
    """What a force follows without any variable: the mean, and the parameters.

    Attributes:
        bases: columns that stand beside the functions of every variable.
        error: sum of squares that they leave on stretches left out.
        rows: of the mean alone and of the parameters alone, the better one first.
    """

    bases: list[np.ndarray]
    error: float
    rows: list[_Prediction]


def _baseline(
    force: ForceRecord, equation: str, validation: CrossValidation
) -> _Baseline:
    """The mean, with the model's parameters where these help to predict."""
    total = validation.total
    mean = force.as_estimated(equation, np.ones((len(validation.w), 1)))
    slopes = force.by_parameters(equation)
    error = validation.leave_out_error([mean])
    share = explained_share(error, total)
    row = _Prediction(CONSTANT, share, error, NAMED_CAUSE)
    if not slopes.shape[1]:
        return _Baseline([mean], error, [row])
    error_of_slopes = validation.leave_out_error([slopes])
    share = explained_share(error_of_slopes, total)
    row_of_slopes = _Prediction(PARAMETERS, share, error_of_slopes, NAMED_CAUSE)
    rows = sorted([row, row_of_slopes], key=lambda row: row.error)
    joint_error = validation.leave_out_error([mean, slopes])
    if joint_error < error:
        return _Baseline([mean, slopes], joint_error, rows)
    return _Baseline([mean], error, rows)


def _leave_out_error(
    force: ForceRecord,
    equation: str,
    variable: str,
    validation: CrossValidation,
    baseline: _Baseline,
    wave: PositionWave | None,
) -> float:
    """Error left with functions of a variable; at most that of the baseline."""
    if variable == "t":
        error = leave_out_error_with_time(force, validation, baseline.bases)
    else:
        functions = force.as_estimated(equation, _basis(force, variable))
        bases = [*baseline.bases, functions]
        if wave is not None and wave.position == variable:
            bases.append(wave.waves)
        error = validation.leave_out_error(bases)
    return min(error, baseline.error)


def _basis(force: ForceRecord, variable: str) -> np.ndarray:
    """Piecewise linear functions of a variable, or of a pair 'q, p'."""
    names = variable.split(", ")
    values = [force.variable(name) for name in names]
    if len(names) == 1:
        return piecewise_linear_basis(values[0])
    return product_basis(values[0], values[1])


def variables(force: ForceRecord, equation: str) -> list[str]:
    """Names of what the force of an equation may follow, pairs of states as 'q, p'.

    Pairs with the equation's own state come before others.
    """
    model = force.fit.model
    states = [name for name in model.states if _varies(force, name)]
    efforts = _independent_efforts(force, states)
    inputs = [name for name in model.inputs if _varies(force, name)]
    pairs = _pairs(states, equation)
    return [*states, *efforts, *inputs, "t", *pairs[:MOST_PAIRS]]


def _varies(force: ForceRecord, name: str) -> bool:
    return bool(np.ptp(force.variable(name)) > 0)


def _independent_efforts(force: ForceRecord, states: list[str]) -> list[str]:
    """Efforts that are no monotone function of a state, nor of another effort."""
    known_ranks = [_ranks(force.variable(name)) for name in states]
    independent = []
    for name in force.fit.model.efforts:
        if not _varies(force, name):
            continue
        ranks = _ranks(force.variable(name))
        if not _is_monotone_in_any(ranks, known_ranks):
            independent.append(name)
            known_ranks.append(ranks)
    return independent


def _is_monotone_in_any(ranked: np.ndarray, known_ranks: list[np.ndarray]) -> bool:
    correlations = [abs(ranked @ known) for known in known_ranks]
    return any(size > MONOTONE_RANK_CORRELATION for size in correlations)


def _ranks(z: np.ndarray) -> np.ndarray:
    """Centred ranks of length one, of evenly chosen values where there are many.

    The product of two such vectors is the rank correlation.
    """
    chosen = z[:: max(1, len(z) // MOST_RANKED)]
    ranked = mean_ranks(chosen)
    centred = ranked - ranked.mean()
    return np.asarray(centred / max(float(np.linalg.norm(centred)), TINY))


def _pairs(states: list[str], equation: str) -> list[str]:
    """Pairs of states as 'q, p'; those with the equation's own state first."""
    with_own: list[str] = []
    others: list[str] = []
    for a, b in combinations(states, 2):
        pairs = with_own if equation in (a, b) else others
        pairs.append(f"{a}, {b}")
    return with_own + others


def without_parameters(
    force: ForceRecord,
    equation: str,
    variable: str,
    wave: PositionWave | None = None,
) -> np.ndarray:
    """The force less what other values of the model's parameters explain.

    It is what to plot against a variable: of the parameters' slopes only that is taken
    off which is no function of the variable.

    Returns:
        (n_intervals,).
    """
    w = force.force_on(equation)
    slopes = force.by_parameters(equation)
    functions = force.as_estimated(equation, _basis(force, variable))
    if wave is not None and wave.position == variable:
        functions = np.hstack([functions, wave.waves])
    of_slopes = np.linalg.lstsq(functions, slopes, rcond=LEAST_SINGULAR_VALUE)[0]
    independent = slopes - functions @ of_slopes
    joint = np.hstack([functions, independent])
    coefficients = np.linalg.lstsq(joint, w, rcond=LEAST_SINGULAR_VALUE)[0]
    return np.asarray(w - independent @ coefficients[functions.shape[1] :])


def leading(follows: "pd.DataFrame", equation: str) -> "pd.Series | None":
    """The row of `depends_on` to name: the best variable of an equation.

    A single variable is named where a pair of states is hardly better.

    Args:
        follows: as `depends_on` returns it.
        equation: of the force.

    Returns:
        None where the force was compared with no variable.
    """
    rows = follows[follows["equation"] == equation]
    rows = rows[~rows["variable"].isin(NO_VARIABLES)]
    good = rows[rows["share"] > rows["share"].max() - NAMED_CAUSE]
    if good.empty:
        return None
    single = good[~good["variable"].str.contains(",")]
    return good.iloc[0] if single.empty else single.iloc[0]
