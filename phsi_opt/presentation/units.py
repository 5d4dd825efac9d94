"""Units and times as people write them: N in place of kg m/s/s, hours, dates.

Only units without a prefix are put together, as "mm" or "kN" would need a factor. "C"
stays as it is: it is coulomb to one and degree Celsius to another.
"""

import datetime as dt
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

# Powers of units, by their names.
Powers = Mapping[str, float]
RADIAN = "rad"
STANDARD_DEVIATIONS = "standard deviations"  # unit of errors in several channels
BASE_UNITS = ("kg", "m", "s", "A", "K", RADIAN)
# What others are in these.
DERIVED = {
    "Hz": "1/s",
    "N": "kg m/s^2",
    "Pa": "kg/(m s^2)",
    "J": "kg m^2/s^2",
    "W": "kg m^2/s^3",
    "V": "kg m^2/(A s^3)",
    "Wb": "kg m^2/(A s^2)",
    "Ohm": "kg m^2/(A^2 s^3)",
}
# What a rate is called where it has the powers of one of these.
NAMED_RATES = (
    *("N", "N m", "N m/rad", "N/s", "W", "V", "A", "m/s", "m/s^2", "m^3/s", "kg/s"),
    *("K/s", "rad/s", "rad/s^2", "1/s"),
)
OF_MECHANICS = frozenset({"kg", "m", "s", RADIAN})
# A unit of any name with its power, such as "m", "s^2", "m2" or "s**-1"; between two,
# blanks, "*", "." or "·".
FACTOR = re.compile(r"([A-Za-z%\u00b0\u00b5]+)(?:(?:\^|\*\*)?(-?\d))?$")
FACTOR_SEPARATORS = re.compile(r"(?<!\*)\*(?!\*)|[\s.·]+")


def scale_of_errors(unit: str) -> tuple[float, str]:
    """A factor on errors and the unit that they then have.

    Those of several channels are told in percent of what was measured.
    """
    if unit == STANDARD_DEVIATIONS:
        return 100.0, "% of the standard deviation"
    return 1.0, unit


def rate_unit(unit: str, unit_of_time: str) -> str:
    """Unit of a rate of change, "" where one of the two units is not known."""
    if not unit or not unit_of_time:
        return ""
    written = powers_as_written(unit)
    below = powers_as_written(unit_of_time)
    if written is not None and below is not None:
        powers = product(written, below, -1)
        if set(powers) <= set(KNOWN):
            basic = _in_base_units(powers)
            for name in NAMED_RATES:
                if basic == powers_in_base_units(name):
                    return name
        return _written(powers)
    if " " in unit or "/" in unit:
        return f"({unit})/{unit_of_time}"
    return f"{unit}/{unit_of_time}"


def product(first: Powers, second: Powers, power: float = 1.0) -> Powers:
    """The powers in first * second**power; none that are zero."""
    total = dict(first)
    for name, exponent in second.items():
        total[name] = total.get(name, 0.0) + power * exponent
    return {name: exponent for name, exponent in total.items() if exponent}


def powers_as_written(unit: str) -> Powers | None:
    """Powers of the units as they are written, of any name; None: not readable."""
    powers: Powers = {}
    for place, part in enumerate(unit.replace("(", "").replace(")", "").split("/")):
        sign = 1 if place == 0 else -1
        for factor in FACTOR_SEPARATORS.split(part.strip()):
            found = FACTOR.match(factor)
            if factor == "1":
                continue
            if found is None:
                return None
            powers = product(powers, {found[1]: int(found[2] or 1)}, sign)
    return powers


KNOWN: Mapping[str, Powers] = {
    **{name: {name: 1.0} for name in BASE_UNITS},
    **{name: powers_as_written(unit) or {} for name, unit in DERIVED.items()},
}


def powers_in_base_units(unit: str) -> Powers | None:
    """The same in base units, those that are not known as they are written."""
    written = powers_as_written(unit)
    return None if written is None else _in_base_units(written)


def _in_base_units(written: Powers) -> Powers:
    powers: Powers = {}
    for name, n in written.items():
        powers = product(powers, KNOWN.get(name, {name: 1}), n)
    return powers


def coefficient_unit(powers: Powers, named: Sequence[str] = ()) -> str:
    """The unit of a coefficient as people write it: N s/m, kg m^2, degC/h.

    Args:
        powers: of units.
        named: units that are kept as they are written where the powers are theirs.
    """
    basic = _in_base_units(powers)
    for unit in named:
        if unit and powers_in_base_units(unit) == basic:
            return unit
    if set(powers) - set(KNOWN) or len(powers) == 1:
        return _written(powers)
    if basic.get("kg") and set(basic) <= OF_MECHANICS:
        return _mechanical(basic)
    for unit, known in KNOWN.items():
        if basic == known:
            return unit
    return _written(powers)


def _mechanical(basic: Powers) -> str:
    """By newtons, but for a mass (kg) and an inertia (kg m^2)."""
    powers = dict(basic)
    angle = powers.get(RADIAN, 0)
    if angle > 0:
        del powers[RADIAN]
    is_mass = powers["kg"] == 1 and "s" not in powers and powers.get("m", 0) >= 0
    if is_mass and angle >= -1:
        powers.pop(RADIAN, None)  # an inertia is kg m^2, whatever its angle is told in
        return _written(powers)
    force = powers.pop("kg")
    powers["N"] = force
    powers["m"] = powers.get("m", 0) - force
    powers["s"] = powers.get("s", 0) + 2 * force
    return _written(powers)


