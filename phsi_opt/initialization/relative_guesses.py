"""What the guesses of a model's parameters mean along a record.

A guess may be a share of a quantity's size, or a list of such shares to try. Here the
size is found over given states, and so are the bounds of what is tried, and the
intervals in which a body with dry friction stays at rest. With these values a model's
formulas are checked: exp(1000*q), log(q) of negative positions or a mass of zero would
meet the solver as numbers that are none, and it would blame something else.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from phsi_opt.data.checks import LARGEST_VALUE
from phsi_opt.errors import ModelError
from phsi_opt.initialization.scaling import rates_and_slopes, some_nodes
from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share, Tried
from phsi_opt.model.slots import PlacedTerm
from phsi_opt.model.symbolic import terms_function
from phsi_opt.optimization.column_function import in_numbers
from phsi_opt.presentation.units import frequency_words, scale_of, spaced
from phsi_opt.statistics import rms
from phsi_opt.transcription.augmented_states import padded
from phsi_opt.transcription.defects import at_nodes
from phsi_opt.transcription.grid import Grid

# Values that stand for states nobody measured, by turns: a formula that has a value at
# one of them may have one at the true state.
UNMEASURED = (1.0, 1e-3)
# The same for parameters that are to be found: their start, and beside it.
MOVED = ((1.0, 0.0), (1.1, 0.1))  # factor, and what is added


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


def guessed_corners(model: Model) -> tuple[str, ...]:
    """The widths of rounded corners that have no value yet."""
    widths = corner_widths(model)
    return tuple(name for name in widths if model.entries[name].parameter.value is None)


def resolve_guesses(model: Model, grid: Grid, x: np.ndarray) -> Model:
    """The model with every `Share` and `Tried` guess replaced by its value.

    Of the values to try it is the middle one. What is tried is bounded by the states x
    (n_nodes, n_states) too, also where it has a value already; those of a memory may
    lack.
    """
    for placed in model.placed():
        for inner, parameter in placed.term.inner.items():
            guess = parameter.guess
            name = placed.parameter_name(inner)
            value = parameter.value
            if isinstance(guess, Share) and value is None:
                values = values_at(model, grid, x, guess.of)
                values = values[np.isfinite(values)]
                size = rms(values) if len(values) else 0.0
                size = size if size > 0 else 1.0  # where the formula vanishes
                model = model.with_values({name: guess.share * size})
            is_open = value is None or not parameter.fixed
            if isinstance(guess, Tried) and is_open:
                size = largest(model, grid, x, guess.of)
                upper = max(_upper_bound(model, grid, guess, size), parameter.lower)
                middle = size * guess.shares[len(guess.shares) // 2]
                start = middle if value is None else value
                model = model.with_upper({name: upper}).with_values({name: start})
    return model


def shifts(grid: Grid) -> np.ndarray:
    """Delays that are tried, those of every interval up to a tenth of a record."""
    n = int(np.max(np.bincount(grid.trajectory))) // 10
    return np.median(grid.h) * np.array([0.25, 0.5, *range(1, max(n, 3) + 1)])


def open_delays(model: Model) -> list[str]:
    """Delays of inputs that have no value to begin with."""
    found = []
    for _, name in model.delays:
        if model.entries[name].parameter.value is None:
            found.append(name)
    return found


def _upper_bound(model: Model, grid: Grid, guess: Tried, size: float) -> float:
    """Upper bound of what is tried; none where it follows unmeasured states."""
    # Such states may change their scale.
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


def largest(model: Model, grid: Grid, x: np.ndarray, of: str) -> float:
    """Size of what a value is tried in shares of, over the states ``x``.

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

    Its speed ``of``, a formula such as ``dH_dp`` of the states x (n_nodes, n_states),
    is within four widths of zero, of dry friction's corner. A body that only turns
    round is as slow, but passes through in a time that its usual acceleration tells; a
    rest lasts five times as long.
    """
    speed = values_at(model, grid, x, of)
    at_begin = np.abs(speed[grid.begin])
    at_end = np.abs(speed[grid.begin + 1])
    still = 4 * width
    is_slow = np.maximum(at_begin, at_end) < still
    acceleration = np.sqrt(np.nanmean(grid.rates(speed[:, None]) ** 2))
    trajectory = grid.runs
    is_changed = is_slow[1:] != is_slow[:-1]
    is_next_trajectory = trajectory[1:] != trajectory[:-1]
    stretch = np.cumsum(np.r_[True, is_changed | is_next_trajectory]) - 1
    duration = np.bincount(stretch, grid.h)[stretch]
    return is_slow & (duration * acceleration > 5 * 2 * still)


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
    grid = grid.driven(model, theta)
    (values,) = at_nodes(model.function(expression), grid, padded(model, x), theta)
    return values.ravel()


# ---- values of the formulas --------------------------------------------------------


def check_rates(model: Model, grid: Grid) -> None:
    """Refuse a model with a term that is not finite, or huge, at the measured states.

    Nor are the slopes of a term of H, at the values from which parameters start.

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
        for factor, added in MOVED:
            theta = factor * resolved.theta + added
            t = grid.t[nodes][None, :]
            u = grid.driven(resolved, theta).u[nodes].T
            (values,) = in_numbers(made, x[nodes].T, u, t, theta)
            is_bad &= ~(np.abs(values) < LARGEST_VALUE)  # squares are numbers too
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
    text = f"the term {term.body!r} in {place} has no finite value, or one beyond "
    text += f"{LARGEST_VALUE:g}, at {where}, first at {', '.join(at)}"
    if grid.trajectory[-1]:
        text += f" of trajectory {grid.trajectory[node] + 1}"
    if values:
        text += f", with {', '.join(values[:8])}"
    return (
        f"{text}. It divides by zero, overflows, or takes a root or logarithm of a "
        "negative number; change the formula or the values."
    )


def fast_motion(model: Model, grid: Grid, units: Mapping[str, str]) -> str:
    """A note if its values make the model oscillate faster than samples show.

    By the largest imaginary part of the eigenvalues of df/dx (without memory; a median
    over measured states), where it follows from free parameters whose values are given.
    """
    known = np.nan_to_num(grid.y)
    resolved = resolve_guesses(model, grid, known)
    is_motion = [name not in model.memory for name in model.states]
    some = some_nodes(grid, known)  # enough for a median

    def frequency(theta: np.ndarray) -> float:
        slopes = rates_and_slopes(resolved, *some, theta)[1]
        finite = np.nan_to_num(slopes, posinf=0.0, neginf=0.0)
        rates = np.linalg.eigvals(finite[:, is_motion][:, :, is_motion]).imag
        return float(np.median(np.abs(rates).max(axis=1))) / (2 * np.pi)

    found = frequency(resolved.theta)
    limit = 0.5 / float(np.median(grid.h))
    starts = []
    for place, name in enumerate(model.free if found > limit else ()):
        moved = resolved.theta.copy()
        moved[place] = 1.1 * moved[place] or 0.1
        parameter = model.entries[name].parameter
        if abs(frequency(moved) / found - 1) > 0.01:
            scale = scale_of(parameter.unit)
            told = f"{scale.shown(parameter.start):.4g}{spaced(scale.unit)}"
            starts.append(f"{name} = {told}" if parameter.value is not None else "")
    if not starts or not all(starts):
        return ""
    return (
        f"The values {', '.join(starts)} let the model oscillate "
        f"{frequency_words(found, units)}. The samples can show oscillations only "
        f"up to their Nyquist limit, {frequency_words(limit, units)}. Check the units, "
        "or choose other starting values."
    )
