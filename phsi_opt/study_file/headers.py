"""What a column's header tells: a name, a unit, and words such as "time" or "force".

Units stand in brackets ("q [m]", "T (degC)", "Time(s)"), after a stroke ("x / mm"), or
after the last underscore where it is one ("position_m", "Tempo_s"); "v_m_s" is in m/s,
"a_m_s2" in m/s2. A column of a MATLAB matrix, "X(:,2)", has none.
"""

import re
from dataclasses import dataclass

from phsi_opt.model.kinds import VOLTS, kind_of_unit

IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
AFTER_STROKE = re.compile(r"^(.*?\S)\s+(?:/|in)\s+(\S+)$")
OF_MATRIX = re.compile(r"([\w.]+)\((?::,\s*)?(\d+)(?:,\s*:)?\)")
TIMES = frozenset({"s", "sec", "ms", "us", "µs", "min", "h", "seconds", "d"})
SPELLED = {"sec": "s", "seconds": "s"}
# Single letters after an underscore that are more often an index than a unit.
INDICES = frozenset({"l", "C", "d"})
WORD = re.compile(r"[^\W\d_]+\d*")

TIME_WORDS = frozenset(
    {"t", "time", "times", "timestamp", "datetime", "date", "tempo", "zeit", "temps"}
)
STEP_WORDS = frozenset({"ts", "dt", "step"})
RUN_WORDS = frozenset({"run", "trajectory", "trial", "experiment", "versuch", "record"})
INPUT_WORDS = frozenset(
    {
        *("u", "in", "input", "command", "cmd", "controle", "control", "pwm", "duty"),
        *("force", "torque", "current", "heater", "pump", "valve", "throttle", "motor"),
        *("uest", "uval", "drive", "actuator", "thrust"),
    }
)
# These may be what drives a system, or what is to be found: only a remark is made.
PERHAPS_INPUT_WORDS = frozenset(
    {
        *("solar", "sun", "irradiance", "radiation", "ghi", "wind", "load", "power"),
        *("ambient", "outdoor", "outside", "supply", "inflow", "heating", "pulses"),
        *("disturbance", "ps", "ph", "ta", "thm", "qh"),
    }
)
SET_POINT_WORDS = frozenset(
    {"setpoint", "reference", "referencia", "referenz", "sollwert", "target", "desired"}
)


def words_of(text: str) -> list[str]:
    """The words of a text, in lower case, with the numbers behind them."""
    return [word.lower() for word in WORD.findall(text)]


@dataclass(frozen=True)
class Header:
    """A header.

    Attributes:
        text: as it stands in the table.
        label: without the unit.
        unit: "" where it does not tell one.
    """

    text: str
    label: str
    unit: str = ""

    @classmethod
    def of(cls, text: str) -> "Header":
        """The label and the unit of a header."""
        of_matrix = OF_MATRIX.fullmatch(text)
        if of_matrix is not None:
            return cls(text, f"{of_matrix[1]}_{of_matrix[2]}")
        for form in (IN_BRACKETS, AFTER_STROKE):
            found = form.match(text)
            if found and found[1]:
                return cls(text, found[1], SPELLED.get(found[2], found[2]))
        label, _, last = text.rpartition("_")
        name, _, numerator = label.rpartition("_")
        is_time = not TIME_WORDS.isdisjoint(words_of(text)[:1])
        if name and not is_time and _is_rate(numerator, last):
            return cls(text, name, f"{numerator}/{last}")
        is_unit = last in TIMES | VOLTS or kind_of_unit(last) != ""
        if label and last not in INDICES and is_unit:
            return cls(text, label, SPELLED.get(last, last))
        return cls(text, text)

    @property
    def words(self) -> list[str]:
        """Its words in lower case, without the numbers behind them."""
        return [word.rstrip("0123456789") for word in words_of(self.label)]

    @property
    def is_time(self) -> bool:
        """Whether it says that it is the time; T is a temperature."""
        words = words_of(self.label.rpartition(".")[2])  # of a field of a struct
        if not words or self.label == "T" or self.unit not in ("", *TIMES):
            return False
        return words[0] in TIME_WORDS or (words[-1] in TIME_WORDS and self.unit != "")

    @property
    def is_run(self) -> bool:
        """Whether it says that it names runs."""
        return not RUN_WORDS.isdisjoint(words_of(self.label)[:1])

    @property
    def is_step(self) -> bool:
        """Whether it says that it is the time between samples."""
        words = words_of(self.label)
        return len(words) == 1 and words[0] in STEP_WORDS

    @property
    def is_set_point(self) -> bool:
        """Whether it says that it is what a controller aims at."""
        if self.words[:2] == ["set", "point"]:
            return True
        return any(w in SET_POINT_WORDS or w.endswith("ref") for w in self.words)

    @property
    def is_input(self) -> bool:
        """Whether it sounds like an input."""
        return not INPUT_WORDS.isdisjoint(self.words)

    @property
    def may_be_input(self) -> bool:
        """Whether it may be that of an input, or as well of a state."""
        return not PERHAPS_INPUT_WORDS.isdisjoint(self.words)

    @property
    def name(self) -> str:
        """A name that formulas can use, from the label."""
        name = re.sub(r"\W+", "_", self.label).strip("_")
        return f"x{name}" if name[:1].isdigit() else name


def _is_rate(numerator: str, denominator: str) -> bool:
    """Whether the quotient of two units is that of a rate: m/s, l/min, rad/s2."""
    time = denominator.removesuffix("2")
    return time in TIMES and kind_of_unit(f"{numerator}/{time}") != ""
