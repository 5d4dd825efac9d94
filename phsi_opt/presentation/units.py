"""Units as people write them: N in place of kg m/s/s.

Only units without a prefix are put together, as "mm" or "kN" would need a factor. "C"
stays as it is: it is coulomb to one and degree Celsius to another.
"""

import re
from collections import Counter
from collections.abc import Mapping

# Units in powers of the base units.
KNOWN: Mapping[str, Mapping[str, int]] = {
    "kg": {"kg": 1},
    "m": {"m": 1},
    "s": {"s": 1},
    "A": {"A": 1},
    "K": {"K": 1},
    "rad": {"rad": 1},
    "Hz": {"s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "Wb": {"kg": 1, "m": 2, "s": -2, "A": -1},
    "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
}
# What a rate is called where its powers are these.
NAMED: Mapping[str, Mapping[str, int]] = {
    "N": KNOWN["N"],
    "N m": {"kg": 1, "m": 2, "s": -2},
    "N m/rad": {"kg": 1, "m": 2, "s": -2, "rad": -1},
    "N/s": {"kg": 1, "m": 1, "s": -3},
    "W": KNOWN["W"],
    "V": KNOWN["V"],
    "A": {"A": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s^2": {"m": 1, "s": -2},
    "m^3/s": {"m": 3, "s": -1},
    "kg/s": {"kg": 1, "s": -1},
    "K/s": {"K": 1, "s": -1},
    "rad/s": {"rad": 1, "s": -1},
    "rad/s^2": {"rad": 1, "s": -2},
    "1/s": {"s": -1},
}
# A factor such as "m", "s^2", "m2" or "s**-1"; between two, blanks, "*", "." or "·".
FACTOR = re.compile(r"([A-Za-z]+)(?:(?:\^|\*\*)?(-?\d))?$")
FACTOR_SEPARATORS = re.compile(r"(?<!\*)\*(?!\*)|[\s.·]+")


def rate_unit(unit: str, unit_of_time: str) -> str:
    """Unit of a rate of change, "" where one of the two units is not known."""
    if not unit or not unit_of_time:
        return ""
    powers = powers_of(unit)
    of_time = powers_of(unit_of_time)
    if powers is not None and of_time is not None:
        powers.subtract(of_time)
        for name, known in NAMED.items():
            if _without_zeros(powers) == known:
                return name
    if " " in unit or "/" in unit:
        return f"({unit})/{unit_of_time}"
    return f"{unit}/{unit_of_time}"


def powers_of(unit: str) -> Counter[str] | None:
    """Powers of the base units in a unit such as "kg m/s"; None: it is not known."""
    powers: Counter[str] = Counter()
    for place, part in enumerate(unit.replace("(", "").replace(")", "").split("/")):
        sign = 1 if place == 0 else -1
        for factor in FACTOR_SEPARATORS.split(part.strip()):
            found = FACTOR.match(factor)
            if factor == "1":
                continue
            if found is None or found[1] not in KNOWN:
                return None
            exponent = sign * int(found[2] or 1)
            for base, power in KNOWN[found[1]].items():
                powers[base] += exponent * power
    return powers


def _without_zeros(powers: Mapping[str, int]) -> dict[str, int]:
    kept = {}
    for base, power in powers.items():
        if power:
            kept[base] = power
    return kept
