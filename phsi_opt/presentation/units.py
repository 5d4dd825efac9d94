"""Units and times as people write them: N in place of kg m/s/s, hours, dates.

`in_si` finds the SI units in which channels are computed; a `Unit` remembers how it was
written, and `scale_of` gives the scale in which its numbers are told. pint knows the
names that are not plain SI; it is slow to import and asked only for these. "C" stays as
it is: it is coulomb to one and degree Celsius to another.
"""

import datetime as dt
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from phsi_opt.presentation.numbers import PREFIXED, PREFIXES, decimal

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
    "H": "kg m^2/(A^2 s^2)",
    "F": "A^2 s^4/(kg m^2)",
}
# What a rate is called where it has the powers of one of these.
NAMED_RATES = (
    *("N", "N m", "N m/rad", "N/s", "W", "V", "A", "m/s", "m/s^2", "m^3/s", "kg/s"),
    *("K/s", "rad/s", "rad/s^2", "1/s"),
)
OF_MECHANICS = frozenset({"kg", "m", "s", RADIAN})
# A unit of any name with its power, such as "m", "s^2", "m2" or "s**-1"; between two,
# blanks, "*", "." or "·".
FACTOR = re.compile(r"((?:[^\W\d_]|[%‰°])+)(?:(?:\^|\*\*)?(-?\d))?$")
FACTOR_SEPARATORS = re.compile(r"(?<!\*)\*(?!\*)|[\s.·]+")
PLAIN_POWERS = str.maketrans("²³⁻¹", "23-1", "()")
LONGEST_UNIT = 60  # letters; a longer text is no unit
# ---- of pint
BASE_OF_PINT = {
    **{"kilogram": "kg", "meter": "m", "second": "s", "ampere": "A", "kelvin": "K"},
    "radian": RADIAN,
}
CALLED_IN_PINT = {"%": "percent", "‰": "permille", "rev": "turn", "RPM": "rpm"}
# Words of which pint would make a year, an atomic mass or a coulomb.
OWN_WORDS = frozenset({"C", "a", "u", "dB"})
SEVERAL_MEANINGS = frozenset({"g", "F"})  # gravity and Fahrenheit as well
WITHOUT_BLANKS = re.compile(r"\b(kg|[kMmµμu]?[NVAW])(m\d?)?(s)?\b")  # Nm, Vs, kgm2
# Temperatures that do not count from absolute zero, and what is told at 0 degC.
CELSIUS = ("degC", "°C", "degF", "°F")
TOLD_AT_ZERO = {"degF": 32.0, "°F": 32.0}


def scale_of_errors(unit: str, largest: float) -> tuple[float, str]:
    """A factor on errors and their unit: percent where there are several channels.

    Small ones are told with a prefix, such as 0.59 mm.
    """
    if unit == STANDARD_DEVIATIONS:
        return 100.0, "% of the standard deviation"
    power = 0
    if 0 < largest < 0.01 and PREFIXED.match(unit):
        power = math.floor((math.log10(largest) + 1) / 3)
    prefix = PREFIXES.get(power, "")
    return (1000.0**-power if prefix else 1.0), f"{prefix}{unit}"


def rate_unit(unit: str, unit_of_time: str) -> str:
    """Unit of a rate of change, "" where one of the two units is not known."""
    if not unit or not unit_of_time:
        return ""
    written = powers_as_written(unit)
    below = powers_as_written(unit_of_time)
    if written is None or below is None:
        above = f"({unit})" if " " in unit or "/" in unit else unit
        return f"{above}/{unit_of_time}"
    powers = product(written, below, -1)
    if powers.keys() <= KNOWN.keys():
        basic = _in_base_units(powers)
        for name in NAMED_RATES:
            if basic == powers_in_base_units(name):
                return name
    return _written(powers)


def product(first: Powers, second: Powers, power: float = 1.0) -> Powers:
    """The powers in first * second**power; none that are zero."""
    total = dict(first)
    for name, exponent in second.items():
        total[name] = total.get(name, 0.0) + power * exponent
    return {name: exponent for name, exponent in total.items() if exponent}


def powers_as_written(unit: str) -> Powers | None:
    """Powers of the units as they are written, of any name; None: not readable."""
    if len(unit) > LONGEST_UNIT:
        return None
    powers: Powers = {}
    plain = unit.translate(PLAIN_POWERS)
    sign = 1
    for part in plain.split("/"):
        for factor in FACTOR_SEPARATORS.split(part.strip(" .·")):
            found = FACTOR.match(factor)
            if factor == "1":
                continue
            if found is None:
                return None
            powers = product(powers, {found[1]: int(found[2] or 1)}, sign)
        sign = -1
    return powers


