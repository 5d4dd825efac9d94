"""Whether a model's formulas have values at the measurements at all.

exp(1000*q), log(q) of negative positions or a mass of zero would meet the solver as
numbers that are none, and it would blame something else.
"""

from functools import partial

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.model import Model
from phsi_opt.model.slots import PlacedTerm
from phsi_opt.model.symbolic import terms_function
from phsi_opt.optimization.column_function import ColumnFunction
from phsi_opt.transcription.grid import Grid

# Values that stand for states nobody measured, by turns: a formula that has a value at
# one of them may have one at the true state.
UNMEASURED = (1.0, 1e-3)
# The same for parameters that are to be found: their start, and beside it.
MOVED = ((1.0, 0.0), (1.1, 0.1))  # factor, and what is added


def check_rates(model: Model, grid: Grid) -> None:
    """Refuse a model with a term that is not finite at the measured states.

    Nor are the slopes of a term of H.

    Args:
        model: with the values from which parameters start.
        grid: nodes and measurements.

    Raises:
        ModelError: a term has no finite value at more than a tenth of the samples; with
            the first of these, and the values that stand in the model.
    """
    nodes = np.flatnonzero(grid.measured.any(axis=1))
    if not len(nodes):
        return
    is_bad = np.ones((len(model.placed()), len(nodes)), bool)
    stand_ins = UNMEASURED if not grid.measured.all() else UNMEASURED[:1]
    for value in stand_ins:
        x = np.where(grid.measured, grid.y, value)
        resolved = resolve_guesses(model, grid, x)
        made = resolved.built("terms", partial(terms_function, resolved))
        terms = ColumnFunction(made, (3,))
        for factor, added in MOVED:
            theta = factor * resolved.theta + added
            t = grid.t[nodes][None, :]
            (values,) = terms(x[nodes].T, grid.u[nodes].T, t, theta)
            is_bad &= ~np.isfinite(values)
            if not is_bad.any():
                return
    for placed, of_term in zip(model.placed(), is_bad, strict=True):
        bad = nodes[of_term]
        # Beside an empty tank noise makes a few levels negative.
        if len(bad) > len(nodes) / 10:
            where = f"{len(bad)} of {len(nodes)} samples"
            raise ModelError(_told(resolved, grid, placed, where, int(bad[0])))


def _told(model: Model, grid: Grid, placed: PlacedTerm, where: str, node: int) -> str:
    slot, equation, term = placed
    place = f"{slot} of {equation}" if equation else slot
    at = [f"t = {grid.t[node]:.4g}"]
    for name, value in zip(model.states, grid.y[node], strict=True):
        if np.isfinite(value):
            at.append(f"{name} = {value:.4g}")
    values = [f"{name} = {value:.4g}" for name, value in model.values.items()]
    text = f"the term {term.body!r} in {place} has no finite value at {where}, first "
    text += f"at {', '.join(at)}"
    if grid.trajectory[-1]:
        text += f" of trajectory {grid.trajectory[node] + 1}"
    if values:
        text += f", with {', '.join(values[:8])}"
    return (
        f"{text}. It divides by zero there, overflows, or takes a root or logarithm of "
        "a negative number; write it so that it has a value at all measured states, or "
        "give other values."
    )
