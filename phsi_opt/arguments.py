"""Checks of settings, each of which names the setting, its value and the expected."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError, PhsiOptError, did_you_mean, shown, some_of


def require(fine: bool, name: str, value: Any, expected: str, hint: str = "") -> None:
    """Let a setting pass, or say what is wrong with it.

    Raises:
        ModelError: unless ``fine``; it names the setting, its value and the expected.
    """
    if not fine:
        raise ModelError(
            f"{name}={shown(value)} is not possible; expected {expected}.{hint}"
        )


def require_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Check that the value is one of the choices, or name the closest of them."""
    require_known(value, choices, f"{name}={shown(value)} is not possible")


def require_known(
    name: Any,
    known: Iterable[Any],
    said: str,
    error: type[PhsiOptError] = ModelError,
) -> None:
    """Let a name pass that there is, or say which there are, and the closest of them.

    Args:
        name: what was asked for.
        known: what there is.
        said: how the message begins, such as "state 'v' is unknown".
        error: what is raised.

    Raises:
        PhsiOptError: there is no such name.
    """
    listed = list(known)
    if name not in listed:
        are_words = all(str(one).isidentifier() for one in listed)
        words = map(str if are_words else repr, listed)  # blanks, commas, numbers
        expected = some_of(list(words)) or "none: there are no names"
        hint = did_you_mean(name, listed)
        raise error(f"{said}; expected one of {expected}.{hint}")


def require_count(name: str, value: Any, or_none: bool = False) -> None:
    """Check that the value is a whole number of at least 1 (or None)."""
    fine = (or_none and value is None) or is_count(value)
    expected = "a whole number of at least 1" + (", or None" if or_none else "")
    require(fine, name, value, expected)


def require_size(name: str, value: Any) -> None:
    """Check that the value is a finite number of at least 0."""
    require(is_size(value), name, value, "a finite number of at least 0")


def require_positive(name: str, value: Any) -> None:
    """Check that the value is a number above 0."""
    require(is_size(value) and value > 0, name, value, "a number above 0")


def is_count(value: Any) -> bool:
    """Whether the value is a whole number of at least 1."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and bool(1 <= value < 2**63)  # more digits cannot be shown


def is_size(value: Any) -> bool:
    """Whether the value is a finite number of at least zero."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return bool(0 <= value < np.inf)
