"""A table of a study file, read key by key; what is wrong is collected, not raised.

So that a user hears of everything at once. A value that cannot be used is replaced by
the default, and reading goes on.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from phsi_opt.errors import Complaint, did_you_mean
from phsi_opt.study_file.keys import known_keys
from phsi_opt.study_file.toml_text import key_text, toml_value

SHOWN_CHARACTERS = 60  # of a value, in a message
OWN_NAMES = "*"
MOST_TOLD = 100  # complaints; a person corrects fewer before the next look


class TooManyComplaintsError(Exception):
    """So much is wrong that the rest of a file is not looked at."""


def shown(value: Any) -> str:
    """A value as the file has it, cut where it is long."""
    try:
        text = toml_value(value)
    except TypeError:  # a date
        text = str(value)
    if len(text) <= SHOWN_CHARACTERS:
        return text
    return f"{text[:SHOWN_CHARACTERS]}..."


@dataclass
class Complaints:
    """What is wrong with a file, in the order in which it was found."""

    listed: list[Complaint] = field(default_factory=list)

    def add(self, key: str, said: str, value: Any = None) -> None:
        """Note that the value of a key cannot be used.

        Raises:
            TooManyComplaintsError: this is the last one that is told.
        """
        written = "" if value is None else shown(value)
        complaint = Complaint(key, written, said)
        if complaint not in self.listed:
            self.listed.append(complaint)
        if len(self.listed) >= MOST_TOLD:
            raise TooManyComplaintsError

    def about(self, *keys: str) -> bool:
        """Whether something is wrong at these keys, or below them."""
        for complaint in self.listed:
            for key in keys:
                if complaint.key == key or complaint.key.startswith(f"{key}."):
                    return True
        return False


@dataclass(frozen=True)
class Part:
    """A table of the file.

    Attributes:
        key: where it stands, such as ``"data.states.q"``; "" for the file.
        content: what it holds.
        complaints: where what is wrong is noted.
    """

    key: str
    content: Mapping[str, Any]
    complaints: Complaints

    def path(self, name: str) -> str:
        """The key of an entry, from the top of the file."""
        written = key_text(name)
        return f"{self.key}.{written}" if self.key else written

    def complain(self, name: str, said: str) -> None:
        """Note that the value of an entry cannot be used."""
        self.complaints.add(self.path(name), said, self.content.get(name))

    def check_known(self, table: str) -> None:
        """Note keys that such a table does not have."""
        known = known_keys(table)
        if OWN_NAMES in known:
            return
        for name in self.content:
            if name not in known:
                self.complain(
                    name,
                    f"this key is unknown here; known are {', '.join(known)}."
                    f"{did_you_mean(name, known)}",
                )

    def text(self, name: str, default: str = "") -> str:
        """A text."""
        value = self.content.get(name, default)
        if isinstance(value, str):
            return value
        self.complain(name, 'expected text in quotes, such as "m".')
        return default

    def column(self, name: str) -> str | int | None:
        """A column: its header, or its position counted from 0; None where none is."""
        value = self.content.get(name, "")
        is_position = isinstance(value, int) and not isinstance(value, bool)
        if is_position and value >= 0:
            return int(value)
        if not isinstance(value, str):
            self.complain(
                name, 'expected a header in quotes, such as "q", or a position from 0.'
            )
            return None
        return value or None

    def texts(self, name: str, example: str = '["q", "p"]') -> tuple[str, ...]:
        """A list of texts; one text stands for a list of it."""
        value = self.content.get(name, [])
        if isinstance(value, str):
            return (value,)
        if isinstance(value, list) and all(isinstance(one, str) for one in value):
            return tuple(value)
        self.complain(name, f"expected a list of texts, such as {example}.")
        return ()

    def number(self, name: str, default: float | None = None) -> float | None:
        """A number."""
        value = self.content.get(name, default)
        if value is None or is_number(value):
            return value
        self.complain(name, "expected a number, such as 0.5, without quotes.")
        return default

    def numbers(self, name: str) -> tuple[float, ...]:
        """A list of numbers."""
        value = self.content.get(name, [])
        if isinstance(value, list) and all(map(is_number, value)):
            return tuple(value)
        self.complain(name, "expected a list of numbers, such as [0.25, 0.5].")
        return ()

    def whole(self, name: str, default: int | None = None) -> int | None:
        """A whole number of at least 1."""
        value = self.content.get(name, default)
        if value is None or (is_number(value) and isinstance(value, int) and value > 0):
            return value
        self.complain(name, "expected a whole number of at least 1.")
        return default

    def flag(self, name: str, default: bool = False) -> bool:
        """True or false."""
        value = self.content.get(name, default)
        if isinstance(value, bool):
            return value
        self.complain(name, "expected true or false, without quotes.")
        return default

    def one_of(self, name: str, options: Sequence[str], default: str) -> str:
        """One of some texts."""
        value = self.content.get(name, default)
        if value in options:
            return str(value)
        listed = " or ".join(map(shown, options))
        self.complain(name, f"expected {listed}.{did_you_mean(value, options)}")
        return default

    def part(self, name: str, table: str | None = None) -> "Part":
        """A table below; empty where there is none.

        Args:
            name: its name.
            table: where its known keys are listed; default: under its own key.
        """
        content = self.content.get(name, {})
        if not isinstance(content, Mapping):
            self.complain(name, 'expected a table, such as { unit = "m" }.')
            content = {}
        below = Part(self.path(name), content, self.complaints)
        below.check_known(below.key if table is None else table)
        return below

    def parts(self, table: str) -> Iterator[tuple[str, "Part"]]:
        """The tables below, by name; ``table`` lists their known keys."""
        for name in self.content:
            yield name, self.part(name, table)

    def exactly_one(self, names: Iterable[str]) -> str:
        """The one of several keys that is there; "" where none or several are."""
        options = tuple(names)
        given = [name for name in options if name in self.content]
        if len(given) == 1:
            return given[0]
        listed = " or ".join(options)
        found = "none" if not given else " and ".join(given)
        self.complaints.add(
            self.key, f"expected exactly one of {listed}; found {found}."
        )
        return ""


def is_number(value: Any) -> bool:
    """Whether a value of a file is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)
