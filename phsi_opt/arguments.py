"""Checks of settings, each of which names the setting, its value and the expected."""

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import cache, wraps
from itertools import chain, cycle, repeat
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from phsi_opt.errors import (
    DataError,
    ModelError,
    PhsiOptError,
    did_you_mean,
    shown,
    some_of,
)

Call = TypeVar("Call", bound=Callable[..., Any])
types_of = cache(get_type_hints)
ACCEPTED: Mapping[Any, tuple[type, ...]] = {
    str: (str,),
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (int, float, np.integer, np.floating),
}
WRITTEN_AS = {  # by a word of the annotation
    "Measurements": "Create these with from_csv, from_dataframe or from_arrays.",
    "Trajectory": "Arrays: Measurements.from_arrays(t, x, states=[...]).",
    "Executor": "It has a method submit, as ProcessPoolExecutor(4) has.",
    "Fit": "A Fit is what identify returns.",
    "Model": "A Model, which comes first, is a PseudoHamiltonian or a FirstOrder.",
    "Loss": "Write PHSILoss() or MaximumLikelihood().",
    "Dictionary": "Write formula('...') or polynomials([...], n).",
    "Summarised": "Give what compare returns.",
    "Sequence": "Write a list, such as ['a', 'b'].",
    "Mapping": "Write a mapping, such as {'p': ...}.",
}
OF_DATA = re.compile("Measurements|Executor")  # their errors are of data


def typed(call: Call, error: type[PhsiOptError] = ModelError) -> Call:
    """Decorate a public function or record: it refuses arguments of other types.

    Checked is what the annotations say, down to the entries of lists and mappings. A
    list may be any collection with an order, and a bool is no number.

    Raises:
        PhsiOptError: it names the first argument of another type, its value, the type,
            and how it is made.
    """
    if isinstance(call, type):
        call.__init__ = typed(call.__init__, error)  # type: ignore[misc]
        return call
    names = list(inspect.signature(call).parameters)

    @wraps(call)
    def checked(*args: Any, **words: Any) -> Any:
        given = dict(zip(names, args, strict=False)) | words
        right = checked_types(given, types_of(call), error)
        named = [right[name] for name in names[: len(args)]]
        words = {name: right[name] for name in words}
        return call(*named, *args[len(names) :], **words)

    return checked  # type: ignore[return-value]


def checked_types(
    given: Mapping[str, Any],
    types: Mapping[str, Any],
    error: type[PhsiOptError] = ModelError,
) -> dict[str, Any]:
    """Values by name, checked against the types of these names."""
    found = {}
    for name, value in given.items():
        hint = types.get(name, Any)
        found[name] = value if is_of(value, hint) else as_list(value)
        if not is_of(found[name], hint):
            kind = re.sub(r"\b(\w++\.)+", "", inspect.formatannotation(hint))
            advice = map(WRITTEN_AS.__getitem__, filter(kind.__contains__, WRITTEN_AS))
            wrong = DataError if OF_DATA.search(kind) else error
            said = f"{name}={shown(value)} is not possible; expected {kind[:120]}."
            raise wrong(" ".join([said, *advice]))
    return found


def as_list(value: Any) -> Any:
    """A collection with an order, such as an index, as a list; others as they are."""
    is_other = isinstance(value, str | bytes | Mapping | set | frozenset)
    is_listed = isinstance(value, Collection) and np.iterable(value) and not is_other
    return list(value) if is_listed else value


@cache
def _kind_and_parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    return get_origin(hint) or hint, get_args(hint)


def is_of(value: Any, hint: Any) -> bool:
    """Whether a value, with all that it holds, is of the type of an annotation."""
    kind, parts = _kind_and_parts(hint)
    if kind in (Union, UnionType):
        return any(map(is_of, repeat(value), parts))
    if kind in ACCEPTED:
        is_bool = isinstance(value, bool | np.bool_)
        is_kind = isinstance(value, ACCEPTED[kind]) and is_bool == (kind is bool)
        is_kind = is_kind and not isinstance(value, np.timedelta64)  # a NumPy integer
        is_whole = is_kind and isinstance(value, int)
        return is_kind and not (is_whole and abs(value) >= 2**1023)  # beyond floats
    if kind is Any or not isinstance(kind, type):
        return True
    if kind is Executor:  # of any library
        return callable(getattr(value, "submit", None))
    if issubclass(kind, Mapping):
        is_kind = isinstance(value, Mapping)
        return is_kind and all(map(is_of, chain(*value.items()), cycle(parts)))
    if not issubclass(kind, Iterable) or not parts:
        return isinstance(value, kind)
    of_kind = Sequence if issubclass(kind, Sequence) else Iterable  # a list for a tuple
    is_kind = isinstance(value, of_kind) and np.iterable(value)  # no array of no axes
    if isinstance(value, str | bytes | Mapping) or not is_kind:
        return False
    is_once = isinstance(value, Iterator)
    return is_once or all(map(is_of, value, repeat(parts[0])))


def require(fine: bool, name: str, value: Any, expected: str) -> None:
    """Let a setting pass, or say what is wrong with it.

    Raises:
        ModelError: unless ``fine``; it names the setting, its value and the expected.
    """
    if not fine:
        raise ModelError(f"{name}={shown(value)} is not possible; expected {expected}.")


def require_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Check that the value is one of the choices, or name the closest of them."""
    require_known(value, choices, f"{name}={shown(value)} is not possible")


def require_known(
    name: Any, known: Iterable[Any], said: str, error: type[PhsiOptError] = ModelError
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
    try:
        is_known = name in dict.fromkeys(listed)
    except (TypeError, ValueError):  # such as a list, or an array, that has no hash
        is_known = False
    if not is_known:
        # A name with a blank or a comma is quoted, as are those beside it.
        are_words = all(isinstance(one, str) and one.isidentifier() for one in listed)
        words = map(str if are_words else shown, listed)
        expected = some_of(list(words)) or "none: there are no names"
        hint = did_you_mean(name, listed)
        raise error(f"{said}; expected one of {expected}.{hint}")


def require_count(name: str, value: Any) -> None:
    """Check that the value is a whole number of at least 1."""
    require(is_count(value), name, value, "a whole number of at least 1")


def require_size(name: str, value: Any) -> None:
    """Check that the value is a finite number of at least 0."""
    require(is_size(value), name, value, "a finite number of at least 0")


def require_positive(name: str, value: Any) -> None:
    """Check that the value is a number above 0."""
    require(is_size(value) and value > 0, name, value, "a number above 0")


def is_count(value: Any) -> bool:
    """Whether the value is a whole number of at least 1."""
    return is_of(value, int) and bool(1 <= value < 2**63)  # more cannot be shown


def is_size(value: Any) -> bool:
    """Whether the value is a finite number of at least zero."""
    return is_of(value, float) and bool(0 <= value < np.inf)


def require_share(
    name: str, value: Any, error: type[PhsiOptError] = ModelError
) -> None:
    """Check that the value is a number between 0 and 1, and neither of them."""
    if not is_size(value) or not 0 < value < 1:
        expected = "a number between 0 and 1, such as 0.95"
        raise error(f"{name}={shown(value)} is not possible; expected {expected}.")
