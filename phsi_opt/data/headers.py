"""What a column's header says: a label, a unit, the words that name times and inputs.

Units stand in brackets ("q [m]", "T (degC)", "Time(s)"), after a stroke ("x / mm"), or
after the last underscore ("position_m", "Tempo_s"); "v_m_s" is in m/s, "a_m_s2" in
m/s2. Other words in brackets, such as the socket of a channel, are part of the label.
A column of a MATLAB matrix, "X(:,2)", has no unit.
"""

import re
from dataclasses import dataclass
from typing import Any

from phsi_opt.data.table_extent import is_unit
from phsi_opt.presentation.units import are_alike

OF_MATRIX = re.compile(r"([\w.]+)\((?::,\s*)?(\d+)(?:,\s*:)?\)")
TIMES = frozenset({"s", "sec", "ms", "us", "µs", "min", "h", "seconds", "d"})
# Words that are units behind a name; pint knows c and in, too.
UNIT_WORD = re.compile(
    "[nuµmcdkMG]?(m|V|rad|N|Nm|Ns|Nms|Pa|bar|[Ll]|A|C|W|Wb|Ah|K|J|Hz)"
    "|deg[CF]?|°[CF]?|rev|rpm|[cdm]?m3|psi|mH2O|Vs|k?Wh"
)
WRITTEN_RATES = ("m/s", "rad/s", "m^3/s")  # those that are written with underscores
SPELLED = {"sec": "s", "seconds": "s"}
# Single letters after an underscore that are more often an index than a unit.
INDICES = frozenset({"l", "C", "d"})
WORD = re.compile(r"[^\W\d_]+\d*")


def words_in(text: str) -> frozenset[str]:
    """The words of a list."""
    return frozenset(text.split())


TIME_WORDS = words_in(
    "t time times timestamp datetime date tempo zeit temps datum uhrzeit zeitstempel"
)
STEP_WORDS = words_in("ts dt step")
TEMPERATURE_WORDS = words_in(
    "t temp temperature temperatur room outside outdoor inside indoor ambient wall air"
)
RUN_WORDS = words_in("run trajectory trial experiment versuch record")
SET_POINT_WORDS = words_in(
    "setpoint reference referencia referenz sollwert target desired"
)


@dataclass
class Header:
    """A header."""

    column: Any  # as it stands in the table
    label: str = ""  # without the unit
    unit: str = ""  # "" where it does not tell one

    @classmethod
    def of(cls, text: str) -> "Header":
        of_matrix = OF_MATRIX.fullmatch(text)
        if of_matrix is not None:
            return Header(text, f"{of_matrix[1]}_{of_matrix[2]}")
        before, bracketed = _in_brackets(text)
        if before and (not bracketed or is_unit(bracketed)):
            return Header(text, before, SPELLED.get(bracketed, bracketed))
        # In the brackets may be a serial number: "Temp, °C (S/N: 1234)".
        label, unit = _label_and_unit(before or text)
        return Header(text, label if unit else text, SPELLED.get(unit, unit))

    @property
    def is_time(self) -> bool:
        """Whether it says that it is the time; T is a temperature, and so is t_oil."""
        label = self.label.rpartition(".")[2]  # of a field of a struct
        words = _words(label)
        if not words or label == "T" or self.unit not in ("", *TIMES):
            return False
        if self.unit:
            return not TIME_WORDS.isdisjoint((words[0], words[-1]))
        return label == "t" or words[0] in TIME_WORDS - {"t"}

    @property
    def is_run(self) -> bool:
        return not RUN_WORDS.isdisjoint(_words(self.label)[:1])

    @property
    def is_step(self) -> bool:
        """Whether it says that it is the time between samples."""
        return _words(self.label) in ([word] for word in STEP_WORDS)

    def has_one_of(self, known: frozenset[str]) -> bool:
        """Whether one of its words is known, whatever the numbers behind them."""
        return not known.isdisjoint(w.rstrip("0123456789") for w in _words(self.label))

    @property
    def is_set_point(self) -> bool:
        """Whether it says that it is what a controller aims at."""
        words = [word.rstrip("0123456789") for word in _words(self.label)]
        is_reference = any(word.endswith("ref") for word in words)
        return (
            is_reference
            or "".join(words[:2]) == "setpoint"
            or self.has_one_of(SET_POINT_WORDS)
        )

    @property
    def suggested_name(self) -> str:
        """A name that formulas can use, from the label."""
        name = re.sub(r"\W+", "_", self.label).strip("_")
        return f"x{name}" if name[:1].isdigit() else name


def unit_of_header(text: str, is_time: bool) -> str:
    """The unit that a header tells; "" where a channel would be in a unit of time."""
    unit = Header.of(text).unit
    return unit if (unit in TIMES) == is_time else ""


def _in_brackets(text: str) -> tuple[str, str]:
    """The text before its last brackets, and inside; "" where it ends in none."""
    text = text.rstrip()
    begin = max(text.rfind("["), text.rfind("("))
    inside = text[begin + 1 : -1]
    if begin < 0 or not text.endswith(("]", ")")) or "]" in inside or ")" in inside:
        return "", ""
    return text[:begin].rstrip(), inside.strip()


def _label_and_unit(text: str) -> tuple[str, str]:
    """The label and the unit behind a stroke, a comma or underscores; "": none."""
    *words, last = text.split() or [""]
    label = " ".join(words)
    for sign in (" /", " in", ","):
        if label.endswith(sign) and is_unit(last):
            return label.removesuffix(sign).rstrip(), last
    label, _, last = text.rpartition("_")
    name, _, numerator = label.rpartition("_")
    time = last.removesuffix("2")  # of a rate such as m/s, l/min, rad/s2
    may_be_rate = name and time in TIMES and UNIT_WORD.fullmatch(numerator)
    rate = f"{numerator}/{time}"
    is_rate = may_be_rate and any(are_alike(rate, one) for one in WRITTEN_RATES)
    if is_rate and TIME_WORDS.isdisjoint(_words(text)[:1]):
        return name, f"{numerator}/{last}"
    first = label.lower().partition("_")[0].rstrip("0123456789")
    if last == "C" and first in TEMPERATURE_WORDS:
        return label, "degC"
    is_word = last in TIMES or UNIT_WORD.fullmatch(last)
    return label, last if label and is_word and last not in INDICES else ""


def _words(text: str) -> list[str]:
    """The words of a text, in lower case, with the numbers behind them."""
    return [word.lower() for word in WORD.findall(text)]
