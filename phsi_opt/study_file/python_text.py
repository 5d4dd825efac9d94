"""Python source from values: calls with their arguments, broken where they are long."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

SOURCE_WIDTH = 88  # of a line of source
INDENT = "    "


@dataclass(frozen=True)
class Code:
    """Source that is written as it is."""

    source: str

    def text(self, depth: int = 0) -> str:
        """The source."""
        return self.source

    @classmethod
    def of(cls, value: Any) -> "Code":
        """The source of a value."""
        return cls(source_of(value))


@dataclass(frozen=True)
class Call:
    """A call of a function or class."""

    name: str
    positional: Sequence[Any]
    named: Mapping[str, Any]

    def text(self, depth: int = 0) -> str:
        """The source; an argument a line where it is long.

        Args:
            depth: how deep the call stands.
        """
        parts = [source_of(value, depth + 1) for value in self.positional]
        for name, value in self.named.items():
            parts.append(f"{name}={source_of(value, depth + 1)}")
        return _enclosed(f"{self.name}(", parts, ")", depth)


def source_of(value: Any, depth: int = 0) -> str:
    """The source of numbers, texts, lists, tuples, mappings, calls and code."""
    if isinstance(value, Code | Call):
        return value.text(depth)
    if isinstance(value, Mapping):
        pairs = []
        for name, one in value.items():
            pairs.append(f"{source_of(name)}: {source_of(one, depth + 1)}")
        return _enclosed("{", pairs, "}", depth)
    if isinstance(value, list):
        items = [source_of(one, depth + 1) for one in value]
        return _enclosed("[", items, "]", depth)
    if isinstance(value, tuple):
        items = [f"{source_of(one)}," for one in value]
        return f"({' '.join(items)})"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)  # in double quotes
    if isinstance(value, float) and value in (float("inf"), float("-inf")):
        return f'float("{value}")'
    return repr(value)


def _enclosed(opening: str, parts: list[str], closing: str, depth: int) -> str:
    """On one line where that fits, else a part a line."""
    flat = f"{opening}{', '.join(parts)}{closing}"
    indent = INDENT * depth
    # The line begins with what the call is given to, of unknown length.
    fits = (
        len(indent) + len(flat) <= SOURCE_WIDTH - 2 * len(INDENT) and "\n" not in flat
    )
    if fits or not parts:
        return flat
    lines = [f"{indent}{INDENT}{part}," for part in parts]
    return "\n".join([opening, *lines, f"{indent}{closing}"])


@dataclass
class Names:
    """The names that a script imports from modules of the package."""

    asked: set[tuple[str, str]] = field(default_factory=set)

    def ask(self, module: str, name: str) -> None:
        """Import a name."""
        self.asked.add((module, name))

    def imports(self) -> list[str]:
        """The lines that import them, sorted."""
        lines = []
        for module in sorted({module for module, _ in self.asked}):
            names = sorted(name for place, name in self.asked if place == module)
            lines.append(f"from {module} import {', '.join(names)}")
        return lines
