"""What a column's header tells: a name, a unit, and words such as "time" or "force".

Units stand in brackets ("q [m]", "T (degC)", "Time(s)"), after a stroke ("x / mm"), or
after the last underscore where it is one ("position_m", "Tempo_s"). A column of a
MATLAB matrix, "X(:,2)", has none.
"""

import re
from dataclasses import dataclass

from phsi_opt.model.kinds import LENGTHS, PREFIXES, VOLTS, WITH_PREFIX, WITHOUT_PREFIX

IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
AFTER_STROKE = re.compile(r"^(.*?\S)\s+(?:/|in)\s+(\S+)$")
OF_MATRIX = re.compile(r"([\w.]+)\((?::,\s*)?(\d+)(?:,\s*:)?\)")
TIMES = frozenset({"s", "sec", "ms", "us", "µs", "min", "h", "seconds", "d"})
SPELLED = {"sec": "s", "seconds": "s"}
# Single letters after an underscore that are more often an index than a unit.
INDICES = frozenset({"l", "C", "d"})

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
NUMBERED_INPUT = re.compile(r"u\d+")
WORD = re.compile(r"[^\W\d_]+\d*")


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
    unit: str

    @property
    def words(self) -> list[str]:
        """Its words, in lower case."""
        return [word.lower() for word in WORD.findall(self.label)]


def header_of(text: str) -> Header:
    """The label and the unit of a header."""
    of_matrix = OF_MATRIX.fullmatch(text)
    if of_matrix is not None:
        return Header(text, f"{of_matrix[1]}_{of_matrix[2]}", "")
    for form in (IN_BRACKETS, AFTER_STROKE):
        found = form.match(text)
        if found and found[1]:
            return Header(text, found[1], SPELLED.get(found[2], found[2]))
    label, _, last = text.rpartition("_")
    if label and last not in INDICES and is_unit(last):
        return Header(text, label, SPELLED.get(last, last))
    return Header(text, text, "")


def is_unit(text: str) -> bool:
    """Whether a text is a unit that is known."""
    if text in TIMES | LENGTHS | VOLTS:
        return True
    for units in WITHOUT_PREFIX.values():
        if text in units:
            return True
    for units in WITH_PREFIX.values():
        for prefix in PREFIXES:
            if text.startswith(prefix) and text[len(prefix) :] in units:
                return True
    return False


def is_time_word(header: Header) -> bool:
    """Whether a header says that it is the time; T is a temperature."""
    field = header.label.rpartition(".")[2]  # of a struct
    words = [word.lower() for word in WORD.findall(field)]
    if not words or header.label == "T" or header.unit not in ("", *TIMES):
        return False
    return words[0] in TIME_WORDS or (words[-1] in TIME_WORDS and header.unit != "")


def is_step_word(words: list[str]) -> bool:
    """Whether a header says that it is the time between samples."""
    return len(words) == 1 and words[0] in STEP_WORDS


def is_run_word(words: list[str]) -> bool:
    """Whether a header says that it names runs."""
    return bool(words) and words[0] in RUN_WORDS


def is_input_word(words: list[str]) -> bool:
    """Whether a header sounds like an input."""
    for word in words:
        if word.rstrip("0123456789") in INPUT_WORDS or NUMBERED_INPUT.fullmatch(word):
            return True
    return False


def may_be_input_word(words: list[str]) -> bool:
    """Whether a header may be that of an input, or as well of a state."""
    return any(word.rstrip("0123456789") in PERHAPS_INPUT_WORDS for word in words)


def is_set_point(words: list[str]) -> bool:
    """Whether a header says that it is what a controller aims at."""
    if words[:2] == ["set", "point"]:
        return True
    for word in words:
        without_number = word.rstrip("0123456789")
        if without_number in SET_POINT_WORDS or without_number.endswith("ref"):
            return True
    return False


def name_from(header: Header) -> str:
    """A name that formulas can use, from the label."""
    name = re.sub(r"\W+", "_", header.label).strip("_")
    return f"x{name}" if name[:1].isdigit() else name
