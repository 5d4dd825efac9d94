"""Whether a model can do already what an effect would add to it.

Either a term of the effect stands in the model, or its change of dx/dt and of what the
sensors show is a sum of the changes that the model's own parameters make. The second is
looked at in random states: an identity holds in all of them.
"""

import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.effect import Effect, is_scanned
from phsi_opt.model.symbolic import output_function, rhs_function, with_slopes

# Range of random values for parameters that have none, away from zero.
PARAMETER_RANGE = (0.5, 1.5)
# What is left, as a share of the effect: above the rounding of the least squares, far
# below any effect of its own.
NOTHING_LEFT = 1e-8


def is_redundant(model: BaseModel, effect: Effect) -> bool:
    """Whether the model can do already what the effect does."""
    if stands_in(model, effect):
        return True
    return bool(model.free) and not is_scanned(effect) and _is_spanned(model, effect)


def stands_in(model: BaseModel, effect: Effect) -> bool:
    """Whether a term, a coefficient or a memory of the effect is in the model."""
    bodies = {term.body for term in model.terms_at(effect.slot, effect.equation)}
    for term in effect.term:
        if term.body in bodies or term.name in model.entries:
            return True
    return not set(effect.memory).isdisjoint(model.states)


def _is_spanned(model: BaseModel, effect: Effect) -> bool:
    """Whether the effect's slopes are a sum of the slopes of the model's parameters."""
    larger = model.add(effect)
    is_new = np.array([name not in model.entries for name in larger.free])
    slopes = _slopes_in_random_states(model, larger)
    own = slopes[:, ~is_new]
    added = slopes[:, is_new]
    weights = np.linalg.lstsq(own, added, rcond=None)[0]
    left = added - own @ weights
    return bool(np.linalg.norm(left) < NOTHING_LEFT * np.linalg.norm(added))


def _slopes_in_random_states(model: BaseModel, larger: BaseModel) -> np.ndarray:
    """Slopes of dx/dt and of what is shown in theta, (n_values, n_free)."""
    random = np.random.default_rng(0)
    # The model's parameters must explain the effect at one point of theta. The effect's
    # coefficient is zero there, so that no parameter acts through it.
    known = model.values
    values = []
    for name in larger.free:
        value = known.get(name) or random.uniform(*PARAMETER_RANGE)
        is_added = name not in model.entries and larger.entries[name].prunable
        values.append(0.0 if is_added else value)
    theta = np.array(values)
    # With fewer rows than parameters anything would be explained.
    n = 4 * len(theta) + 20
    x = random.normal(size=(larger.n_states, n))
    u = random.normal(size=(larger.n_inputs, n))
    t = random.uniform(0, 3, (1, n))
    parts = []
    for function in (rhs_function(larger), output_function(larger)):
        slopes = with_slopes(function, "theta").map("slopes", "serial", n, [3], [])
        columns = np.array(slopes(x, u, t, theta)[1]).T
        parts.append(columns.reshape(-1, len(theta)))
    return np.nan_to_num(np.vstack(parts))
