"""Numbers as a reader wants them: few digits, the error behind its value."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any

LINE_WIDTH = 80  # characters in a line of a terminal that nobody has widened
MINUS = re.compile(r"(?<![\w.)])-(?=\d)")  # before a number, not in 1e-5
UNIT_POWER = re.compile(r"(?<=[A-Za-z%])\^([2-9])(?![.\d])")  # formulas have ** for it
DEGREES = re.compile(r"\bdeg(?=[CF]\b)")  # of a temperature
RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
POWER_OF_TEN = re.compile(
    r"(?<![\w.])(\d+(?:\.\d+)?|\([^()]+\))e([+\-\N{MINUS SIGN}]?)0*(\d+)(?![\w.]\w)"
)
# Names of people; names of effects are small letters in code.
PEOPLE = re.compile(r"(?<![\w'\"])(coulomb|stribeck)\b")
# Of units, by powers of a thousand; kg has one, and those of a power take none.
PREFIXES = {-3: "n", -2: "\N{MICRO SIGN}", -1: "m", 1: "k", 2: "M", 3: "G"}
PREFIXED = re.compile(r"(?:[msANVWJFH]|Pa|Hz|Wb|Ohm)(?![\w^])")
# A number with what belongs to it, up to a unit of a few usual symbols.
UNIT_SYMBOLS = (
    r"(?:1/\(?)?(?:(?:[kMmnµ]?(?:Wh?|[NVAKJFHClgms]|Pa|Hz|bar|Ohm)|rad|min|h|days|"
    r"rpm|°[CF]|%)[²³⁴]?[/*()]*)+(?![\w\N{PRIME}])"
)
QUANTITY = re.compile(rf"\d[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]*\)?(?: ±|(?: {UNIT_SYMBOLS})+)")
NO_BREAK = "\N{NO-BREAK SPACE}"
ZERO = re.compile(r"(?<![\d.])0\.0+(?!\d)")
BESIDE = re.compile(r"(?<=±) (?=\d)")
# With six digits or more behind leading zeros.
LONG_CONSTANT = re.compile(
    r"(?<![\w.])(?=[0.]*[1-9](?:\.?\d){5})\d+\.\d+(?![\w.]| \+-)"
)


def enumerated(words: Iterable[str]) -> str:
    """Such as "a, b and c"."""
    *others, last = ["", *words]
    return " and ".join(filter(None, [", ".join(others[1:]), last]))


def number(value: float | None, digits: int = 0) -> str:
    """The value with so many digits; of one that somebody chose (0) at most four."""
    if value is None or not math.isfinite(value):
        return "not known"
    return said(decimal(value, digits or 4, "#" if digits and value else ""))


def percent(share: float) -> str:
    """A share with two digits, or as many more as tell it from 100 %."""
    rest = -math.log10(1 - share) if share < 1 else 0.0
    return number(100 * share, max(2, math.ceil(rest)))


def decimal(value: float, digits: int, zeros: str = "") -> str:
    """So many digits, up to a million as 260 and not as 2.6e+02; ``#`` keeps zeros."""
    text = f"{value:{zeros}.{digits}g}".removesuffix(".")
    if "e+" in text and abs(value) < 1e6:
        return f"{float(text):.0f}"
    return text


def change_words(before: float, after: float, unit: str = "") -> str:
    """What an error does, such as "falls from 10.0 to 9.3 mm" for " mm"."""
    first, last = (decimal(error, 3, "#") for error in (before, after))
    if first == last:
        return f"does not change ({first}{unit})"
    return f"{'falls' if after < before else 'rises'} from {first} to {last}{unit}"


def estimate_text(value: float, std_error: float, unit: str = "") -> str:
    """Value, standard error and unit as typed; both end with its second digit."""
    if not 0 < std_error < math.inf or not math.isfinite(value):
        error = f" +- {decimal(std_error, 2)}" if math.isfinite(std_error) else ""
        return f"{value:.6g}{error} {unit}".rstrip()
    return as_exact_as(std_error, (value, std_error), " +- ", unit)


