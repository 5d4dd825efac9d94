"""The exceptions of the package.

Every message names the offender, its value, what was expected and how to repair it. One
common base lets a caller catch whatever this package raises on purpose; the standard
class beside it (`ValueError`, `RuntimeError`) lets code that does not know the package
catch it too. This file raises nothing itself.
"""

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

MOST_LETTERS = 60  # of a value in a message
MOST_OF_A_KEY = 3  # complaints of one key that a message shows
LONG_WORD = re.compile(r"(\S{120})\S{81,}(\S{60})")
LONG_LINE = re.compile(r"(.{1400}).{201,}(.{400})")


def concise(text: str) -> str:
    """A message without the middle of long lines and of words, such as paths."""
    return LONG_LINE.sub(r"\1 ... \2", LONG_WORD.sub(r"\1...\2", text))


class PhsiOptError(Exception):
    """Base class of the errors of this package; their messages are `concise`."""

    def __init__(self, *said: object) -> None:
        super().__init__(
            *(concise(one) if isinstance(one, str) else one for one in said)
        )


class DataError(PhsiOptError, ValueError):
    """Measurements, or arguments that refer to them, are not valid."""


class ModelError(PhsiOptError, ValueError):
    """A model, a term or an effect is not valid, or does not fit the measurements."""


class SolveError(PhsiOptError, RuntimeError):
    """An optimisation or a simulation failed."""


@dataclass(frozen=True)
class Complaint:
    """One mistake in a study file.

    Attributes:
        key: where it stands, as in the file, such as ``"data.states.q.column"``; ""
            for the file as a whole.
        value: its value, as in the file; "" if there is none.
        said: what was expected and what to do.
        line: of the key, or of the table that lacks it; None where it is not known.
    """

    key: str
    value: str
    said: str
    line: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "said", concise(self.said))

    def __str__(self) -> str:
        if not self.key:
            return self.said
        place = f"line {self.line}: " if self.line else ""
        written = f" = {self.value}" if self.value else ""
        return f"{place}{self.key}{written}: {self.said}"


class StudyFileError(DataError):
    """A study file is not valid; the error lists all mistakes.

    Args:
        path: of the file, as messages name it.
        complaints: what is wrong, in the order of the file.
        measurements: those that could be read nevertheless; None: none.

    Attributes:
        complaints: the same.
    """

    def __init__(
        self, path: object, complaints: Sequence[Complaint], measurements: Any = None
    ) -> None:
        self.path = str(path)
        self.measurements = measurements
        self.complaints = tuple(complaints)
        lines: list[str] = []
        for key, of_key in groupby(self.complaints, lambda one: one.key):
            told = list(map("  {}".format, of_key))
            lines += told[:MOST_OF_A_KEY]
            if len(told) > MOST_OF_A_KEY:
                lines.append(
                    f"  {key}: and {len(told) - MOST_OF_A_KEY} more like these"
                )
        n = len(self.complaints)
        what = "one thing" if n == 1 else f"{n} things"
        super().__init__("\n".join([f"{path}: {what} to correct", *lines]))

    def __reduce__(self) -> tuple[object, ...]:  # Exception has one argument
        return StudyFileError, (self.path, self.complaints, self.measurements)


def shown(value: object) -> str:
    """A value as a message names it: as Python writes it, or its type if that is long.

    A table, an array or a model is not printed into a message.
    """
    if isinstance(value, int) and abs(value) > 10**20:  # times in ns are shown
        return "a number beyond 10**20"
    if isinstance(value, str) and len(value) > MOST_LETTERS:
        return repr(f"{value[: MOST_LETTERS - 5]}...")
    try:
        written = value.__name__ if isinstance(value, type) else repr(value)
    except Exception:  # of a list with a number that is too long, or of a user's class
        return f"{type(value).__name__}(...)"
    is_short = len(written) <= MOST_LETTERS and "\n" not in written
    return written if is_short else f"{type(value).__name__}(...)"


def some_of(names: Sequence[str], nothing: str = "") -> str:
    """Names with commas, as many as a sentence has room for."""
    most = len(names)
    while most > 1 and len(", ".join(names[:most])) > 2 * MOST_LETTERS:
        most -= 1
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more else "") or nothing


def did_you_mean(name: object, options: Iterable[object]) -> str:
    """The end of a message about an unknown name: a hint at the closest option.

    Args:
        name: What was asked for.
        options: What exists; case is ignored in the comparison.

    Returns:
        ``" Did you mean 'x'?"``, or ``""`` when no option is close.
    """
    asked_for, *known = (
        one if isinstance(one, str) else shown(one) for one in (name, *options)
    )
    by_lower_case = {one.lower(): one for one in known}
    matches = difflib.get_close_matches(asked_for.lower(), by_lower_case, n=1)
    if not matches:
        return ""
    closest = by_lower_case[matches[0]]
    return f" Did you mean {closest!r}?"