def _written(powers: Powers) -> str:
    above = [_factor(name, power) for name, power in _sorted(powers) if power > 0]
    below = [_factor(name, -power) for name, power in _sorted(powers) if power < 0]
    if not below:
        return " ".join(above)
    under = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return f"{' '.join(above) or '1'}/{under}"


def _sorted(powers: Powers) -> list[tuple[str, float]]:
    """Force and mass first, then length, time, angle; others before them."""
    order = ("N", "kg", "m", "s", RADIAN)
    known = [(name, powers[name]) for name in order if name in powers]
    others = [(name, one) for name, one in powers.items() if name not in order]
    return [*sorted(others), *known]


def _factor(name: str, power: float) -> str:
    return name if power == 1 else f"{name}^{power:.4g}"


# ---- times: hours and days where seconds would run into thousands -------------------

SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}  # of the units that are told anew


@dataclass(frozen=True)
class Scale:
    """A unit in which something is told, and how many of the user's unit it has."""

    unit: str
    size: float = 1.0


# Seconds from which on times are told in a unit, the largest first.
LEAST_SECONDS = (
    (2 * 86400.0, Scale("days", 86400.0)),
    (3 * 3600.0, Scale("h", 3600.0)),
    (1800.0, Scale("min", 60.0)),
)


def scale_of_time(longest: float, unit: str) -> Scale:
    """The unit in which times up to the longest are told: days for 200 h.

    None smaller than the user's; other units than s, min and h stay.
    """
    size = SECONDS.get(unit, 0.0)
    for least, scale in LEAST_SECONDS:
        if size and abs(longest) * size >= least and scale.size > size:
            return Scale(scale.unit, scale.size / size)
    return Scale(unit)


def time_words(t: float, unit: str, longest: float = 0.0) -> str:
    """A time or a period with its unit, such as "23.9 h" for 86 200 s.

    Args:
        t: in the user's unit, as is ``longest``, a time that is told in the same unit.
        unit: the user's.
        longest: such as the end of the record.
    """
    scale = scale_of_time(max(abs(t), longest), unit)
    return f"{t / scale.size:.3g} {scale.unit}".rstrip()


def times_words(begin: float, end: float, unit: str, longest: float = 0.0) -> str:
    """A range of times with its unit, such as "4 to 5 s"; as `time_words`."""
    scale = scale_of_time(max(abs(begin), abs(end), longest), unit)
    return f"{begin / scale.size:.3g} to {end / scale.size:.3g} {scale.unit}".rstrip()


def date_words(t: float, origin: dt.datetime | None, span: float = 0.0) -> str:
    """The moment of a time in seconds: "2021-11-22 06:30"; "" without an origin.

    Args:
        t: the time.
        origin: the moment at which the time is 0.
        span: seconds of which the moment is a part; it is told as exactly as they ask.
    """
    if origin is None:
        return ""
    moment = origin + dt.timedelta(seconds=round(t))
    if span >= 86400:  # a day
        return f"{moment:%Y-%m-%d}"
    if span >= 600:  # of many minutes seconds say nothing
        return f"{moment:%Y-%m-%d %H:%M}"
    return f"{moment:%Y-%m-%d %H:%M:%S}".removesuffix(":00")


def dates_words(first: float, last: float, origin: dt.datetime | None) -> str:
    """The moments of a range of times in seconds; "" without an origin."""
    if origin is None:
        return ""
    begin = date_words(first, origin, last - first)
    end = date_words(last, origin, last - first)
    day, _, clock = end.partition(" ")
    return f"{begin} to {clock if clock and begin.startswith(day) else end}"


# ---- of a missing force and its frequency --------------------------------------------


def frequency_unit(units: Mapping[str, str]) -> str:
    """Hz where the time is in seconds, else cycles per unit of time."""
    time = units.get("t", "")
    if time == "s":
        return "Hz"
    return f"cycles per {time or 'unit of time'}"


def frequency_words(frequency: float, units: Mapping[str, str]) -> str:
    """A frequency; its period where that is told in minutes, hours or days."""
    unit = units.get("t", "")
    is_long = unit != "s" and unit in SECONDS
    if is_long or scale_of_time(1 / frequency, unit).size > 1.0:
        return f"with a period of {time_words(1 / frequency, unit)}"
    return f"at {frequency:.3g} {frequency_unit(units)}"


def force_unit(equation: str, units: Mapping[str, str]) -> str:
    """Unit of the missing force of an equation, "" where units are not known."""
    return rate_unit(units.get(equation, ""), units.get("t", ""))


def scale_of_rate(equation: str, units: Mapping[str, str], longest: float) -> Scale:
    """A rate per hour where a record of seconds lasts for hours: degC/h.

    Rates with a name of their own (N, m/s) and other units of time stay; ``longest`` is
    the last time of the record.
    """
    unit = force_unit(equation, units)
    in_seconds = scale_of_time(longest, units.get("t", "")).size >= SECONDS["h"]
    if not in_seconds or unit != f"{units.get(equation, '')}/s" or unit in NAMED_RATES:
        return Scale(unit)
    return Scale(rate_unit(units[equation], "h"), 1 / SECONDS["h"])


def spaced(unit: str) -> str:
    """The unit with a space before it, or nothing."""
    return f" {unit}" if unit else ""
