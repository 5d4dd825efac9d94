"""Channels of a logger's file, in groups of common times, before they are read."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

TIME = "time"
NO_NUMBERS = "its values are arrays, texts or bytes"


class Signal(NamedTuple):
    """A channel that can be read, or the reason why it cannot be."""

    name: str
    unit: Any
    values: Callable[[], np.ndarray]
    why_not: str = ""


@dataclass
class Group:
    """Channels with common times."""

    n_samples: int
    size: int  # bytes, as the file states them
    channels: list[Signal] = field(default_factory=list)
