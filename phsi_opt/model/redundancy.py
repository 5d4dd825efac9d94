"""Whether a model can do already what an effect does."""

import casadi as ca
import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.effect import Effect, is_scanned
from phsi_opt.model.symbolic import Expressions, function_of, with_slopes


def is_redundant(model: BaseModel, effect: Effect) -> bool:
    """Whether the model can do already what the effect does."""
    return stands_in(model, effect) or is_spanned(model, effect)


def is_spanned(model: BaseModel, effect: Effect) -> bool:
    """Whether the model's free parameters can do what the effect does."""
    if not model.free or is_scanned(effect):
        return False
    # Whether its slopes are a sum of the slopes of the model's parameters.
    larger = model.add(effect)
    is_new = np.array([name not in model.entries for name in larger.free])
    slopes = _slopes_in_random_states(model, larger)
    own = slopes[:, ~is_new]
    added = slopes[:, is_new]
    weights = np.linalg.lstsq(own, added, rcond=None)[0]
    left = added - own @ weights
    # Above the rounding of the least squares, far below any effect of its own.
    return bool(np.linalg.norm(left) < 1e-8 * np.linalg.norm(added))


def stands_in(model: BaseModel, effect: Effect) -> bool:
    """Whether a term, a coefficient or a memory of the effect is in the model."""
    bodies = {term.body for term in model.terms_at(effect.slot, effect.equation)}
    for term in effect.term:
        if term.body in bodies or term.name in model.entries:
            return True
    return not set(effect.memory).isdisjoint((*model.states, *model.inputs))


def _slopes_in_random_states(model: BaseModel, larger: BaseModel) -> np.ndarray:
    """Slopes of dx/dt and of what is shown in theta, (n_values, n_free)."""
    random = np.random.default_rng(0)
    # The model's parameters must explain the effect at one point of theta. The effect's
    # coefficient is zero there, so that no parameter acts through it.
    known = model.values
    values = []
    for name in larger.free:
        value = known.get(name) or random.uniform(0.5, 1.5)  # away from zero
        is_added = name not in model.entries and larger.entries[name].prunable
        values.append(0.0 if is_added else value)
    theta = np.array(values)
    # With fewer rows than parameters anything would be explained.
    n = 4 * len(theta) + 20
    x = random.normal(size=(larger.n_states, n))
    u = random.normal(size=(larger.n_inputs, n))
    t = random.uniform(0, 3, (1, n))

    def values_of(parts: Expressions) -> ca.SX:
        return ca.vertcat(*map(ca.SX, parts.rates), parts.shown)

    function = with_slopes(function_of(larger, "values", values_of), "theta")
    slopes = function.map("slopes", "serial", n, [3], [])(x, u, t, theta)[1]
    return np.nan_to_num(np.array(slopes).T.reshape(-1, len(theta)))
