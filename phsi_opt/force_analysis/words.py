"""What was found of a missing force, in words: its size, its place and its cause.

Nothing is computed here; the numbers are those of the force. Ranges are told by what
they are among the values that occurred, and a velocity has no symbol.
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN, NAMED_CAUSE, OPPOSING_POWER
from phsi_opt.force_analysis.causes import CAUSES
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import (
    THROUGHOUT,
    StrongRange,
    strong_region,
)
from phsi_opt.force_analysis.piecewise_linear import odd_basis
from phsi_opt.force_analysis.units import frequency_words, spaced
from phsi_opt.force_analysis.waves import period_of
from phsi_opt.model.kinds import TURN, plain_unit
from phsi_opt.model.structure import exchange_partners, position_rows
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.durations import dates_words, time_words, times_words
from phsi_opt.statistics import TINY

NO_PATTERN = "no clear pattern"
VIBRATION_WORDS = "a vibration or an error of a sensor, rather than a law of the motion"
# What the rate of a momentum or a velocity is called, by its unit.
RATES = {
    "N": "force on",
    "N m": "torque on",
    "m/s^2": "acceleration of",
    "rad/s^2": "acceleration of",
}
MOSTLY = 0.5  # share of a force's mean square that is most of it


# ---- one force in a sentence ---------------------------------------------------------


def sentence(force: EquationForce) -> str:
    """Size and place of a missing force, what it does with energy, what predicts it."""
    where = force.where
    scale = force.scale
    equation = f"d{force.equation}/dt"
    size = f"rms {where['strength'] / scale.size:.3g}{spaced(scale.unit)}"
    certainty = f"{where['times_noise']:.2g} times its standard deviation"
    if force.is_uncertain:
        return f"{equation}: no missing force is sure ({size}, {certainty})."
    said = f"{equation} lacks a force of {size}, {certainty}; {_place(force)}."
    cause = cause_words(force)
    said += " No single cause explains it." if cause == NO_PATTERN else f" It {cause}."
    best = leading(force.follows, force.equation)
    if best is None or best["share"] < CLEAR_PATTERN:
        return said
    share = f"{100 * best['share']:.0f} % of it"
    return f"{said} Best predicted from {best['variable']}: {share}."


def _place(force: EquationForce) -> str:
    """Trajectory, times, region and frequency."""
    units = force.record.units
    window = force.where["time_window"]
    told = ["about as strong all the time"]
    if not window.endswith(THROUGHOUT):
        name = force.where["trajectory"]
        told = [f"strongest in {name}, t = {times_words(window, units.get('t', ''))}"]
        dates = dates_words(window, force.record.origin_of(name))
        told[0] += f" ({dates})" if dates else ""
    if force.region:
        told.append(f"strong {place_words(force, list(force.region))}")
    if force.pace.is_vibration:
        told.append(f"mostly {force.pace.speed_words(units)}: {VIBRATION_WORDS}")
    elif force.pace.frequency > 0:
        told.append(f"mostly {frequency_words(force.pace.frequency, units)}")
    return "; ".join(told)


# ---- causes --------------------------------------------------------------------------


def cause_words(force: EquationForce, with_shares: bool = True) -> str:
    """What the force does: the end of a sentence that begins with "It".

    With the share of each cause that is worth naming. The shares are those of the
    estimate, with its errors: beside the statement that an effect was all that was
    missing, they seem to contradict it.
    """
    parts = []
    for cause in force.causes.named:
        told = _does(force, cause)
        if with_shares:
            several = cause == "inputs" and len(force.record.model.inputs) > 1
            verb = "explain" if several else "explains"
            told += f", which {verb} {_share_words(force, cause)}"
        parts.append(told)
    said = ", and ".join(parts) or NO_PATTERN
    return said + _tie_words(force)


def _share_words(force: EquationForce, cause: str) -> str:
    """How much of the force a cause explains: "83 % of it"."""
    return f"{100 * force.causes.contributions[cause]:.0f} % of it"


def _tie_words(force: EquationForce) -> str:
    """Which other causes would explain as much as the strongest one; "" for none."""
    said = ""
    if force.causes.alike:
        alike = [_does(force, cause) for cause in force.causes.alike]
        said = f"; not told apart from one that {' or '.join(alike)}"
    if force.causes.goes_together:
        said += f"; not told apart from {_followed(force, 'dissipated')}, "
        said += "which moves together with the input here"
    return said


def _does(force: EquationForce, cause: str) -> str:
    """What a force of one cause does."""
    match cause:
        case "parameters":
            return "is what other values of the model's own parameters would give"
        case "constant":
            return f"is constant at {force.w.mean():.3g}"
        case "conserved":
            return f"stores and returns energy (it follows {_followed(force, cause)})"
        case "inputs":
            return f"follows {_followed(force, cause)}"
        case "time":
            return _time_words(force)
    return _loss_words(force)


def _followed(force: EquationForce, cause: str) -> str:
    """What a force of one cause depends on: a noun."""
    model = force.record.model
    if cause == "time":
        return "the time"
    if cause == "inputs":
        return inputs_words(force)
    if cause == "dissipated":
        return plain_name(force, model.efforts[force.row])
    noun = "position" if force.position else "state"
    wave = force.wave
    if wave is None:
        return _listed(exchange_partners(model, force.equation), noun)
    unit = force.record.units.get(wave.position, "")
    said = f"the {noun} {wave.position} and repeats every {wave.period:.3g}"
    said += spaced(unit)
    turn = TURN.get(plain_unit(unit))
    return said if turn is None else f"{said}, {turn / wave.period:.3g} times a turn"


def inputs_words(force: EquationForce) -> str:
    """All inputs: "the input u", "the inputs u1, u2"."""
    return _listed(force.record.model.inputs, "input")


def _listed(names: Sequence[str], noun: str) -> str:
    plural = "s" if len(names) > 1 else ""
    return f"the {noun}{plural} {', '.join(names)}"


def _loss_words(force: EquationForce) -> str:
    """Whether the force, and it with the model's own loss, opposes the effort."""
    name = _followed(force, "dissipated")
    if not force.record.model.has_energy:
        return f"follows {name}"
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


