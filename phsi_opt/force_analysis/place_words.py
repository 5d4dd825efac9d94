"""Where a missing force acts, as an engineer says it: at high speed, at both ends.

The tables and sentences of an analysis list ranges of variables; here a range says what
it is among the values that occurred, and a velocity has no symbol.
"""

import numpy as np

from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import StrongRange, strong_ranges
from phsi_opt.force_analysis.state_plots import map_variables
from phsi_opt.force_analysis.units import force_unit, spaced
from phsi_opt.model.structure import position_of_momentum

ALIKE = "for all values of the states alike"
AT_THE_ENDS = 2  # ranges at both ends of what occurred


def place_words(force: EquationForce) -> str:
    """At which values of its variables a force is strong; memories are left out."""
    memory = force.record.fit.model.memory
    told = []
    for name in map_variables(force):
        if name not in memory:
            ranges = strong_ranges(force.record.variable(name), force.w)
            if ranges:
                told.append(range_words(force, name, ranges))
    return ", and ".join(told) or ALIKE


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
