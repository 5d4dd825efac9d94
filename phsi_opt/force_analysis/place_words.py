"""Where a missing force acts, as an engineer says it: at high speed, at both ends.

The tables and sentences of an analysis list ranges of variables; here a range says what
it is among the values that occurred, and a velocity has no symbol.
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN, NAMED_CAUSE
from phsi_opt.force_analysis.cause_words import (
    cause_words,
    effort_words,
    followed_words,
    inputs_words,
    share_words,
    tie_words,
)
from phsi_opt.force_analysis.causes import CAUSES
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import StrongRange, strong_region
from phsi_opt.force_analysis.state_plots import map_variables
from phsi_opt.force_analysis.units import spaced
from phsi_opt.model.model import FirstOrder
from phsi_opt.model.structure import exchange_partners, position_rows
from phsi_opt.presentation.content import Answer

# What the rate of a momentum or a velocity is called, by its unit.
RATES = {
    "N": "force on",
    "N m": "torque on",
    "m/s^2": "acceleration of",
    "rad/s^2": "acceleration of",
}
MOSTLY = 0.5  # share of a force's mean square that is most of it


def place_answer(force: EquationForce, is_named: bool, is_known: bool) -> Answer:
    """The equation of a force, and what it follows or else where it is largest.

    What is clearly followed comes first, a place beside it. Where nothing is followed
    a place is a detail: it would promise a cause.

    Args:
        is_named: whether an effect is named; then nothing is said of what does not
            explain the force.
        is_known: whether effects say all that the force is; then no shares are told.
    """
    rate = _rate_words(force)
    shares = _shares(force, is_named, is_known)
    if _clear_cause(force):
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


def _rate_words(force: EquationForce) -> str:
    """The equation, and what its rate is: "In dp/dt, the force on q"."""
    rate = f"In d{force.equation}/dt"
    called = RATES.get(force.scale.unit, "")
    is_told = force.position and called
    return f"{rate}, the {called} {force.position}" if is_told else rate


def _clear_cause(force: EquationForce) -> str:
    """The cause that the force clearly follows; "" where there is none."""
    shares = force.causes.shares
    strongest = max(CAUSES, key=shares.__getitem__)
    return strongest if shares[strongest] >= CLEAR_PATTERN else ""


def _following(force: EquationForce) -> str:
    """What a force of a clear cause follows, and that no place stands out."""
    cause = _clear_cause(force)
    model = force.record.model
    if cause == "conserved":
        said = f"It depends on {followed_words(force)}"
        partners = exchange_partners(model, force.equation)
        place = "" if force.wave else place_words(force, partners)
        return f"{said}; largest {place}" if place else said
    if cause == "constant":
        return "It is the same everywhere and at all times"
    if cause == "dissipated" and isinstance(model, FirstOrder):
        return f"It follows {force.equation} itself"
    on = {
        "time": "the time",
        "inputs": inputs_words(force),
        "dissipated": effort_words(force),
    }
    said = f"It depends on {on[cause]}"
    if cause == "inputs" and force.causes.goes_together:
        said = f"It depends on {on['dissipated']} or on {on['inputs']}"
    positions = [model.states[row] for row in position_rows(model)]
    if not positions or place_words(force, positions):
        return said
    return f"{said}, not on a place"


def _shares(force: EquationForce, is_named: bool, is_known: bool) -> str:
    """How much of the force each cause explains."""
    causes = force.causes
    cause = _clear_cause(force)
    # A re-fit from other values of the parameters came first, and left what is named.
    is_refitted = is_named and causes.named[:1] == ["parameters"]
    if is_refitted or not causes.named:
        return ""
    if is_known:
        # The lead has said it, but for how energy is lost and for periods.
        is_said = cause in ("inputs", "constant")
        return "" if is_said else f"It {cause_words(force, with_shares=False)}."
    if causes.goes_together and cause == "inputs":
        return _together(force)
    told = f"It {cause_words(force)}"
    if cause and len(causes.named) == 1 and told.startswith("It follows "):
        share = share_words(force, causes.named[0])
        told = f"That explains {share}{tie_words(force)}"
    left = causes.shares["unexplained"]
    if left < MOSTLY:
        return f"{told}."
    return f"{told}; {100 * left:.0f} % follow nothing measured."


def _together(force: EquationForce) -> str:
    """That input and velocity go together, with what either explains."""
    said = (
        f"{share_words(force, 'inputs')} is explained by {effort_words(force)} or by "
        f"{inputs_words(force)}; these data cannot separate the two."
    )
    place = place_words(force, [f"dH_d{force.equation}"])
    return f"{said} It is largest {place}." if place else said


def place_words(force: EquationForce, names: Sequence[str] | None = None) -> str:
    """At which values of its variables a force is strong; memories are left out.

    Such as "where q is highest (above 0.7 m)"; "" where no values stand out. Without
    names the variables are those of the force's map.
    """
    names = map_variables(force) if names is None else names
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
    values = force.record.variable(name)
    for state in model.states:
        if np.allclose(values, force.record.variable(state)):
            return state
    position = force.position_of(name)
    return f"the velocity of {position}" if position else f"the effort {name}"
