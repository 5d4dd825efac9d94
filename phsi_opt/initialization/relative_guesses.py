"""What the guesses of a model's parameters mean along a record.

A guess may be a share of a quantity's size, or a list of such shares to try. Here the
size is found over given states, and so are the bounds of what is tried, and the
intervals in which a body with dry friction stays at rest.
"""

import numpy as np

from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share, Tried
from phsi_opt.model.slots import place_of
from phsi_opt.statistics import rms
from phsi_opt.transcription.augmented_states import padded
from phsi_opt.transcription.defects import at_nodes
from phsi_opt.transcription.grid import Grid

STILL = 4.0  # widths of dry friction's corner within which a speed counts as rest


def corner_widths(model: Model) -> dict[str, Share]:
    """The widths of rounded corners by name, with the guess of each.

    The guess says of what a width is a share, and by what factors it may be sharpened.
    """
    widths = {}
    for name, entry in model.entries.items():
        guess = entry.parameter.guess
        if entry.parameter.fixed and isinstance(guess, Share) and guess.sharper:
            widths[name] = guess
    return widths


def resolve_guesses(model: Model, grid: Grid, x: np.ndarray) -> Model:
    """The model with every `Share` and `Tried` guess replaced by its value.

    Of the values to try it is the middle one. What is tried is bounded by the states
    too, also where it has a value already.

    Args:
        model: the model with its guesses.
        grid: nodes, times and inputs.
        x: (n_nodes, n_states) states, without those of a memory perhaps.
    """
    for slot, equation, term in model.placed():
        for inner, parameter in term.inner.items():
            guess = parameter.guess
            name = term.inner_name(inner, place_of(slot, equation))
            value = parameter.value
            if isinstance(guess, Share) and value is None:
                values = values_at(model, grid, x, guess.of)
                values = values[np.isfinite(values)]
                size = rms(values) if len(values) else 0.0
                size = size if size > 0 else 1.0  # where the formula vanishes
                model = model.with_values({name: guess.share * size})
            is_open = value is None or not parameter.fixed
            if isinstance(guess, Tried) and is_open:
                size = _largest(model, grid, x, guess.of)
                upper = max(_upper_bound(model, grid, guess, size), parameter.lower)
                middle = size * guess.shares[len(guess.shares) // 2]
                start = middle if value is None else value
                model = model.with_upper({name: upper}).with_values({name: start})
    return model


def _upper_bound(model: Model, grid: Grid, guess: Tried, size: float) -> float:
    """Upper bound of what is tried; none where it follows states that nobody measured.

    Such states may change their scale.
    """
    followed = names_of(guess.of)
    room = 1.0
    for number, name in enumerate(model.states):
        effort = f"dH_d{name}"
        if effort in followed:
            room = 3.0  # the scale of efforts depends on parameters
        # The memory of effects has no column in the measurements.
        is_hidden = not grid.measured[:, number : number + 1].any()
        if is_hidden and name not in model.memory and {name, effort} & followed:
            return np.inf
    return guess.most * size * room


def values_to_try(model: Model, grid: Grid, x: np.ndarray, guess: Tried) -> np.ndarray:
    """The values to try for a parameter, over the states ``x``, (n_shares,)."""
    return _largest(model, grid, x, guess.of) * np.array(guess.shares)


def _largest(model: Model, grid: Grid, x: np.ndarray, of: str) -> float:
    """Size of what a value is tried in shares of.

    The longest duration of a trajectory for ``t``, the usual time between samples for
    ``dt``, else the largest magnitude of a formula; 1 where that vanishes.
    """
    if of == "t":
        beginning = grid.t[grid.first][grid.trajectory]
        return float(np.max(grid.t - beginning))
    if of == "dt":
        is_inside = np.diff(grid.trajectory[grid.sample]) == 0
        return float(np.median(np.diff(grid.t[grid.sample])[is_inside]))
    values = values_at(model, grid, x, of)
    return float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values))) or 1.0


def intervals_at_rest(
    model: Model, grid: Grid, x: np.ndarray, of: str, width: float
) -> np.ndarray:
    """Whether a body stays at rest along each interval, (n_intervals,) of bool.

    Its speed is within some widths of zero. A body that only turns round is as slow,
    but passes through in a time that its usual acceleration tells; a rest lasts five
    times as long.

    Args:
        model: the model.
        grid: nodes and intervals.
        x: (n_nodes, n_states) states.
        of: the speed, a formula such as ``dH_dp``.
        width: of the corner of dry friction, in units of the speed.
    """
    speed = values_at(model, grid, x, of)
    at_begin = np.abs(speed[grid.begin])
    at_end = np.abs(speed[grid.begin + 1])
    is_slow = np.maximum(at_begin, at_end) < STILL * width
    acceleration = np.sqrt(np.nanmean(grid.rates(speed[:, None]) ** 2))
    trajectory = grid.runs
    is_changed = is_slow[1:] != is_slow[:-1]
    is_next_trajectory = trajectory[1:] != trajectory[:-1]
    stretch = np.cumsum(np.r_[True, is_changed | is_next_trajectory]) - 1
    duration = np.bincount(stretch, grid.h)[stretch]
    return is_slow & (duration * acceleration > 5 * 2 * STILL * width)


def values_at(
    model: Model,
    grid: Grid,
    x: np.ndarray,
    expression: str,
    theta: np.ndarray | None = None,
) -> np.ndarray:
    """Values of a formula at the nodes, (n_nodes,), at the model's present values.

    Or at others of its free parameters, (n_free,).
    """
    theta = model.theta if theta is None else theta
    (values,) = at_nodes(model.function(expression), grid, padded(model, x).T, theta)
    return values.ravel()
