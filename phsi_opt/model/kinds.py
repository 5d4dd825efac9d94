"""The kind of a state: mechanical, hydraulic, electrical or thermal.

It decides which effects the catalogue offers and what they are called. A model says it;
where it does not, the unit of the measured state may tell. Volts tell nothing by
themselves: the sensors of tanks, speeds and positions give them too.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from phsi_opt.arguments import require_known
from phsi_opt.presentation.units import are_alike

MECHANICAL = "mechanical"
HYDRAULIC = "hydraulic"
ELECTRICAL = "electrical"
THERMAL = "thermal"
KINDS = (MECHANICAL, HYDRAULIC, ELECTRICAL, THERMAL)

# The kinds of quantities in units such as these; J is heat, and N m a torque.
OF_DIMENSIONS = {
    MECHANICAL: ("m", "rad", "m/s", "rad/s", "N", "N*m", "N*s", "N*m*s"),
    HYDRAULIC: ("Pa", "m^3", "m^3/s"),
    ELECTRICAL: ("A", "C", "A*s", "Wb"),
    THERMAL: ("K",),
}
# Angles by their unit as radians.
RADIANS = {"rad": "{q}", "mrad": "{q}/1000", "rev": "2*pi*{q}"}
RADIANS |= dict.fromkeys(("deg", "°"), "pi*{q}/180")
# The zero of temperatures that count from elsewhere, in degrees of their own.
ZEROS = {"degC": 273.15, "°C": 273.15, "degF": 459.67, "°F": 459.67}


def checked_kinds(
    kind: Any, states: Sequence[str], memory: Sequence[str]
) -> Mapping[str, str]:
    """The kind of each state of which it is told, in the order of the states.

    Args:
        kind: one for all states, or by state.
        states: of the model.
        memory: those that are an effect's memory; they are of no kind.

    Raises:
        ModelError: a kind that there is not, or a state that the model does not have.
    """
    told = kind
    if isinstance(kind, str):
        told = {name: kind for name in states if name not in memory}
        require_known(kind, KINDS, f"kind {kind!r} is unknown")
    for name, one in told.items():
        said = f"kind of {name!r}, which is not a state of the model"
        require_known(name, states, said)
        require_known(one, KINDS, f"kind of {name!r}: {one!r} is unknown")
    ordered = {name: told[name] for name in states if name in told}
    return MappingProxyType(ordered)


def kind_of_unit(unit: str) -> str:
    """The kind of what has the unit; "" where it does not tell.

    A length is a body's position; that of a tank's level is for the model to say.
    """
    for kind, units in OF_DIMENSIONS.items():
        for one in units:
            if are_alike(unit, one):
                is_heat = one == "N*m" and "N" not in unit
                return THERMAL if is_heat else kind
    return ""
