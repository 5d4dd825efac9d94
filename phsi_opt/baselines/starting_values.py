"""Where gradient descent starts (thesis appendix B, Section 5.1)."""

import numpy as np

from phsi_opt.baselines.descent_settings import Descent
from phsi_opt.baselines.torch_polynomials import monomial
from phsi_opt.model.model import Model
from phsi_opt.model.slots import place_of

# Of coefficients (appendix B, the thesis' code); frequencies as those of functions.
THESIS_STARTS = {"polynomial": 0.2, "function": 1.0, "damping": 0.0}


def starting_values(model: Model, settings: Descent, seed: int) -> np.ndarray:
    """Where the descent starts, in the order of ``model.entries``; see `Descent`.

    Returns:
        A value per parameter, (n_parameters,).
    """
    rng = np.random.default_rng(seed)
    of_thesis = _thesis_starts(model)
    values = []
    for name, entry in model.entries.items():
        # Thesis Section 5.1; drawn for given values too.
        draw = rng.normal(scale=0.5)
        parameter = entry.parameter
        # Of a formula or inside a term.
        is_known = parameter.value is not None and not entry.prunable
        if settings.start == "model" or parameter.fixed or is_known:
            values.append(parameter.start)
            continue
        value = of_thesis.get(name, THESIS_STARTS["function"])
        if settings.start == "normal":
            # At a bound of zero nothing would move.
            is_size = parameter.lower == 0 and entry.slot != "R"
            value = abs(draw) if is_size else draw
        if entry.slot != "R" or settings.keep_damping_positive:
            value = float(np.clip(value, parameter.lower, parameter.upper))
        values.append(value)
    return np.array(values)


def _thesis_starts(model: Model) -> dict[str, float]:
    """Start of every coefficient by the kind of its term."""
    variables = (*model.states, *model.inputs, "t")
    starts = {}
    for slot, equation, term in model.placed():
        is_monomial = not term.inner and monomial(term.body, variables) is not None
        kind = "damping" if slot == "R" else "polynomial" if is_monomial else "function"
        if not term.is_formula:
            name = term.coefficient_name(place_of(slot, equation))
            starts[name] = THESIS_STARTS[kind]
    return starts