# ---- where, as an engineer says it ---------------------------------------------------


def place_answer(force: EquationForce, is_named: bool, is_known: bool) -> Answer:
    """The equation of a force, and what it follows or else where it is largest.

    What is clearly followed comes first, a place beside it. Where nothing is followed
    a place is a detail: it would promise a cause.

    Args:
        force: the missing force.
        is_named: whether an effect is named; then nothing is said of what does not
            explain the force.
        is_known: whether effects say all that the force is; then no shares are told.
    """
    rate = f"In d{force.equation}/dt"
    called = RATES.get(force.scale.unit, "")
    if force.position and called:
        rate = f"{rate}, the {called} {force.position}"
    shares = _shares(force, is_named, is_known)
    if force.causes.clear:
        return Answer(f"{rate}. {_following(force)}.", shares)
    place = place_words(force)
    if is_named:
        return Answer(f"{rate}{f', largest {place}' if place else ''}.", shares)
    if force.pace.is_vibration:
        # Where it is large is where something shakes by chance.
        return Answer(f"{rate}, or at a sensor; it follows no state and no input.")
    is_part = any(force.causes.shares[cause] > NAMED_CAUSE for cause in CAUSES)
    explained = "explains most of it" if is_part else "explains it"
    lead = f"{rate}; no state, input or time {explained}."
    return Answer(lead, f"It is largest {place}. {shares}" if place else shares)


def _following(force: EquationForce) -> str:
    """What a force of a clear cause follows, and whether a place stands out."""
    cause = force.causes.clear
    model = force.record.model
    if cause == "constant":
        return "It is the same everywhere and at all times"
    said = f"It depends on {_followed(force, cause)}"
    if cause == "conserved":
        partners = exchange_partners(model, force.equation)
        place = "" if force.wave else place_words(force, partners)
        return f"{said}; largest {place}" if place else said
    if cause == "inputs" and force.causes.goes_together:
        either = (_followed(force, "dissipated"), inputs_words(force))
        said = f"It depends on {' or on '.join(either)}"
    positions = [model.states[row] for row in position_rows(model)]
    is_elsewhere = positions and not place_words(force, positions)
    return f"{said}, not on a place" if is_elsewhere else said


