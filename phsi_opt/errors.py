"""The exceptions of the package.

Every message names the offender, its value, what was expected and how to repair it. One
common base lets a caller catch whatever this package raises on purpose; the standard
class beside it (`ValueError`, `RuntimeError`) lets code that does not know the package
catch it too. This file raises nothing itself.
"""

import difflib
from collections.abc import Iterable


class PhsiOptError(Exception):
    """Base of all errors which this package raises on purpose."""


class DataError(PhsiOptError, ValueError):
    """The measurements, or what was asked of them, cannot be used as they are."""


class ModelError(PhsiOptError, ValueError):
    """A model, a term or an effect contradicts itself or the measurements."""


class SolveError(PhsiOptError, RuntimeError):
    """An optimisation or a simulation did not reach a result."""


def did_you_mean(name: object, options: Iterable[object]) -> str:
    """The end of a message about an unknown name: a hint at the closest option.

    Args:
        name: What was asked for.
        options: What exists; case is ignored in the comparison.

    Returns:
        ``" Did you mean 'x'?"``, or ``""`` when no option is close.
    """
    by_lower_case = {str(option).lower(): str(option) for option in options}
    asked_for = str(name).lower()
    matches = difflib.get_close_matches(asked_for, by_lower_case, n=1)
    if not matches:
        return ""
    closest = by_lower_case[matches[0]]
    return f" Did you mean {closest!r}?"
