"""What a missing force does with energy, in words.

Each function gives the end of a sentence that begins with "It" or "The force".
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import (
    CLEAR_PATTERN,
    GOING_TOGETHER,
    MOSTLY_PARAMETERS,
    NAMED_CAUSE,
    OPPOSING_POWER,
    TIED_CAUSES,
)
from phsi_opt.force_analysis.causes import CAUSES, Causes
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.piecewise_linear import (
    odd_basis,
    piecewise_linear_basis,
)
from phsi_opt.force_analysis.position_waves import PositionWave
from phsi_opt.force_analysis.time_basis import period_of
from phsi_opt.force_analysis.units import spaced
from phsi_opt.model.kinds import TURN, plain_unit
from phsi_opt.model.model import FirstOrder, Model
from phsi_opt.model.structure import exchange_partners, position_of_momentum
from phsi_opt.presentation.durations import time_words
from phsi_opt.statistics import TINY

OTHER_VALUES = "is what other values of the model's own parameters would give"
NO_PATTERN = "no clear pattern"
TOGETHER = "which moves together with the input"


def energy_sentence(causes: Causes, with_shares: bool = True) -> str:
    """What the force does, with the share of each cause that is worth naming.

    Args:
        causes: of the force of one equation.
        with_shares: whether the shares are told. They are those of the estimate, with
            its errors: beside the statement that an effect was all that was missing,
            they seem to contradict it.
    """
    contributions = causes.contributions
    if sum(contributions.values()) < CLEAR_PATTERN:
        return NO_PATTERN
    parts = []
    for kind, share in contributions.items():
        least = NAMED_CAUSE if kind in CAUSES else MOSTLY_PARAMETERS
        if share > least:
            is_several = kind == "inputs" and len(causes.force.fit.model.inputs) > 1
            verb = "explain" if is_several else "explains"
            explained = f", which {verb} {100 * share:.0f} % of it"
            parts.append(_words(causes, kind) + (explained if with_shares else ""))
    return (", and ".join(parts) + _tie(causes)) or NO_PATTERN


def _tie(causes: Causes) -> str:
    """Which other causes would explain as much as the strongest one."""
    contributions = causes.contributions
    first = next((kind for kind in contributions if kind in CAUSES), "constant")
    if first == "constant" or contributions[first] <= NAMED_CAUSE:
        return ""
    least_gain = causes.gains[first] - TIED_CAUSES
    alike = []
    for kind, gain in causes.gains.items():
        if kind not in contributions and gain > least_gain:
            alike.append(_words(causes, kind))
    said = ""
    if alike:
        said = f"; not told apart from one that {' or '.join(alike)}"
    if first == "inputs" and "dissipated" not in contributions:
        said += _closed_loop(causes)
    return said


def _closed_loop(causes: Causes) -> str:
    """That input and effort go together, as they do where a controller is at work."""
    force = causes.force
    if isinstance(force.fit.model, FirstOrder):
        return ""
    effort = force.effort_of(causes.equation)
    inputs = [force.variable(name) for name in force.fit.model.inputs]
    bases = [piecewise_linear_basis(u) for u in inputs if np.ptp(u) > 0]
    if not bases or not np.var(effort) > 0:
        return ""
    functions = np.hstack(bases)
    fitted = functions @ np.linalg.lstsq(functions, effort, rcond=None)[0]
    together = 1 - np.var(effort - fitted) / np.var(effort)
    if together < GOING_TOGETHER:
        return ""
    name = effort_words(force.fit.model, causes.equation)
    return f"; not told apart from {name}, {TOGETHER} here"


def _words(causes: Causes, kind: str) -> str:
    """What a force of one kind does."""
    if kind == "parameters":
        return OTHER_VALUES
    if kind == "constant":
        mean = causes.force.force_on(causes.equation).mean()
        return f"is constant at {mean:.3g}"
    if kind == "conserved":
        return _exchange_words(causes)
    if kind == "inputs":
        return f"follows {listed(causes.force.fit.model.inputs, 'input')}"
    if kind == "time":
        return _time_words(causes)
    return _loss_words(causes)


def _exchange_words(causes: Causes) -> str:
    followed = followed_words(causes.force, causes.equation, causes.wave)
    return f"stores and returns energy (it follows {followed})"


def followed_words(force: ForceRecord, equation: str, wave: PositionWave | None) -> str:
    """What a force that stores energy follows, and after what a wave comes again.

    Such as "the position q and repeats every 1.05 rad, 6 times a turn".
    """
    model = force.fit.model
    noun = exchange_noun(model, equation)
    if wave is None:
        return listed(exchange_partners(model, equation), noun)
    unit = force.units.get(wave.position, "")
    said = f"the {noun} {wave.position} and repeats every {wave.period:.3g}"
    said += spaced(unit)
    turn = TURN.get(plain_unit(unit))
    if turn is None:
        return said
    return f"{said}, {turn / wave.period:.3g} times a turn"


def exchange_noun(model: Model, equation: str) -> str:
    """What the states are called that an equation exchanges energy with."""
    return "position" if equation in position_of_momentum(model) else "state"


def effort_words(model: Model, equation: str) -> str:
    """The effort of an equation as people call it: a velocity by its position."""
    position = position_of_momentum(model).get(equation, "")
    if position:
        return f"the velocity d{position}/dt"
    return f"the effort dH_d{equation}"


def _loss_words(causes: Causes) -> str:
    """Whether the force, and it with the model's own loss, opposes the effort."""
    force = causes.force
    equation = causes.equation
    model = force.fit.model
    if isinstance(model, FirstOrder):
        return f"follows {equation} itself"
    name = effort_words(model, equation)
    effort = force.effort_of(equation)
    fitted = odd_basis(effort) @ _loss_coefficients(causes)
    if _relative_power(fitted, effort) < OPPOSING_POWER:
        return f"takes energy out (it opposes {name})"
    whole_loss = fitted + force.loss_in(equation)
    if _relative_power(whole_loss, effort) < OPPOSING_POWER:
        return (
            f"changes how energy is lost (it follows {name}, "
            "by another law than the model's damping)"
        )
    return f"feeds energy in (it pushes along {name})"


def _loss_coefficients(causes: Causes) -> np.ndarray:
    """Of the odd functions of the effort, fitted to the force, (n_functions,)."""
    w = causes.force.force_on(causes.equation)
    return np.linalg.lstsq(causes.bases["dissipated"], w, rcond=None)[0]


def _relative_power(force: np.ndarray, effort: np.ndarray) -> float:
    """Mean power of a force over the product of rms force and rms effort.

    It is -1 for linear damping, and 0 where no energy goes in or out on the whole.
    """
    size = float(np.linalg.norm(force) * np.linalg.norm(effort))
    return float(force @ effort / max(size, TINY))


def _time_words(causes: Causes) -> str:
    force = causes.force
    period = period_of(force, causes.equation)
    if period is None or period > _longest_run(force):
        return "depends on time: it changes slowly"
    return f"depends on time: period {time_words(period, force.units.get('t', ''))}"


def _longest_run(force: ForceRecord) -> float:
    """Duration of the longest trajectory."""
    runs = np.unique(force.run)
    return max(float(np.ptp(force.t[force.run == run])) for run in runs)


def listed(names: Sequence[str], noun: str) -> str:
    """The names with their noun: "the input u", "the positions q1, q2"."""
    plural = "s" if len(names) > 1 else ""
    return f"the {noun}{plural} {', '.join(names)}"
