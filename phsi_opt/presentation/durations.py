"""Times as people say them: hours and days where seconds would run into thousands."""

import re
from dataclasses import dataclass

SECONDS_UNIT = "s"
# A range of times in words, such as "7.93e+05 to 1.06e+06".
RANGE_OF_TIMES = re.compile(r"(-?[\d.]+(?:e[+-]?\d+)?) to (-?[\d.]+(?:e[+-]?\d+)?)")


@dataclass(frozen=True)
class TimeScale:
    """A unit of time and how many of the user's unit it has."""

    unit: str
    size: float


# Seconds from which on times are told in a unit, the largest first.
LEAST_SECONDS = (
    (2 * 86400.0, TimeScale("days", 86400.0)),
    (3 * 3600.0, TimeScale("h", 3600.0)),
    (1800.0, TimeScale("min", 60.0)),
)


def scale_of_time(longest: float, unit: str) -> TimeScale:
    """The unit in which times up to the longest are told; seconds alone are changed."""
    if unit == SECONDS_UNIT:
        for least, scale in LEAST_SECONDS:
            if abs(longest) >= least:
                return scale
    return TimeScale(unit, 1.0)


def time_words(t: float, unit: str, digits: int = 3) -> str:
    """A time or a period with its unit, such as "23.9 h" for 86 200 s."""
    scale = scale_of_time(t, unit)
    return f"{t / scale.size:.{digits}g} {scale.unit}".rstrip()


def times_words(times: str, unit: str, digits: int = 3) -> str:
    """A range of times in words, "4 to 5", with its unit."""
    found = RANGE_OF_TIMES.search(times)
    if found is None:
        return f"{times} {unit}".rstrip()
    ends = [float(found[1]), float(found[2])]
    scale = scale_of_time(max(map(abs, ends)), unit)
    if scale.size == 1.0:
        return f"{times} {unit}".rstrip()
    begin, end = (f"{end / scale.size:.{digits}g}" for end in ends)
    return f"{begin} to {end} {scale.unit}"
