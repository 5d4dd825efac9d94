"""What a state does in its field, and the words of that field.

A role follows from a state's kind and from its place in a canonical pair. It decides
which effects the catalogue offers for the state's equation and what they are called: a
linear leak, a linear resistance and viscous damping are one term.
"""

from enum import StrEnum

from phsi_opt.model.base import BaseModel
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC, MECHANICAL, THERMAL
from phsi_opt.model.structure import kind_of, position_of_momentum


class Role(StrEnum):
    """What a state is."""

    BODY = "a momentum or speed"
    PIPE = "a flow with inertia: the momentum of a hydraulic pair"
    TANK = "a level, a volume or a pressure"
    COIL = "a flux: the momentum of an electrical pair"
    CAPACITOR = "a charge: the position of an electrical pair"
    CIRCUIT = "a charge, flux, current or voltage, it is not known which"
    HEAT = "a temperature or heat"
    UNKNOWN = "a speed or a storage of an unknown kind"


# What comes from outside, such as a force, and what a loss grows with.
WORDS = {
    Role.BODY: ("force", "speed"),
    Role.PIPE: ("pressure", "the flow"),
    Role.TANK: ("inflow", "the level"),
    Role.COIL: ("voltage", "the current"),
    Role.CAPACITOR: ("current", "the voltage"),
    Role.CIRCUIT: ("source", "the current or voltage"),
    Role.HEAT: ("heat input", "the temperature"),
    Role.UNKNOWN: ("force", "the speed or level"),
}
OF_MOMENTA = {MECHANICAL: Role.BODY, HYDRAULIC: Role.PIPE, ELECTRICAL: Role.COIL}
OF_OTHERS = {
    MECHANICAL: Role.BODY,
    HYDRAULIC: Role.TANK,
    ELECTRICAL: Role.CIRCUIT,
    THERMAL: Role.HEAT,
    "": Role.UNKNOWN,
}


def role_of(model: BaseModel, state: str) -> Role:
    """The role of a state in whose equation a force may be missing."""
    kind = kind_of(model, state)
    pairs = position_of_momentum(model)
    if state in pairs:
        return OF_MOMENTA[kind]
    if kind == ELECTRICAL and state in pairs.values():
        return Role.CAPACITOR
    return OF_OTHERS[kind]