def as_exact_as(
    std_error: float, values: Sequence[float], between: str, unit: str = ""
) -> str:
    """Values that end with the second digit of their standard error.

    Many zeros are a prefix of the unit, or else a power of ten; of four zeros behind
    the point in the standard error its first digit is told instead.
    """
    place = math.floor(math.log10(std_error))
    largest = max(map(abs, values))
    power = 0
    if largest >= 1e6 or (largest < 0.1 and place < -4):
        power = math.floor(math.log10(largest))
    prefix = PREFIXES.get(power // 3) if power and PREFIXED.match(unit) else None
    if prefix:
        power -= power % 3
    digits = 1 - place + power
    if power < 0 and not prefix and largest >= 1e-3 and place == -5:
        power, digits = 0, 5
    told = []
    for value in values:
        size = round(value / 10.0**power, digits) + 0.0
        told.append(f"{size:.{max(digits, 0)}f}")
    text = between.join(told)
    if power and not prefix:
        text = f"({text})e{power:+03d}"
    told_unit = unit.replace("1/", "per ", 1) if unit.startswith("1/") else unit
    return f"{text} {prefix or ''}{told_unit}".rstrip()


def range_words(begin: float, end: float, unit: str = "") -> str:
    """Both ends to the third digit of their distance."""
    if not 0 < end - begin < math.inf:
        return f"{begin:.3g} to {end:.3g} {unit}".rstrip()
    told = as_exact_as((end - begin) / 10, (begin, end), " to ", unit)
    return ZERO.sub("0", told)


def with_error(value: float, std_error: float, unit: str = "") -> str:
    """The same as a report has it; the value alone where there is no error."""
    if not math.isfinite(value) or not 0 < std_error < math.inf:
        return f"{number(value)} {unit}".rstrip()
    return said(estimate_text(value, std_error, unit))


OF_RATES = ("1/ms", "1/s", "1/min", "1/h", "1/days")


def time_constant_words(rate: float, std_error: float, unit: str) -> str:
    """A rate c in 1/h as its time constant 1/c in h; "" for what is no rate above zero.

    Its error is that of the rate times 1/c^2; from a tenth on its 95 % interval is
    told, whose ends are the reciprocals of those of the rate.
    """
    if unit not in OF_RATES or not rate > 2 * std_error > 0:
        return ""
    time = unit.removeprefix("1/")
    if 10 * std_error < rate:
        return f"time constant {estimate_text(1 / rate, std_error / rate**2, time)}"
    ends = [1 / (rate + 1.96 * std_error), 1 / (rate - 1.96 * std_error)]
    return f"time constant {with_interval(1 / rate, ends, f' {time}')}"


def with_interval(value: float, ends: Sequence[float], unit: str = "") -> str:
    """An estimate with its 95 % interval, where three digits show that."""
    low, high = map(number, ends, (3, 3))
    told = f"{number(value, 3)}{unit}"
    return told if low == high else f"{told} (95 %: {low} to {high})"


def short_constants(line: str) -> str:
    """An equation whose constants of six digits have three; estimates stay."""
    return LONG_CONSTANT.sub(lambda found: f"{float(found[0]):.3g}", line)


def p_value_words(p_value: float) -> str:
    """A p-value with two digits; below a millionth its size says nothing more."""
    return "below 1e-06" if p_value < 1e-6 else f"{p_value:.2g}"


def typeset(text: str) -> str:
    """A sentence of a terminal as it is printed: ± for +-, rad/s² for rad/s^2."""
    signed = DEGREES.sub("\N{DEGREE SIGN}", text.replace("+-", "\N{PLUS-MINUS SIGN}"))
    return UNIT_POWER.sub(lambda found: found[1].translate(RAISED), signed)


def label(name: str, unit: str) -> str:
    """The label of an axis, such as "t (s)"; the name alone where there is no unit."""
    return f"{name} ({typeset(unit)})" if unit else name


def called(name: str, labels: Mapping[str, str]) -> str:
    """A channel, or a direction such as "h2 - h1", in the names that people read."""
    return re.sub(r"\b[^\W\d]\w*", lambda found: labels.get(found[0], found[0]), name)


def said(text: str) -> str:
    """A sentence as a report has it: minus signs, powers of ten, Coulomb's name."""
    signed = MINUS.sub("\N{MINUS SIGN}", proper_names(typeset(text)))
    return POWER_OF_TEN.sub(_power_of_ten, signed.replace(" %", f"{NO_BREAK}%"))


def unbroken(value: Any) -> Any:
    """A text in which no line breaks between a number, its error and its unit."""
    if type(value) is not str:
        return value
    return BESIDE.sub(NO_BREAK, QUANTITY.sub(_joined, value))


def _joined(found: re.Match[str]) -> str:
    """A digit and its unit; a long unit may stand on the next line."""
    digit, _, unit = found[0].partition(" ")
    between = NO_BREAK if len(unit) < 9 else " "
    return f"{digit}{between}{unit.replace(' ', NO_BREAK)}"


def _power_of_ten(found: re.Match[str]) -> str:
    sign = "" if found[2] in ("", "+") else "\N{SUPERSCRIPT MINUS}"
    return f"{found[1]}\N{MULTIPLICATION SIGN}10{sign}{found[3].translate(RAISED)}"


def proper_names(text: str) -> str:
    """A text in which people have capital letters: Coulomb friction."""
    return PEOPLE.sub(lambda found: found[0].title(), text)


def number_of(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun, such as "1 sample" and "3 samples"."""
    return f"{n} {noun if n == 1 else plural or noun + 's'}"


def duration(seconds: float) -> str:
    """A duration as people read it: 0:07, 12:30, 1:02:03."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def lowered(text: str) -> str:
    """The text with a small first letter; the others stay as they are."""
    return f"{text[:1].lower()}{text[1:]}"


def capitalised(text: str) -> str:
    """The text with a capital first letter; the others stay as they are."""
    return f"{text[:1].upper()}{text[1:]}"


# ---- values as Python would write them, without what nobody chose -------------------


def chosen_fields(record: Any) -> dict[str, Any]:
    """The fields of a dataclass that are not at their defaults."""
    chosen = {}
    for one in fields(record):
        value = getattr(record, one.name)
        made = one.default_factory
        if value != (one.default if made is MISSING else made()):
            chosen[one.name] = value
    return chosen


def short_repr(record: Any) -> str:
    """``Class(field=value, ...)`` of a dataclass, without fields at their defaults."""
    parts = []
    for name, value in chosen_fields(record).items():
        shown = dict(value) if isinstance(value, Mapping) else value
        parts.append(f"{name}={shown!r}")
    return f"{type(record).__name__}({', '.join(parts)})"


def shortened(text: str, most: int) -> str:
    """The text, cut where it has more characters than ``most``."""
    return text if len(text) <= most else f"{text[:most]}..."
