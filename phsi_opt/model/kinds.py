"""The kind of a state: mechanical, hydraulic, electrical or thermal.

It decides which effects the catalogue offers and what they are called. A model says it;
where it does not, the unit of the measured state may tell. Volts tell nothing by
themselves: the sensors of tanks, speeds and positions give them too.
"""

from collections.abc import Mapping, Sequence
from math import pi
from types import MappingProxyType
from typing import Any

from phsi_opt.arguments import require_known
from phsi_opt.errors import ModelError

MECHANICAL = "mechanical"
HYDRAULIC = "hydraulic"
ELECTRICAL = "electrical"
THERMAL = "thermal"
KINDS = (MECHANICAL, HYDRAULIC, ELECTRICAL, THERMAL)

PREFIXES = ("", *"nuµmcdkMG")
LENGTHS = frozenset(f"{prefix}m" for prefix in PREFIXES)
# Angles by their unit as radians.
RADIANS = {"rad": "{q}", "mrad": "{q}/1000", "rev": "2*pi*{q}"}
RADIANS |= dict.fromkeys(("deg", "°"), "pi*{q}/180")
# A whole turn in these units.
TURN = {"rad": 2 * pi, "mrad": 2000 * pi, "rev": 1.0, "deg": 360.0, "°": 360.0}
VOLTS = frozenset(f"{prefix}V" for prefix in PREFIXES)
# Units that take a prefix, and those that do not; spaces and signs of products are left
# out, and powers written m3.
WITH_PREFIX = {
    MECHANICAL: "rad m/s rad/s N Nm Ns Nms",
    HYDRAULIC: "Pa bar L l L/s l/s L/min l/min",
    ELECTRICAL: "A C Wb Ah",
    THERMAL: "K J",
}
WITHOUT_PREFIX = {
    MECHANICAL: "deg ° rev deg/s °/s rev/s rpm m/min km/h kgm/s kgm2/s gm/s",
    HYDRAULIC: "m3 m3/s m3/h cm3 dm3 mm3 cm3/s psi mH2O",
    ELECTRICAL: "Vs",
    THERMAL: "degC °C degF °F kWh Wh",
}
# Temperatures that count from elsewhere than absolute zero.
# Their zero on the absolute scale of the same degrees.
ZEROS = {"degC": 273.15, "°C": 273.15, "degF": 459.67, "°F": 459.67}
TEMPERATURES = frozenset({*ZEROS, "K"})
PLAIN_SIGNS = str.maketrans("²³", "23", "^*· ")


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
    if not isinstance(told, Mapping):
        raise ModelError(
            f"kind={kind!r} must be one of {', '.join(KINDS)}, "
            "or map states to these, such as {'T1': 'thermal'}."
        )
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
    written = plain_unit(unit)
    if written in LENGTHS:
        return MECHANICAL
    for kind in KINDS:
        if written in WITHOUT_PREFIX[kind].split():
            return kind
    for kind in KINDS:
        units = WITH_PREFIX[kind].split()
        for one in units:
            if written.endswith(one) and written.removesuffix(one) in PREFIXES:
                return kind
    return ""


def plain_unit(unit: str) -> str:
    """The unit without spaces, signs of products and raised digits: m³ is m3."""
    return unit.translate(PLAIN_SIGNS)
