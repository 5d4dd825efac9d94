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
    """A model, a term or an effect contradicts itself or does not fit the measurements."""


class SolveError(PhsiOptError, RuntimeError):
    """An optimisation or a simulation did not reach a result."""


def did_you_mean(name: object, options: Iterable[object]) -> str:
    """`" Did you mean 'x'?"` for the option closest to `name` (ignoring case), `""`
    when none is close.
    """
    by_lower = {str(option).lower(): str(option) for option in options}
    matches = difflib.get_close_matches(str(name).lower(), by_lower, n=1)
    return f" Did you mean {by_lower[matches[0]]!r}?" if matches else ""
