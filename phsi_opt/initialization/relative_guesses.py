"""What the guesses of a model's parameters mean along a record: shares of sizes, values
to try, widths of corners.
"""

import numpy as np

from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share, Tried
from phsi_opt.model.slots import place_of
from phsi_opt.transcription.augmented_states import padded
from phsi_opt.transcription.grid import Grid

ROOM = (
    3.0  # factor on bounds that follow from efforts, whose scale depends on parameters
)
STILL, STAYING = (
    4.0,
    5.0,
)  # widths of dry friction's corner that count as rest, and how often as long as turning takes


def corner_widths(model: Model) -> dict[str, Share]:
    """Of the widths of rounded corners: of what they are a share, and by what factors
    they may be sharpened.
    """
    fixed = [e for e in model.entries.values() if e.parameter.fixed]
    return {
        e.name: guess
        for e in fixed
        if isinstance(guess := e.parameter.guess, Share) and guess.sharper
    }


def resolve_guesses(model: Model, grid: Grid, x: np.ndarray) -> Model:
    """The model with every `Share` and `Tried` guess replaced by its value (the middle
    one) over the states x.

    What is tried is bounded by them too, also where it has a value already.
    """
    for slot, equation, term in model.placed():
        for inner, parameter in term.inner.items():
            guess, value = parameter.guess, parameter.value
            name = term.inner_name(inner, place_of(slot, equation))
            if isinstance(guess, Share) and value is None:
                value = guess.share * root_mean_square(model, grid, x, guess.of)
            elif isinstance(guess, Tried) and not (
                parameter.fixed and value is not None
            ):
                size = _size_of(model, grid, x, guess)
                value = (
                    size * guess.shares[len(guess.shares) // 2]
                    if value is None
                    else value
                )
                model = model.with_upper(
                    {name: max(_bound(model, grid, guess, size), parameter.lower)}
                )
            else:
                continue
            model = model.with_values({name: value})
    return model


def _bound(model: Model, grid: Grid, guess: Tried, size: float) -> float:
    """Upper bound of what is tried; none where it follows states that nobody measured:
    they may change their scale.
    """
    used, seen = names_of(guess.of), np.asarray(grid.measured.any(axis=0))
    efforts = {f"dH_d{name}" for name in model.states} & used
    if not all(
        seen[i]
        for i, name in enumerate(model.states[: len(seen)])
        if {name, f"dH_d{name}"} & used
    ):
        return np.inf
    return guess.most * size * (ROOM if efforts else 1.0)


def values_to_try(model: Model, grid: Grid, x: np.ndarray, guess: Tried) -> np.ndarray:
    """The values to try for a parameter, over the states x."""
    return _size_of(model, grid, x, guess) * np.array(guess.shares)


def _size_of(model: Model, grid: Grid, x: np.ndarray, guess: Tried) -> float:
    if guess.of == "t":
        return float(np.max(grid.t - grid.t[grid.first][grid.trajectory]))
    if guess.of == "dt":
        return float(
            np.median(
                np.diff(grid.t[grid.sample])[np.diff(grid.trajectory[grid.sample]) == 0]
            )
        )
    return (
        float(np.max(np.abs(_along_nodes(model, grid, x, guess.of)), initial=0.0))
        or 1.0
    )


def root_mean_square(model: Model, grid: Grid, x: np.ndarray, expression: str) -> float:
    """Root mean square of a formula over the nodes; 1 where it vanishes."""
    values = _along_nodes(model, grid, x, expression)
    size = float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
    return size if size > 0 else 1.0


def _along_nodes(
    model: Model, grid: Grid, x: np.ndarray, expression: str
) -> np.ndarray:
    """Values of a formula at the nodes, those that are finite."""
    values = _at_nodes(model, grid, x, expression)
    return values[np.isfinite(values)]


def _at_nodes(model: Model, grid: Grid, x: np.ndarray, expression: str) -> np.ndarray:
    theta = model.theta
    mapped = model.function(expression).map("mapped", "serial", grid.n_nodes, [3], [])
    return np.array(
        mapped(padded(model, x).T, grid.u.T, grid.t[None, :], theta)
    ).ravel()


def intervals_at_rest(
    model: Model, grid: Grid, x: np.ndarray, of: str, width: float
) -> np.ndarray:
    """Whether a body stays at rest along each interval: its speed, a formula, is within
    some widths of zero.

    A body that only turns round is as slow, but passes through in a time that its usual
    acceleration tells.
    """
    speed = _at_nodes(model, grid, x, of)
    slow = (
        np.maximum(np.abs(speed[grid.begin]), np.abs(speed[grid.begin + 1]))
        < STILL * width
    )
    acceleration = np.sqrt(np.nanmean(grid.rates(speed[:, None]) ** 2))
    run = grid.trajectory[grid.begin]
    stretch = (
        np.cumsum(np.r_[True, (slow[1:] != slow[:-1]) | (run[1:] != run[:-1])]) - 1
    )
    lasts = np.bincount(stretch, grid.h)[stretch]
    return slow & (lasts * acceleration > STAYING * 2 * STILL * width)
