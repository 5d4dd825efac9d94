"""Checks of settings: each names the setting, its value and what is expected.

They need no torch, so settings can be made, stored and compared without it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.transcription.integrators import integrator

DTYPES = ("float32", "float64")


def require(fine: bool, name: str, value: Any, expected: str, hint: str = "") -> None:
    """Let a setting pass, or say what is wrong with it.

    Raises:
        ModelError: unless ``fine``; it names the setting, its value and the expected.
    """
    if not fine:
        raise ModelError(
            f"{name}={value!r} is not possible; expected {expected}.{hint}"
        )


def require_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Check that the value is one of the choices, or name the closest of them."""
    expected = f"one of {', '.join(choices)}"
    hint = did_you_mean(value, choices)
    require(value in choices, name, value, expected, hint)


def require_count(name: str, value: Any, or_none: bool = False) -> None:
    """Check that the value is a whole number of at least 1 (or None)."""
    fine = (or_none and value is None) or is_count(value)
    expected = "a whole number of at least 1" + (", or None" if or_none else "")
    require(fine, name, value, expected)


def require_size(name: str, value: Any) -> None:
    """Check that the value is a finite number of at least 0."""
    require(is_size(value), name, value, "a finite number of at least 0")


def require_positive(name: str, value: Any, or_none: bool = False) -> None:
    """Check that the value is a number above 0 (or None)."""
    fine = (or_none and value is None) or is_size(value, positive=True)
    expected = "a number above 0" + (", or None" if or_none else "")
    require(fine, name, value, expected)


def check_descent(settings: Any) -> None:
    """Check what all descents have in common.

    Args:
        settings: with learning_rate, epochs, batch, weight_decay, dtype, and perhaps
            integrator.

    Raises:
        ModelError: if one of them is not possible.
    """
    require_positive("learning_rate", settings.learning_rate)
    require_count("epochs", settings.epochs)
    require_count("batch", settings.batch)
    require_size("weight_decay", settings.weight_decay)
    known = settings.dtype in DTYPES
    require(known, "dtype", settings.dtype, f"one of {', '.join(DTYPES)}")
    if hasattr(settings, "integrator"):
        integrator(settings.integrator)


def is_count(value: Any) -> bool:
    """Whether the value is a whole number of at least 1."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and bool(value >= 1)


def is_size(value: Any, positive: bool = False) -> bool:
    """Whether the value is a finite number of at least (or above) zero."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    inside = value > 0 if positive else value >= 0
    return bool(np.isfinite(value) and inside)
