"""Where gradient descent starts (thesis appendix B, Section 5.1)."""

import numpy as np

from phsi_opt.baselines.descent_settings import Descent
from phsi_opt.baselines.torch_polynomials import monomial
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry, place_of
from phsi_opt.model.terms import Term

# Of coefficients (appendix B, the thesis' code); frequencies as those of functions.
THESIS_STARTS = {"polynomial": 0.2, "function": 1.0, "damping": 0.0}
NORMAL_START = 0.5  # standard deviation of a random start (thesis Section 5.1)


def starting_values(model: Model, settings: Descent, seed: int) -> np.ndarray:
    """Where the descent starts, in the order of ``model.entries``; see `Descent`.

    Returns:
        A value per parameter, (n_parameters,).
    """
    rng = np.random.default_rng(seed)
    of_thesis = _thesis_starts(model)
    values = []
    for name, entry in model.entries.items():
        draw = NORMAL_START * rng.normal()  # drawn for given values too
        if settings.start == "model" or _is_given(entry):
            values.append(entry.parameter.start)
            continue
        value = of_thesis.get(name, THESIS_STARTS["function"])
        if settings.start == "normal":
            value = _drawn(draw, entry)
        values.append(_bounded(value, entry, settings))
    return np.array(values)


def _is_given(entry: Entry) -> bool:
    """Whether the value is the model's own: fixed, of a formula or inside a term."""
    parameter = entry.parameter
    return parameter.fixed or (parameter.value is not None and not entry.prunable)


def _drawn(draw: float, entry: Entry) -> float:
    """The draw; its size for a number that may not be negative.

    At its bound of zero nothing would move.
    """
    if entry.parameter.lower == 0 and entry.slot != "R":
        return abs(draw)
    return draw


def _bounded(value: float, entry: Entry, settings: Descent) -> float:
    if entry.slot == "R" and not settings.keep_damping_positive:
        return value
    return float(np.clip(value, entry.parameter.lower, entry.parameter.upper))


def _thesis_starts(model: Model) -> dict[str, float]:
    """Start of every coefficient by the kind of its term."""
    variables = (*model.states, *model.inputs, "t")
    starts = {}
    for slot, equation, term in model.placed():
        if not term.is_formula:
            name = term.coefficient_name(place_of(slot, equation))
            starts[name] = _thesis_start(slot, term, variables)
    return starts


def _thesis_start(slot: str, term: Term, variables: tuple[str, ...]) -> float:
    if slot == "R":
        return THESIS_STARTS["damping"]
    if not term.inner and monomial(term.body, variables) is not None:
        return THESIS_STARTS["polynomial"]
    return THESIS_STARTS["function"]
