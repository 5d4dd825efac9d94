"""What a column's header says: a label, a unit, the words that name times and inputs.

Units stand in brackets ("q [m]", "T (degC)", "Time(s)"), after a stroke ("x / mm"), or
after the last underscore where it is one ("position_m", "Tempo_s"); "v_m_s" is in m/s,
"a_m_s2" in m/s2. A column of a MATLAB matrix, "X(:,2)", has none.
"""

import re
from dataclasses import dataclass

from phsi_opt.data.table_extent import unit_in
from phsi_opt.data.text_tables import PART
from phsi_opt.presentation.units import are_alike

IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
AFTER_STROKE = re.compile(r"^(.*?\S)(?:\s+(?:/|in)|,)\s+(\S+)$")
SERIAL = re.compile(r"\s*\([^)]*:[^)]*\)$")  # of a logger: "Temp, °C (S/N: 1234)"
OF_MATRIX = re.compile(r"([\w.]+)\((?::,\s*)?(\d+)(?:,\s*:)?\)")
TIMES = frozenset({"s", "sec", "ms", "us", "µs", "min", "h", "seconds", "d"})
# Words that are units behind a name; pint knows c and in, too.
UNIT_WORD = re.compile(
    "[nuµmcdkMG]?(m|V|rad|N|Nm|Ns|Nms|Pa|bar|[Ll]|A|C|Wb|Ah|K|J)"
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
RUN_WORDS = words_in(f"run trajectory trial experiment versuch record {PART}")
SET_POINT_WORDS = words_in(
    "setpoint reference referencia referenz sollwert target desired"
)


@dataclass(eq=False)
class Header:
    """A header."""

    column: str  # as it stands in the table
    label: str  # without the unit
    unit: str = ""  # "" where it does not tell one

    @classmethod
    def of(cls, text: str) -> "Header":
        """The label and the unit of a header."""
        of_matrix = OF_MATRIX.fullmatch(text)
        if of_matrix is not None:
            return Header(text, f"{of_matrix[1]}_{of_matrix[2]}")
        column = text
        text = SERIAL.sub("", column)
        for form in (IN_BRACKETS, AFTER_STROKE):
            found = form.match(text)
            is_after_comma = form is AFTER_STROKE and "," in text
            if found and found[1] and (not is_after_comma or unit_in(found[2])):
                return Header(column, found[1], SPELLED.get(found[2], found[2]))
        label, _, last = text.rpartition("_")
        name, _, numerator = label.rpartition("_")
        time = last.removesuffix("2")  # of a rate such as m/s, l/min, rad/s2
        may_be_rate = name and time in TIMES and UNIT_WORD.fullmatch(numerator)
        rate = f"{numerator}/{time}"
        is_rate = may_be_rate and any(are_alike(rate, one) for one in WRITTEN_RATES)
        if is_rate and TIME_WORDS.isdisjoint(_words(text)[:1]):
            return Header(column, name, f"{numerator}/{last}")
        is_unit = last in TIMES or UNIT_WORD.fullmatch(last)
        if label and last not in INDICES and is_unit:
            return Header(column, label, SPELLED.get(last, last))
        return Header(column, text)

    @property
    def is_time(self) -> bool:
        """Whether it says that it is the time; T is a temperature."""
        words = _words(self.label.rpartition(".")[2])  # of a field of a struct
        if not words or self.label == "T" or self.unit not in ("", *TIMES):
            return False
        return words[0] in TIME_WORDS or (words[-1] in TIME_WORDS and self.unit != "")

    @property
    def is_run(self) -> bool:
        """Whether it says that it names runs."""
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


def _words(text: str) -> list[str]:
    """The words of a text, in lower case, with the numbers behind them."""
    return [word.lower() for word in WORD.findall(text)]
