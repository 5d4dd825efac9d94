"""Where a larger model may begin when the present one has lost its way.

A model that lacks a loss may have no free run near the record: a pendulum that goes
over the top, fitted without its friction, loses its gravity to a bound. Along the
states that the missing force makes, which follow the record, the larger model's
parameters are nevertheless a problem of least squares.
"""

import casadi as ca
import numpy as np

from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_least_squares import bounded_least_squares
from phsi_opt.statistics import TINY


def regressed(base: DiagnosedModel, effect: Effect) -> dict[str, float]:
    """Values of the free parameters that take the place of the missing force w.

    ::

        minimise |J (theta - theta_0) - w|^2   within the bounds

    with J the derivative of the larger model's rates along the states of w.

    Args:
        base: the model that is diagnosed.
        effect: what is added to it; all its numbers but the first keep their guesses.
    """
    estimate = base.record.estimate
    model = base.fit.model.add(effect)
    model = resolve_guesses(model, estimate.grid, estimate.x)
    free = list(model.free)
    new = [name for name in free if name not in base.fit.model.entries]
    model = model.with_values({new[0]: 0.0})
    moving = [name for name in free if name not in new[1:]]
    places = [free.index(name) for name in moving]
    now = np.array([model.values[name] for name in moving])
    entries = [model.entries[name].parameter for name in moving]
    lower = np.array([one.lower for one in entries]) - now
    upper = np.array([one.upper for one in entries]) - now
    slopes = _slopes(model, estimate)[:, places]
    size = np.sqrt(np.mean(slopes**2, axis=0)) + TINY
    lower = lower * size
    upper = np.maximum(upper * size, lower + TINY)
    scaled = bounded_least_squares(slopes / size, estimate.w.ravel(), lower, upper)
    change = scaled / size
    return dict(zip(moving, (now + change).tolist(), strict=True))


def _slopes(model: Model, estimate: ForceEstimate) -> np.ndarray:
    """Derivative of the forced equations' rates by theta, (n_w, n_free)."""
    grid = estimate.grid
    rhs = model.rhs()
    arguments = [ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(4)]
    rows = rhs(*arguments)[list(estimate.rows)]
    slopes = ca.densify(ca.jacobian(rows, arguments[-1]))
    # Row by row, so that reshaping gives back equations and parameters.
    function = ca.Function("slopes", arguments, [ca.vec(slopes.T)])
    theta = np.array([model.values[name] for name in model.free])
    x = estimate.x[grid.begin]
    values = function(x.T, grid.u0.T, grid.t[grid.begin][None, :], theta)
    flat = np.nan_to_num(np.asarray(values).T)
    return np.asarray(flat.reshape(-1, len(model.free)))
