"""Values as Python would write them, without what nobody chose or reads."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any


def chosen_fields(record: Any) -> dict[str, Any]:
    """The fields of a dataclass that are not at their defaults."""
    chosen = {}
    for one in fields(record):
        value = getattr(record, one.name)
        default = one.default
        if one.default_factory is not MISSING:
            default = one.default_factory()
        if value != default:
            chosen[one.name] = value
    return chosen


def short_repr(record: Any) -> str:
    """``Class(field=value, ...)`` of a dataclass, without fields at their defaults."""
    parts = []
    for name, value in chosen_fields(record).items():
        shown = dict(value) if isinstance(value, Mapping) else value
        parts.append(f"{name}={shown!r}")
    return f"{type(record).__name__}({', '.join(parts)})"


def short_number(value: Any) -> str:
    """A value as Python writes it, but for whole numbers of very many digits."""
    is_long = isinstance(value, int) and abs(value) > 10**12
    return "a number beyond 10**12" if is_long else repr(value)


def shortened(text: str, most: int) -> str:
    """The text, cut where it has more characters than ``most``."""
    return text if len(text) <= most else f"{text[:most]}..."