KNOWN: Mapping[str, Powers] = {
    **{name: {name: 1.0} for name in BASE_UNITS},
    **{name: powers_as_written(unit) or {} for name, unit in DERIVED.items()},
}
IN_BASE_UNITS = {**KNOWN, "degC": {"K": 1.0}}


@cache
def powers_in_base_units(unit: str) -> Powers | None:
    """The same in base units, those that are not known as they are written."""
    written = powers_as_written(unit)
    return None if written is None else _in_base_units(written)


def _in_base_units(written: Powers) -> Powers:
    powers: Powers = {}
    for name, n in written.items():
        powers = product(powers, IN_BASE_UNITS.get(name, {name: 1}), n)
    return powers


def unit_per(unit: str, of: str, power: int) -> str:
    """The unit of a quantity over the power of another one, told in theirs."""
    above = scale_of(unit)
    below = scale_of(of)
    size = above.size / below.size**power
    named = []
    for one, other in ((unit, of), (above.unit, below.unit)):
        powers, divided = map(powers_as_written, (one, other))
        if powers is None or divided is None:
            return ""
        named.append(_written(product(powers, divided, -power)))
    computed, told = named
    return computed if size == 1.0 else Unit(computed, Scale(told, size))


def coefficient_unit(powers: Powers, named: Sequence[str] = ()) -> str:
    """The unit of a coefficient as people write it: N s/m, kg m^2, or one named."""
    basic = _in_base_units(powers)
    without_angle = product(basic, {RADIAN: 1}, -1)  # a torque is N m, not N m rad
    for unit in filter(None, named):
        sought = (basic, without_angle) if unit.startswith("N m") else (basic,)
        if powers_in_base_units(unit) in sought:
            return unit
    if powers.keys() - KNOWN.keys() or len(powers) == 1:
        return _written(powers)
    is_of_circuit = bool(named) and named[0] in ("A", "V")
    if basic.get("kg") and basic.keys() <= OF_MECHANICS and not is_of_circuit:
        return _mechanical(basic)
    if "A" in basic and abs(basic.get(RADIAN, 0)) == 2:  # of (V s/rad)^2 in a motor
        basic = product(basic, {RADIAN: basic[RADIAN]}, -1)
    for unit, known in KNOWN.items():
        if basic == known:
            return unit
    mass = powers.get("kg", 0.0)
    in_volts = product(product(powers, KNOWN["V"], -mass), {"V": mass})
    charge = in_volts.get("A", 0.0)
    if charge and charge == in_volts.get("s"):
        in_volts = product(product(in_volts, {"A": 1, "s": 1}, -charge), {"C": charge})
    is_electrical = ("A" in powers or is_of_circuit) and "m" not in in_volts
    return _written(in_volts if is_electrical else powers)


def _mechanical(basic: Powers) -> str:
    """By newtons, but for a mass (kg) and an inertia (kg m^2)."""
    angle = basic.get(RADIAN, 0)
    is_mass = basic["kg"] == 1 and "s" not in basic and basic.get("m", 0) >= 0
    is_mass = is_mass and angle >= -1  # an inertia is kg m^2, whatever its angle is in
    powers = product(basic, {RADIAN: angle}, -1) if angle > 0 or is_mass else basic
    if is_mass:
        return _written(powers)
    in_newtons = product({"N": 1}, KNOWN["N"], -1)
    return _written(product(powers, in_newtons, powers["kg"]))


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
    others = sorted(powers.keys() - set(order))
    return [(name, powers[name]) for name in (*others, *order) if name in powers]


def _factor(name: str, power: float) -> str:
    return name if power == 1 else f"{name}^{power:.4g}"


# ---- SI, and what it is told in ------------------------------------------------------


@dataclass(frozen=True)
class Scale:
    """A unit in which something is told, and how many of the computed unit it has."""

    unit: str
    size: float = 1.0
    zero: float = 0.0  # what is told where 0 is computed, such as 32 degF

    def shown(self, values: Any) -> Any:
        """Computed values as they are told; differences are divided by the size."""
        if self.size < 1.0:  # 1000 is a float, and 0.001 none
            return values * (1 / self.size) + self.zero
        return values / self.size + self.zero

    def read(self, values: Any) -> Any:
        """The reverse: told values as they are computed."""
        if self.size < 1.0:
            return (values - self.zero) / (1 / self.size)
        return (values - self.zero) * self.size


class Unit(str):
    """A unit in which numbers are computed, and the scale in which they are told."""

    scale: Scale

    def __new__(cls, computed: str, scale: Scale) -> "Unit":
        unit = super().__new__(cls, computed)
        unit.scale = scale
        return unit

    def __reduce__(self) -> tuple[Any, ...]:  # for copies and other processes
        return Unit, (str(self), self.scale)


