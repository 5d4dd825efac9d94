"""Words for numbers, names and channels, as messages and summaries print them."""

import numpy as np


def number_of(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun, such as "1 sample" and "3 samples".

    Args:
        n: The number.
        noun: The noun for one.
        plural: The noun for several, where an s at the end is not enough.
    """
    if n == 1:
        return f"1 {noun}"
    return f"{n} {plural or noun + 's'}"


def numbered_names(prefix: str, n: int) -> list[str]:
    """The names of n things that nobody named: "u1", "u2", ..."""
    return [f"{prefix}{i}" for i in range(1, n + 1)]


def in_brackets(unit: str) -> str:
    """The end of a channel's name: " [m]" for the unit "m", nothing for none."""
    return f" [{unit}]" if unit else ""


def extent_of(values: np.ndarray) -> str:
    """How many of a channel's values (n_samples,) were measured, and their range."""
    measured = values[np.isfinite(values)]
    if not measured.size:
        return "not measured"
    lowest = measured.min()
    highest = measured.max()
    n_measured = f"{measured.size} of {values.size} samples measured"
    return f"{n_measured}, {lowest:g} to {highest:g}"
