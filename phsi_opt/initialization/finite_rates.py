"""Whether a model's formulas have values at the measurements at all.

exp(1000*q), log(q) of negative positions or a mass of zero would meet the solver as
numbers that are none, and it would blame something else.
"""

from functools import partial

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import Expressions, function_of, terms_function
from phsi_opt.optimization.column_function import ColumnFunction
from phsi_opt.transcription.grid import Grid

# Values that stand for states nobody measured, by turns: a formula that has a value at
# one of them may have one at the true state.
UNMEASURED = (1.0, 1e-3)
# The same for parameters that are to be found: their start, and beside it.
MOVED = ((1.0, 0.0), (1.1, 0.1))  # factor, and what is added
# Share of the samples, at most, without a value: beside an empty tank noise makes a few
# levels negative.
MOST_BAD = 0.1
N_TOLD = 8  # values of parameters, at most


def check_rates(model: Model, grid: Grid) -> None:
    """Refuse a model whose dx/dt or H is not finite at the measured states.

    Args:
        model: with the values from which parameters start.
        grid: nodes and measurements.

    Raises:
        ModelError: an equation, or H, has no finite value at more than a tenth of the
            samples; with the first of these, and the values that stand in the model.
    """
    is_measured = grid.measured.any(axis=1)
    if not is_measured.any():
        return
    # The last row is the energy's: CasADi takes the slope of p**2/0 for zero.
    is_bad = np.ones((model.n_states + 1, int(is_measured.sum())), bool)
    stand_ins = UNMEASURED if not grid.measured.all() else UNMEASURED[:1]
    for value in stand_ins:
        x = np.where(grid.measured, grid.y, value)
        resolved = resolve_guesses(model, grid, x)
        together = _with_energy(resolved)
        for factor, added in MOVED:
            theta = factor * np.asarray(resolved.theta) + added
            t = grid.t[is_measured][None, :]
            u = grid.u[is_measured].T
            arguments = (x[is_measured].T, u, t, theta)
            is_bad &= ~np.isfinite(np.vstack(together(*arguments)))
            if not is_bad.any():
                return
    names = [*(f"the equation of {state}" for state in model.states), "the energy H"]
    for name, of_name in zip(names, is_bad, strict=True):
        places = np.flatnonzero(of_name)
        if len(places) > MOST_BAD * is_bad.shape[1]:
            node = int(np.flatnonzero(is_measured)[places[0]])
            raise ModelError(_told(resolved, grid, name, len(places), node))


def _with_energy(model: Model) -> ColumnFunction:
    """(x, u, t, theta) -> dx/dt, H, at many places."""

    def both(parts: Expressions) -> ca.SX:
        return ca.vertcat(parts.rates, ca.SX(parts.energy))

    made = partial(function_of, model, "rates", both)
    return ColumnFunction(model.built("rates and energy", made), (3,))


def _told(model: Model, grid: Grid, place: str, n_bad: int, node: int) -> str:
    n = int(grid.measured.any(axis=1).sum())
    at = [f"t = {grid.t[node]:.4g}"]
    for name, value in zip(model.states, grid.y[node], strict=True):
        if np.isfinite(value):
            at.append(f"{name} = {value:.4g}")
    values = [f"{name} = {value:.4g}" for name, value in model.values.items()]
    with_values = ", ".join(values[:N_TOLD])
    text = (
        f"{place} has no finite value at {n_bad} of {n} samples, first "
        f"at {', '.join(at)}"
    )
    if grid.trajectory[-1]:
        text += f" of trajectory {grid.trajectory[node] + 1}"
    if with_values:
        text += f", with {with_values}"
    return (
        f"{text}. {_culprit(model, grid, node)} divides by zero there, overflows, or "
        "takes a root or logarithm of a negative number; write it so that it has a "
        "value at all measured states, or give other values."
    )


def _culprit(model: Model, grid: Grid, node: int) -> str:
    """The first term without a finite value at a node, in words."""
    x = np.where(grid.measured[node], grid.y[node], UNMEASURED[0])
    theta = np.asarray(model.theta) + MOVED[1][1]
    found = terms_function(model)(x, grid.u[node], grid.t[node], theta)
    values = np.asarray(found).ravel()
    for value, (slot, equation, term) in zip(values, model.placed(), strict=True):
        if not np.isfinite(value):
            place = f"{slot} of {equation}" if equation else slot
            return f"The term {term.body!r} in {place}"
    return "A formula in H, R or F"
