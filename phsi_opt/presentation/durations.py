"""Times as people say them: hours and days where seconds would run into thousands."""

import datetime as dt
from dataclasses import dataclass

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
