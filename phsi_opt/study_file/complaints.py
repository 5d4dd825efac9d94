"""What is wrong with a study file: collected, not raised, so that all is told at once.

What cannot be used is noted and left out, and reading goes on. A place in the file is
the names and numbers that lead to it from the top, as in ``("data", "states", "q")``.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from phsi_opt.errors import Complaint, DataError, ModelError
from phsi_opt.presentation.numbers import shortened
from phsi_opt.study_file.toml_text import key_text, toml_value

Place = tuple[str | int, ...]


class TooManyComplaintsError(Exception):
    """So much is wrong that the rest of a file is not looked at."""


def shown(value: Any) -> str:
    """A value as the file has it, cut where it is long."""
    return shortened(toml_value(value), 60)


def key_of(place: Place) -> str:
    """The key of a place, such as ``"effects[0].name"``."""
    key = ""
    for one in place:
        key += f"[{one}]" if isinstance(one, int) else f".{key_text(one)}"
    return key.removeprefix(".")


@dataclass
class Complaints:
    """What is wrong with a file, in the order in which it was found.

    Attributes:
        content: the tables of the file.
        listed: what is wrong.
    """

    content: Mapping[str, Any]
    listed: list[Complaint] = field(default_factory=list)

    @property
    def is_full(self) -> bool:
        """Whether more are noted than a person corrects before the next look."""
        return len(self.listed) >= 100

    def place(self, place: Place) -> Place:
        """The place without the number of one that stands for a list of it."""
        found: list[str | int] = []
        content: Any = self.content
        for part in place:
            if isinstance(part, int) and not isinstance(content, list):
                continue
            found.append(part)
            content = _entry(content, part)
        return tuple(found)

    def add(self, said: object, *place: str | int, value: Any = None) -> None:
        """Note that what stands at a place cannot be used.

        Args:
            said: what was expected and what to do.
            *place: where it stands.
            value: the part of it that is meant; None: all of it; "": nothing.

        Raises:
            TooManyComplaintsError: this is the last one that is told.
        """
        place = self.place(place)
        if value is None:
            value = self.content
            for part in place:
                value = _entry(value, part)
        told = "" if value in (None, "") else shown(value)
        complaint = Complaint(key_of(place), told, str(said))
        if complaint not in self.listed:
            self.listed.append(complaint)
        if self.is_full:
            raise TooManyComplaintsError

    def need(self, said: str, value: Any, *place: str | int) -> None:
        """Note that nothing stands at a place, where nothing else is wrong with it."""
        if value in (None, "", (), ("",), {}) and not self.about(*place):
            self.add(said, *place, value="")

    @contextmanager
    def noting(self, *place: str | int, value: Any = None) -> Iterator[None]:
        """Note an error as one of a place; what stands behind it is not done."""
        try:
            yield
        except (DataError, ModelError) as error:
            self.add(error, *place, value=value)

    def about(self, *place: str | int) -> bool:
        """Whether something is wrong at a place, or below it."""
        key = key_of(place)
        below = (f"{key}.", f"{key}[")
        found = [complaint.key for complaint in self.listed]
        return any(one == key or one.startswith(below) for one in found)

    def exactly_one(
        self, content: Mapping[str, Any], names: tuple[str, ...], *place: str | int
    ) -> str:
        """The one of several keys that is there; "" where none or several are.

        Args:
            content: what is usable of their table.
            names: the keys.
            *place: of the table.
        """
        given = [one for one in names if one in content or self.about(*place, one)]
        if len(given) == 1:
            return given[0]
        told = " and ".join(given) or "none"
        said = f"expected exactly one of {' or '.join(names)}; found {told}."
        self.add(said, *place, value="")
        return ""


def _entry(content: Any, part: str | int) -> Any:
    try:
        return content[part]
    except (KeyError, IndexError, TypeError):
        return None