def unit_of(unit: Any) -> str:
    """The unit as text, which still knows how it was written."""
    return unit if isinstance(unit, Unit) else str(unit)


def scale_of(unit: str) -> Scale:
    """The scale in which numbers in a unit are told: its own, or as it was written."""
    return unit.scale if isinstance(unit, Unit) else Scale(unit)


# Pint would work it out: 9**9**9 takes for ever.
POWER_OF_NUMBER = re.compile(r"\d\)*\s*(\*\*|\^|[⁰¹²³⁴-⁹⁻])")


class Measure(NamedTuple):
    """A unit as powers of SI's base units (or words of its own), times a size."""

    powers: Powers
    size: float


@cache
def measure_of(unit: str) -> Measure | None:
    """What a unit is in SI; degrees of every temperature are K. None: not readable."""
    if not unit:  # pint is slow to load
        return None
    written = powers_as_written(WITHOUT_BLANKS.sub(_apart, unit))
    if written is None:  # such as mmH2O
        found = _in_pint(unit)
        return None if unit in found.powers or not unit.isalnum() else found
    powers: Powers = {}
    size = 1.0
    for name, n in written.items():
        one = Measure(KNOWN[name], 1.0) if name in KNOWN else _in_pint(name)
        powers = product(powers, one.powers, n)
        size *= one.size**n
    return Measure(powers, float(f"{size:.15g}"))


def are_alike(unit: str, other: str) -> bool:
    """Whether two units are of one dimension."""
    measure = measure_of(unit) if unit else None
    like = measure_of(other)
    return measure is not None and like is not None and measure.powers == like.powers


def contradict(unit: str, other: str) -> bool:
    """Whether numbers in one unit are surely none in the other.

    An angle may stand without its unit (rpm is 1/min to many), and so may a word that
    SI does not know, or one of `SEVERAL_MEANINGS`, mean the same.
    """
    first, second = map(measure_of, (unit, other))
    is_open = unit.lower() == other.lower() or SEVERAL_MEANINGS & {unit, other}
    if first is None or second is None or is_open:
        return False
    ratio = product(first.powers, second.powers, -1).keys()
    if ratio:
        return ratio != {RADIAN} and ratio <= set(BASE_UNITS)
    have_zeros = (unit in CELSIUS) != (other in CELSIUS)
    return not math.isclose(first.size, second.size) or have_zeros


def words_of(unit: str) -> set[str]:
    """The words of a unit that SI does not know, such as "counts"."""
    measure = measure_of(unit) if unit else Measure({}, 1.0)
    return {unit} if measure is None else set(measure.powers) - set(BASE_UNITS)


def _apart(found: re.Match[str]) -> str:
    return " ".join(filter(None, found.groups()))


def is_known(unit: str) -> bool:
    """Whether all words of a unit are of SI, or known to pint."""
    written = powers_as_written(WITHOUT_BLANKS.sub(_apart, unit))
    names = [unit] * unit.isalnum() if written is None else list(written)
    return all(name in KNOWN or _parsed(name) for name in names) and bool(names)


def _in_pint(name: str) -> Measure:
    """A name by pint; one that pint does not know, or has no size of, is its own."""
    parsed = _parsed(name)
    by_name = {} if parsed is None else dict(parsed[1]._units)
    if parsed is None or not by_name.keys() <= BASE_OF_PINT.keys():
        return Measure({name: 1.0}, 1.0)
    powers = {BASE_OF_PINT[one]: float(n) for one, n in by_name.items()}
    return Measure(powers, float(f"{parsed[0]:.15g}"))


def _parsed(name: str) -> Any:
    """The size and the base units of a name in pint; None where there are none."""
    if name in OWN_WORDS or len(name) > LONGEST_UNIT or POWER_OF_NUMBER.search(name):
        return None
    try:
        registry = _registry()
        called = CALLED_IN_PINT.get(name, name.replace("Ohm", "ohm"))
        return registry.get_base_units(registry.parse_units(called))
    except Exception:  # of pint, which reads it as Python
        return None


@cache
def _registry() -> Any:
    from pint import UnitRegistry  # slow to import

    return UnitRegistry(cache_folder=None)


def in_si(units: Mapping[str, str]) -> dict[str, str]:
    """The units in which channels are computed; those that are SI already stay.

    Angles are in rad. Degrees of Celsius stay a scale of their own: degF are converted
    to it, and K where others are in it. Without a unit of the time nothing is
    converted; a unit that is not known is none of SI's, and stays.
    """
    if not units.get("t"):
        return dict(units)
    are_celsius = not set(units.values()).isdisjoint(CELSIUS)
    found = {}
    for name, unit in units.items():
        found[name] = computed_unit(unit)
        if unit == "K" and are_celsius:
            found[name] = Unit("degC", Scale(unit, zero=273.15))
    return found


