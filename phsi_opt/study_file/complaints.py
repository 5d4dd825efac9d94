"""What is wrong with a study file: collected, not raised, so that all is told at once.

What cannot be used is noted and left out, and reading goes on.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from phsi_opt.errors import Complaint
from phsi_opt.study_file.toml_text import key_text, toml_value

SHOWN_CHARACTERS = 60  # of a value, in a message
MOST_TOLD = 100  # complaints; a person corrects fewer before the next look


class TooManyComplaintsError(Exception):
    """So much is wrong that the rest of a file is not looked at."""


def shown(value: Any) -> str:
    """A value as the file has it, cut where it is long."""
    text = toml_value(value)
    is_short = len(text) <= SHOWN_CHARACTERS
    return text if is_short else f"{text[:SHOWN_CHARACTERS]}..."


def path_of(table: str, name: str) -> str:
    """The key of an entry of a table, from the top of the file."""
    return f"{table}.{key_text(name)}" if table else key_text(name)


@dataclass
class Complaints:
    """What is wrong with a file, in the order in which it was found."""

    listed: list[Complaint] = field(default_factory=list)

    @property
    def is_full(self) -> bool:
        """Whether as many are noted as are told."""
        return len(self.listed) >= MOST_TOLD

    def add(self, key: str, said: object, value: Any = None) -> None:
        """Note that the value of a key cannot be used.

        Raises:
            TooManyComplaintsError: this is the last one that is told.
        """
        complaint = Complaint(key, "" if value is None else shown(value), str(said))
        if complaint not in self.listed:
            self.listed.append(complaint)
        if self.is_full:
            raise TooManyComplaintsError

    def about(self, *keys: str) -> bool:
        """Whether something is wrong at these keys, or below them."""
        below = tuple(f"{key}{sign}" for key in keys for sign in ".[")
        found = [complaint.key for complaint in self.listed]
        return any(key in keys or key.startswith(below) for key in found)


@dataclass(frozen=True)
class Part:
    """A table of the file, with what is usable of it.

    Attributes:
        key: where it stands, such as ``"data.states.q"``; "" for the file.
        content: what it holds.
        complaints: where what is wrong is noted.
    """

    key: str
    content: Mapping[str, Any]
    complaints: Complaints

    def get(self, name: str, default: Any = None) -> Any:
        """The value of a key, or the default."""
        return self.content.get(name, default)

    def path(self, name: str) -> str:
        """The key of an entry, from the top of the file."""
        return path_of(self.key, name)

    def complain(self, name: str, said: object) -> None:
        """Note that the value of an entry cannot be used."""
        self.complaints.add(self.path(name), said, self.get(name))

    def is_told(self, name: str) -> bool:
        """Whether a key is there, usable or not."""
        return name in self.content or self.complaints.about(self.path(name))

    def need(self, name: str, said: str) -> None:
        """Note that an entry is missing, or empty."""
        if self.get(name, "") in ("", [], [""], {}) and not self.complaints.about(
            self.path(name)
        ):
            self.complaints.add(self.path(name), said)

    def part(self, name: str) -> "Part":
        """A table below; empty where there is none."""
        return Part(self.path(name), self.get(name, {}), self.complaints)

    def exactly_one(self, *names: str) -> str:
        """The one of several keys that is there; "" where none or several are."""
        given = [name for name in names if self.is_told(name)]
        if len(given) == 1:
            return given[0]
        found = " and ".join(given) or "none"
        listed = " or ".join(names)
        self.complaints.add(
            self.key, f"expected exactly one of {listed}; found {found}."
        )
        return ""


def texts(value: str | Iterable[str]) -> tuple[str, ...]:
    """A list of texts; one text stands for a list of it."""
    return (value,) if isinstance(value, str) else tuple(value)
