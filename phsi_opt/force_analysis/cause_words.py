"""What a missing force follows and does with energy, in words.

Each text is the end of a sentence that begins with "It" or "The force".
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import OPPOSING_POWER
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.piecewise_linear import odd_basis
from phsi_opt.force_analysis.units import spaced
from phsi_opt.force_analysis.waves import period_of
from phsi_opt.model.kinds import TURN, plain_unit
from phsi_opt.model.model import FirstOrder
from phsi_opt.model.structure import exchange_partners
from phsi_opt.presentation.durations import time_words
from phsi_opt.statistics import TINY

NO_PATTERN = "no clear pattern"


def cause_words(force: EquationForce, with_shares: bool = True) -> str:
    """What the force does, with the share of each cause that is worth naming.

    The shares are those of the estimate, with its errors: beside the statement that an
    effect was all that was missing, they seem to contradict it.
    """
    causes = force.causes
    parts = []
    for cause in causes.named:
        told = _words(force, cause)
        if with_shares:
            several = cause == "inputs" and len(force.record.model.inputs) > 1
            verb = "explain" if several else "explains"
            told += f", which {verb} {share_words(force, cause)}"
        parts.append(told)
    said = ", and ".join(parts) or NO_PATTERN
    return said + tie_words(force)


def share_words(force: EquationForce, cause: str) -> str:
    """How much of the force a cause explains: "83 % of it"."""
    return f"{100 * force.causes.contributions[cause]:.0f} % of it"


def tie_words(force: EquationForce) -> str:
    """Which other causes would explain as much as the strongest one; "" for none."""
    said = ""
    if force.causes.alike:
        alike = [_words(force, cause) for cause in force.causes.alike]
        said = f"; not told apart from one that {' or '.join(alike)}"
    if force.causes.goes_together:
        said += f"; not told apart from {effort_words(force)}, "
        said += "which moves together with the input here"
    return said


def _words(force: EquationForce, cause: str) -> str:
    """What a force of one cause does."""
    if cause == "parameters":
        return "is what other values of the model's own parameters would give"
    if cause == "constant":
        return f"is constant at {force.w.mean():.3g}"
    if cause == "conserved":
        return f"stores and returns energy (it follows {followed_words(force)})"
    if cause == "inputs":
        return f"follows {inputs_words(force)}"
    return _time_words(force) if cause == "time" else _loss_words(force)


def followed_words(force: EquationForce) -> str:
    """What a force that stores energy follows, and after what a wave comes again.

    Such as "the position q and repeats every 1.05 rad, 6 times a turn".
    """
    noun = "position" if force.position else "state"
    wave = force.wave
    if wave is None:
        return listed(exchange_partners(force.record.model, force.equation), noun)
    unit = force.record.units.get(wave.position, "")
    said = f"the {noun} {wave.position} and repeats every {wave.period:.3g}"
    said += spaced(unit)
    turn = TURN.get(plain_unit(unit))
    return said if turn is None else f"{said}, {turn / wave.period:.3g} times a turn"


def effort_words(force: EquationForce) -> str:
    """The effort of the equation as people call it: a velocity by its position."""
    if force.position:
        return f"the velocity d{force.position}/dt"
    return f"the effort dH_d{force.equation}"


def inputs_words(force: EquationForce) -> str:
    """All inputs: "the input u", "the inputs u1, u2"."""
    return listed(force.record.model.inputs, "input")


def listed(names: Sequence[str], noun: str) -> str:
    """The names with their noun: "the input u", "the positions q1, q2"."""
    plural = "s" if len(names) > 1 else ""
    return f"the {noun}{plural} {', '.join(names)}"


def _loss_words(force: EquationForce) -> str:
    """Whether the force, and it with the model's own loss, opposes the effort."""
    if isinstance(force.record.model, FirstOrder):
        return f"follows {force.equation} itself"
    name = effort_words(force)
    functions = odd_basis(force.effort)
    shown = force.shown(functions)
    fitted = functions @ np.linalg.lstsq(shown, force.w, rcond=None)[0]
    if _relative_power(fitted, force.effort) < OPPOSING_POWER:
        return f"takes energy out (it opposes {name})"
    whole_loss = fitted + force.record.losses[:, force.row]
    if _relative_power(whole_loss, force.effort) < OPPOSING_POWER:
        return (
            f"changes how energy is lost (it follows {name}, "
            "by another law than the model's damping)"
        )
    return f"feeds energy in (it pushes along {name})"


def _relative_power(force: np.ndarray, effort: np.ndarray) -> float:
    """Mean power of a force over the product of rms force and rms effort.

    It is -1 for linear damping, and 0 where no energy goes in or out on the whole.
    """
    size = float(np.linalg.norm(force) * np.linalg.norm(effort))
    return float(force @ effort / max(size, TINY))


def _time_words(force: EquationForce) -> str:
    """The period, where one is within the longest trajectory."""
    record = force.record
    runs = [record.t[record.run == run] for run in np.unique(record.run)]
    period = period_of(force)
    if period is None or period > max(float(np.ptp(t)) for t in runs):
        return "depends on time: it changes slowly"
    return f"depends on time: period {time_words(period, record.units.get('t', ''))}"