def computed_unit(unit: str) -> str:
    """The SI unit of one that is not SI, which it remembers; others as they are."""
    measure = measure_of(unit) if unit and not isinstance(unit, Unit) else None
    zero = TOLD_AT_ZERO.get(unit, 0.0)
    if measure is None or (measure.size == 1.0 and not zero):
        return unit
    scale = Scale(unit, measure.size, zero)
    return Unit("degC" if zero else si_name(measure.powers, unit), scale)


def si_name(powers: Powers, written: str = "") -> str:
    """The name of SI's unit of these powers; a torque was written with N."""
    energy = "N m" if "N" in written else "J"
    names = ("N", "Pa", energy, "W", "V", "Wb", "Ohm", "W/K", "J/K")
    return coefficient_unit(powers, names) or "1"


# ---- times: hours and days where seconds would run into thousands, seconds for ms ----

SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}  # of the units that are told anew


# Seconds from which on times are shown in a unit, the largest first.
LEAST_SECONDS = (
    (2 * 86400.0, Scale("days", 86400.0)),
    (3 * 3600.0, Scale("h", 3600.0)),
    (1800.0, Scale("min", 60.0)),
    (3.0, Scale("s")),  # in place of thousands of ms
)


def scale_of_time(longest: float, unit: str) -> Scale:
    """The unit in which times up to the longest are told: days for 200 h."""
    size = SECONDS.get(unit, 0.0)
    own = scale_of(unit)
    for least, scale in LEAST_SECONDS:
        if size and abs(longest) * size >= least and scale.size > size * own.size:
            return Scale(scale.unit, scale.size / size)
    return own


def time_words(t: float, unit: str, longest: float = 0.0) -> str:
    """Such as "23.9 h" for 86 200 s; the longest time is told in the same unit."""
    return times_words(t, t, unit, longest)


def times_words(begin: float, end: float, unit: str, longest: float = 0.0) -> str:
    """A range of times with its unit, such as "4 to 5 s"; as `time_words`."""
    scale = scale_of_time(max(abs(begin), abs(end), longest), unit)
    ends = dict.fromkeys(decimal(one / scale.size, 3) for one in (begin, end))
    return f"{' to '.join(ends)} {scale.unit}".rstrip()


def date_words(t: float, origin: dt.datetime | None, span: float = 0.0) -> str:
    """The moment of a time in seconds, to days or minutes in a long span (s)."""
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
    time = units.get("t") or "unit of time"
    return "Hz" if time == "s" else f"cycles per {time}"


def frequency_words(frequency: float, units: Mapping[str, str]) -> str:
    """A frequency; its period where that is told in minutes, hours or days."""
    unit = units.get("t", "")
    is_long = unit != "s" and unit in SECONDS
    if is_long or scale_of_time(1 / frequency, unit).size > 1.0:
        return f"with a period of {time_words(1 / frequency, unit)}"
    return f"at {frequency:.3g} {frequency_unit(units)}"


def scale_of_rate(equation: str, units: Mapping[str, str], longest: float) -> Scale:
    """A rate per hour where a record of seconds lasts for hours: degC/h.

    Rates of units that were converted are shown in these, such as deg/s; others with a
    name of their own (N, m/s) stay. ``longest`` is the last time of the record.
    """
    time = units.get("t", "")
    seconds = SECONDS.get(time, 0.0)
    if scale_of_time(longest, time).size * seconds >= SECONDS["h"]:
        time = Unit(str(time), Scale("h", SECONDS["h"] / seconds))
    return scale_of(unit_of_rate(units.get(equation, ""), time))


def unit_of_rate(unit: str, of_time: str) -> str:
    """`rate_unit`, told per hour where times are, and in the unit of a state."""
    rate = rate_unit(unit, of_time)
    state = scale_of(unit)
    time = scale_of(of_time)
    if time.size < 1.0:  # speeds in mm/s, where times are in ms
        time = Scale(str(of_time))
    size = state.size / time.size
    is_motion = set(powers_in_base_units(rate) or "") <= {"m", "s", "K", RADIAN}
    is_told = state.size != 1.0 and is_motion
    if size == 1.0 or (rate in NAMED_RATES and not (is_told or unit == "1")):
        return rate
    return Unit(rate, Scale(rate_unit(state.unit, time.unit), size))


def spaced(unit: str) -> str:
    """The unit with a space before it, or nothing."""
    return f" {unit}" if unit else ""