def _shares(force: EquationForce, is_named: bool, is_known: bool) -> str:
    """How much of the force each cause explains."""
    causes = force.causes
    cause = causes.clear
    # A re-fit from other values of the parameters came first, and left what is named.
    is_refitted = is_named and causes.named[:1] == ["parameters"]
    if is_refitted or not causes.named:
        return ""
    if is_known:
        # The lead has said it, but for how energy is lost and for periods.
        is_said = cause in ("inputs", "constant")
        return "" if is_said else f"It {cause_words(force, with_shares=False)}."
    if causes.goes_together and cause == "inputs":
        said = (
            f"{_share_words(force, cause)} is explained by "
            f"{_followed(force, 'dissipated')} or by {inputs_words(force)}; these data "
            "cannot separate the two."
        )
        place = place_words(force, [f"dH_d{force.equation}"])
        return f"{said} It is largest {place}." if place else said
    told = f"It {cause_words(force)}"
    if cause and len(causes.named) == 1 and told.startswith("It follows "):
        told = f"That explains {_share_words(force, causes.named[0])}"
        told += _tie_words(force)
    left = causes.shares["unexplained"]
    if left < MOSTLY:
        return f"{told}."
    return f"{told}; {100 * left:.0f} % follow nothing measured."


def place_words(force: EquationForce, names: Sequence[str] | None = None) -> str:
    """At which values of its variables a force is strong; memories are left out.

    Such as "where q is highest (above 0.7 m)"; "" where no values stand out. Without
    names the variables are those of the force's map.
    """
    names = force.map_variables if names is None else names
    memory = force.record.model.memory
    region = strong_region(force, [name for name in names if name not in memory])
    return ", and ".join(range_words(force, *found) for found in region.items())


def range_words(force: EquationForce, name: str, ranges: Sequence[StrongRange]) -> str:
    """What the ranges of a variable are among the values that it had."""
    called = plain_name(force, name)
    unit = spaced(force.unit_of(name))
    first = ranges[0]
    last = ranges[-1]
    if len(ranges) > 1 and first.is_lowest and last.is_highest:
        ends = f"below {first.end:.3g} or above {last.begin:.3g}{unit}"
        if force.position_of(name) and first.end < 0 < last.begin:
            return f"at high speed, either way ({called} {ends})"
        return f"at both ends of {called} ({ends})"
    if len(ranges) == 1 and first.is_lowest:
        return f"where {called} is lowest (below {first.end:.3g}{unit})"
    if len(ranges) == 1 and first.is_highest:
        return f"where {called} is highest (above {first.begin:.3g}{unit})"
    return f"where {called} is {' or '.join(map(str, ranges))}{unit}"


def plain_name(force: EquationForce, name: str) -> str:
    """A variable as it is called in speech: a velocity by its position.

    An effort that has the values of a state has the name of that state.
    """
    model = force.record.model
    if name not in model.efforts:
        return name
    position = force.position_of(name)
    if position:
        return f"the velocity of {position}"
    values = force.record.variable(name)
    for state in model.states:
        if np.allclose(values, force.record.variable(state)):
            return state
    return f"the effort {name}"


# ---- titles of pictures --------------------------------------------------------------


def map_title(force: EquationForce, names: Sequence[str]) -> str:
    """Where over the variables the force is strong, in a sentence."""
    begin = f"d{force.equation}/dt:"
    if force.is_uncertain:
        return f"{begin} no missing force is sure"
    place = place_words(force, names)
    if not place:
        return f"{begin} the missing force acts all over the visited states"
    return f"{begin} the missing force is strong {place}"


def dependence_title(force: EquationForce, variable: str) -> str:
    """Whether the force follows the variable, in a sentence."""
    equation = f"d{force.equation}/dt"
    if force.is_uncertain:
        return f"{equation}: no missing force is sure"
    share = max(force.share_of(variable), 0.0)
    predicted = f"predicts {100 * share:.0f} % of it"
    if share >= CLEAR_PATTERN:
        return f"The force in {equation} follows {variable}, which {predicted}"
    if force.is_constant:
        begin = f"The force in {equation} is constant; what varies hardly follows"
        return f"{begin} {variable}"
    return (
        f"The force in {equation} follows no single variable clearly: the best, "
        f"{variable}, {predicted}"
    )
