"""Units of a missing force and its frequency, as labels and sentences print them."""

from collections.abc import Mapping

from phsi_opt.presentation.units import rate_unit


def frequency_unit(units: Mapping[str, str]) -> str:
    """Hz where the time is in seconds, else cycles per unit of time."""
    time = units.get("t", "")
    if time == "s":
        return "Hz"
    return f"cycles per {time or 'unit of time'}"


def force_unit(equation: str, units: Mapping[str, str]) -> str:
    """Unit of the missing force of an equation, "" where units are not known."""
    return rate_unit(units.get(equation, ""), units.get("t", ""))


def spaced(unit: str) -> str:
    """The unit with a space before it, or nothing."""
    return f" {unit}" if unit else ""
