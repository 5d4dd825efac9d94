"""Where a missing force acts, as an engineer says it: at high speed, at both ends.

The tables and sentences of an analysis list ranges of variables; here a range says what
it is among the values that occurred, and a velocity has no symbol.
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN, NAMED_CAUSE
from phsi_opt.force_analysis.causes import CAUSES
from phsi_opt.force_analysis.energy_wording import (
    NO_PATTERN,
    OTHER_VALUES,
    TOGETHER,
    effort_words,
    followed_words,
    listed,
)
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import StrongRange, strong_ranges
from phsi_opt.force_analysis.state_plots import map_variables
from phsi_opt.force_analysis.units import force_unit, spaced
from phsi_opt.model.model import FirstOrder
from phsi_opt.model.structure import (
    exchange_partners,
    position_of_momentum,
    position_rows,
)
from phsi_opt.presentation.report_content import Answer

# What the rate of a momentum or a velocity is called, by its unit.
RATES = {
    "N": "force on",
    "N m": "torque on",
    "m/s^2": "acceleration of",
    "rad/s^2": "acceleration of",
}
MOSTLY = 0.5  # share of a force's mean square that is most of it
FOLLOWS = "follows "
SHARE_BEGINS = ", which explains "  # behind what a force follows
AT_THE_ENDS = 2  # ranges at both ends of what occurred


def place_answer(force: EquationForce, is_named: bool, is_known: bool) -> Answer:
    """The equation of a force, and what it follows or else where it is largest.

    What is clearly followed comes first, a place beside it. Where nothing is followed
    a place is a detail: it would promise a cause.

    Args:
        force: that is missing.
        is_named: whether an effect is named; then nothing is said of what does not
            explain the force.
        is_known: whether effects say all that the force is; then no shares are told.
    """
    cause = _clear_cause(force)
    rate = rate_words(force)
    place = place_words(force)
    largest = f", largest {place}" if place else ""
    if cause:
        return Answer(
            f"{rate}. {_following(force, cause)}.", _shares(force, is_named, is_known)
        )
    if is_named:
        return Answer(f"{rate}{largest}.", _shares(force, is_named, is_known))
    is_part = any(float(force.shares[kind]) > NAMED_CAUSE for kind in CAUSES)
    explained = "explains most of it" if is_part else "explains it"
    if force.pace.is_vibration:
        # Where it is large is where something shakes by chance.
        return Answer(f"{rate}, or at a sensor; it follows no state and no input.")
    lead = f"{rate}; no state, input or time {explained}."
    shares = _shares(force, is_named, is_known)
    return Answer(lead, f"It is largest {place}. {shares}" if place else shares)


def rate_words(force: EquationForce) -> str:
    """The equation, and what its rate is: "In dp/dt, the force on q"."""
    rate = f"In d{force.equation}/dt"
    position = position_of_momentum(force.record.fit.model).get(force.equation, "")
    called = RATES.get(force.scale.unit, "")
    return f"{rate}, the {called} {position}" if position and called else rate


def _clear_cause(force: EquationForce) -> str:
    """The kind of cause that the force clearly follows; "" where there is none."""
    strongest = max(CAUSES, key=lambda kind: float(force.shares[kind]))
    is_clear = float(force.shares[strongest]) >= CLEAR_PATTERN
    return strongest if is_clear else ""


def _following(force: EquationForce, cause: str) -> str:
    """What a force of a clear cause follows, and that no place stands out."""
    model = force.record.fit.model
    effort = effort_words(model, force.equation)
    if cause == "conserved":
        return _exchanged(force)
    if cause == "constant":
        return "It is the same everywhere and at all times"
    if cause == "time":
        said = "It depends on the time"
    elif cause == "inputs":
        inputs = listed(model.inputs, "input")
        said = f"It depends on {inputs}"
        if TOGETHER in force.cause:
            said = f"It depends on {effort} or on {inputs}"
    elif isinstance(model, FirstOrder):
        return f"It follows {force.equation} itself"
    else:
        said = f"It depends on {effort}"
    if not position_of_momentum(model):
        return said
    positions = [model.states[row] for row in position_rows(model)]
    return said if place_words(force, positions) else f"{said}, not on a place"


def _exchanged(force: EquationForce) -> str:
    """What a force that stores energy depends on, and where that is strong."""
    followed = followed_words(force.record, force.equation, force.wave)
    said = f"It depends on {followed}"
    if force.wave is not None:
        return said
    partners = exchange_partners(force.record.fit.model, force.equation)
    place = place_words(force, partners)
    return f"{said}; largest {place}" if place else said


def _shares(force: EquationForce, is_named: bool, is_known: bool) -> str:
    """How much of the force each cause explains."""
    cause = _clear_cause(force)
    if is_named and force.cause.startswith(OTHER_VALUES):
        return ""  # a re-fit from there came first, and left what is named
    if is_known:
        # The lead has said it, but for how energy is lost and for periods.
        is_said = cause in ("inputs", "constant")
        is_said = is_said or force.cause == NO_PATTERN
        said = "" if is_said else force.cause_in_brief
    elif TOGETHER in force.cause and cause == "inputs":
        return _together(force)
    else:
        said = "" if force.cause == NO_PATTERN else force.cause
    left = float(force.shares["unexplained"])
    if not said:
        return ""
    follows, is_told, share = said.partition(SHARE_BEGINS)
    is_said = bool(cause and is_told) and follows.startswith(FOLLOWS)
    is_said = is_said and ", and " not in share
    told = f"That explains {share}" if is_said else f"It {said}"
    if is_known or left < MOSTLY:
        return f"{told}."
    return f"{told}; {100 * left:.0f} % follow nothing measured."


def _together(force: EquationForce) -> str:
    """That input and velocity go together, with what either explains."""
    model = force.record.fit.model
    effort = effort_words(model, force.equation)
    inputs = listed(model.inputs, "input")
    share = 100 * float(force.shares["inputs"])
    said = (
        f"{share:.0f} % of it is explained by {effort} or by {inputs}; these data "
        "cannot separate the two."
    )
    place = place_words(force, [f"dH_d{force.equation}"])
    return f"{said} It is largest {place}." if place else said


def place_words(force: EquationForce, names: Sequence[str] | None = None) -> str:
    """At which values of its variables a force is strong; memories are left out.

    Args:
        force: that is missing.
        names: of the variables; None: those of the force's map.

    Returns:
        Such as "where q is highest (above 0.7 m)"; "" where no values stand out.
    """
    memory = force.record.fit.model.memory
    told = []
    for name in map_variables(force) if names is None else names:
        if name not in memory:
            ranges = strong_ranges(force.record.variable(name), force.w)
            if ranges:
                told.append(range_words(force, name, ranges))
    return ", and ".join(told)


def plain_name(force: EquationForce, name: str) -> str:
    """A variable as it is called in speech: a velocity by its position.

    An effort that has the values of a state has the name of that state.
    """
    model = force.record.fit.model
    if name not in model.efforts:
        return name
    values = force.record.variable(name)
    for state in model.states:
        if np.allclose(values, force.record.variable(state)):
            return state
    position = _position_of(force, name)
    return f"the velocity of {position}" if position else f"the effort {name}"


def range_words(force: EquationForce, name: str, ranges: list[StrongRange]) -> str:
    """What the ranges of a variable are among the values that it had."""
    called = plain_name(force, name)
    unit = _unit_of(force, name)
    if len(ranges) == AT_THE_ENDS and ranges[0].is_lowest and ranges[1].is_highest:
        ends = f"below {ranges[0].end:.3g} or above {ranges[1].begin:.3g}{unit}"
        if _position_of(force, name) and ranges[0].end < 0 < ranges[1].begin:
            return f"at high speed, either way ({called} {ends})"
        return f"at both ends of {called} ({ends})"
    if len(ranges) > 1:
        listed = " or ".join(map(str, ranges))
        return f"where {called} is {listed}{unit}"
    (only,) = ranges
    if only.is_lowest:
        return f"where {called} is lowest (below {only.end:.3g}{unit})"
    if only.is_highest:
        return f"where {called} is highest (above {only.begin:.3g}{unit})"
    return f"where {called} is {only}{unit}"


def _position_of(force: EquationForce, effort: str) -> str:
    """The position whose velocity an effort is; "" for other variables."""
    model = force.record.fit.model
    if effort not in model.efforts:
        return ""
    state = model.states[model.efforts.index(effort)]
    return position_of_momentum(model).get(state, "")


def _unit_of(force: EquationForce, name: str) -> str:
    """Unit of a variable behind a space; of a velocity, that of a position by time."""
    units = force.record.units
    position = _position_of(force, name)
    if position:
        return spaced(force_unit(position, units))
    return spaced(units.get(name, ""))
