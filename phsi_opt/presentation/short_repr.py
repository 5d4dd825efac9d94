"""A dataclass as Python would write it, without what nobody chose."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any


def short_repr(record: Any) -> str:
    """``Class(field=value, ...)`` of a dataclass, without fields at their defaults."""
    parts = []
    for one in fields(record):
        value = getattr(record, one.name)
        default = one.default
        if one.default_factory is not MISSING:
            default = one.default_factory()
        if value != default:
            shown = dict(value) if isinstance(value, Mapping) else value
            parts.append(f"{one.name}={shown!r}")
    return f"{type(record).__name__}({', '.join(parts)})"
