"""Units of a missing force and its frequency, as labels and sentences print them."""

from collections.abc import Mapping
from dataclasses import dataclass

from phsi_opt.presentation.durations import SECONDS, scale_of_time, time_words
from phsi_opt.presentation.units import NAMED_RATES, rate_unit


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


@dataclass(frozen=True)
class RateScale:
    """A unit in which a rate is told, and how many of its own unit that is."""

    unit: str
    size: float = 1.0


def scale_of_rate(equation: str, units: Mapping[str, str], longest: float) -> RateScale:
    """A rate per hour where a record of seconds lasts for hours: degC/h.

    Rates with a name of their own (N, m/s) and other units of time stay; ``longest`` is
    the last time of the record.
    """
    unit = force_unit(equation, units)
    in_seconds = scale_of_time(longest, units.get("t", "")).size >= SECONDS["h"]
    if not in_seconds or unit != f"{units.get(equation, '')}/s" or unit in NAMED_RATES:
        return RateScale(unit)
    return RateScale(rate_unit(units[equation], "h"), 1 / SECONDS["h"])


def spaced(unit: str) -> str:
    """The unit with a space before it, or nothing."""
    return f" {unit}" if unit else ""
