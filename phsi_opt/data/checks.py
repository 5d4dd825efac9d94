"""The checks that all measurements pass, wherever they come from.

Every check raises `DataError`, which names the offender, its value, what is expected
and how to repair it. A function called ``checked_...`` returns what it checked, in the
form in which `Measurements` keeps it. Nothing is repaired, interpolated or scaled here.
Only the caller knows which file, cell or sample a value came from, so it hands over the
words for that place.
"""

import keyword
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.errors import DataError, PhsiOptError, did_you_mean

# what inputs do between samples: a straight line to the next, the sample's value until
# the next, or a cubic spline through all of them
HOLDS = ("linear", "zero", "cubic")
Hold = str | Mapping[str, str]  # one of them for all inputs, or by the input's name
LARGEST_EXACT = 2**53  # up to which every whole number is a float
# the time in formulas; the first column of `Measurements.to_dataframe`
RESERVED_NAMES = ("t", "trajectory")
# Formulas write dH_dp for the effort dH/dp, and dF_du for the slope dF/du.
RESERVED_PREFIXES = ("dH_d", "dF_d")
# sums of squares of larger values come near the end of the range of float64, 1.8e308
LARGEST_VALUE = 1e100


def read_only_floats(values: Any, n_axes: int, title: str) -> np.ndarray:
    """A read-only float64 copy of an array.

    Args:
        values: Real numbers, (n_samples,) or (n_samples, n_channels). Masked entries
            become NaN, which says that they were not measured.
        n_axes: The number of axes that the copy has, 1 or 2; (n_samples,) may stand
            for (n_samples, 1).
        title: What messages call the array.

    Raises:
        DataError: The values are no regular array, not real, or in another shape.
    """
    try:
        # As it is where it is an array: masked ones cost more, and few are.
        is_plain = type(values) is np.ndarray
        array: np.ndarray = values if is_plain else np.ma.asanyarray(values)
    except ValueError as error:
        raise DataError(
            f"{title} is not a regular array ({error}); "
            "every row must have the same length."
        ) from error
    if array.dtype.kind not in "biuf":
        raise DataError(
            f"{title} has the type {array.dtype}; "
            "expected real numbers, NaN where nothing was measured."
        )
    if n_axes == 2 and array.ndim == 1:  # a single channel
        array = array[:, np.newaxis]
    if array.ndim != n_axes:
        expected = "(n_samples,)" if n_axes == 1 else "(n_samples, n_channels)"
        raise DataError(
            f"{title} has the shape {array.shape}; expected {expected}. "
            "Reshape the array."
        )
    floats: np.ndarray = np.array(array, dtype=np.float64, subok=True)
    if isinstance(floats, np.ma.MaskedArray):
        floats = floats.filled(np.nan)
    floats.flags.writeable = False
    return floats


def from_first(values: Any, first: Any = ()) -> Any:
    """Whole numbers that floats cannot hold, counted from the first of them.

    Nanoseconds since 1970 are 1.7e18, where neighbouring floats are 256 apart. All else
    stays as it is.

    Args:
        values: (n_samples,) times.
        first: those that begin with the one to count from; (): these.
    """
    whole = np.asarray(values)
    if whole.dtype.kind not in "iu" or not whole.size:
        return values
    begin = int(np.asarray(first if np.size(first) else whole).flat[0])
    if max(abs(int(whole.max())), abs(int(whole.min()))) <= LARGEST_EXACT:
        return values
    return (whole.astype(object) - begin).astype(np.int64)


def check_values(
    values: np.ndarray, place_of: Callable[..., str], may_be_missing: bool
) -> None:
    """Refuse infinite and huge values, and NaN where no sample may be missing.

    Args:
        values: (n_samples,) or (n_samples, n_channels).
        place_of: The words for the place of the value with these indices.
        may_be_missing: Whether NaN is allowed.

    Raises:
        DataError: A value cannot be used; the first one is named.
    """
    bad = np.abs(values) > LARGEST_VALUE
    if not may_be_missing:
        bad |= np.isnan(values)
    if not bad.any():
        return
    place = np.unravel_index(np.argmax(bad), bad.shape)
    value = values[place]
    said = f"{place_of(*place)} is {value};"
    if np.isnan(value):
        raise DataError(
            f"{said} times and inputs must be known at every sample. "
            "Drop the sample or fill the gap."
        )
    if np.isinf(value):
        raise DataError(
            f"{said} expected a finite value. "
            "Correct it; a state that was not measured is NaN."
        )
    raise DataError(
        f"{said} expected at most {LARGEST_VALUE:g} in size. "
        "Correct it or choose a larger unit."
    )


def check_same_length(sequences: Mapping[str, Any], expected: str) -> None:
    """Refuse sequences of different lengths.

    Args:
        sequences: What must have one length, by the name that messages use.
        expected: The rule in words, such as "one entry per trajectory".

    Raises:
        DataError: The lengths differ, or one of the values has no length.
    """
    lengths = {}
    for name, values in sequences.items():
        lengths[name] = len(values) if hasattr(values, "__len__") else None
    if len(set(lengths.values())) > 1:
        raise DataError(
            f"the lengths differ: {lengths}; expected {expected}. "
            "Check that the lists belong together."
        )


def check_unique(
    names: Sequence[str], what: str, error: type[PhsiOptError] = DataError
) -> None:
    """Refuse a name that is used more than once.

    Args:
        names: The names.
        what: What messages call one of them, such as "trajectory name".
        error: What is raised.

    Raises:
        PhsiOptError: A name is used twice or more.
    """
    for name, n_uses in Counter(names).items():
        if n_uses > 1:
            raise error(
                f"the {what} {name!r} is used {n_uses} times; "
                "each must be used once. Rename one."
            )


def checked_names(
    names: Any,
    what: str,
    reserved: Collection[str] = RESERVED_NAMES,
    error: type[PhsiOptError] = DataError,
) -> tuple[str, ...]:
    """Names of channels that formulas can use.

    Args:
        names: Several names in their order.
        what: "states", "inputs" or "memory"; there must be at least one state.
        reserved: Names that stand for something else, beside those of derivatives.
        error: What is raised.

    Raises:
        PhsiOptError: This is no list of names, or a name is no identifier or is
            reserved.
    """
    if isinstance(names, str | set) or not isinstance(names, Iterable):
        raise error(
            f"{what}={names!r} is not a list of names; expected e.g. {what}=['a', 'b']."
        )
    listed = tuple(names)
    if what == "states" and not listed:
        raise error("states=[] names no state; expected at least one.")
    for name in listed:
        is_identifier = isinstance(name, str) and name.isidentifier()
        if not is_identifier or keyword.iskeyword(name):
            raise error(
                f"{what}: {name!r} cannot be used in a formula; "
                "expected letters, digits, _ as in 'q_1'."
            )
        if name in reserved or name.startswith(RESERVED_PREFIXES):
            raise error(
                f"{what}: the name {name!r} is reserved, as are {', '.join(reserved)} "
                f"and the derivatives {'... and '.join(RESERVED_PREFIXES)}...; choose "
                "another name, to which a column can be mapped."
            )
    return listed


class _Entry(NamedTuple):
    """What is told of a channel by its name: what it is, and what it may be."""

    noun: str
    kept_as: type
    fits: Callable[[Any], bool]
    expected: str


BY_NAME = {
    "units": _Entry(
        "unit",
        str,
        lambda unit: isinstance(unit, str) and unit.isprintable(),
        "text such as 'm' in one line, or '' when unknown",
    ),
    "noise": _Entry(
        "standard deviation",
        float,
        lambda sigma: isinstance(sigma, Real) and 0 < float(sigma) < np.inf,
        "a positive number in the state's unit; leave it out when it is unknown",
    ),
    "hold": _Entry(
        "hold", str, lambda word: word in HOLDS, "'linear', 'zero' or 'cubic'"
    ),
}


def checked_by_name(told: Any, names: Sequence[str], what: str) -> dict[str, Any]:
    """What is told of channels by their names, in the order in which it is told.

    Args:
        told: A mapping from names.
        names: Those that there are.
        what: A name in `BY_NAME`.

    Raises:
        DataError: This is no mapping, or an entry cannot be used.
    """
    if not isinstance(told, Mapping):
        example = names[-1] if names else "u"
        raise DataError(
            f"{what}={told!r} is not a mapping; expected e.g. {{{example!r}: ...}}."
        )
    entry = BY_NAME[what]
    for name, value in told.items():
        said = f"{what} names the unknown {name!r}"
        require_known(name, names, said, DataError)
        if not entry.fits(value):
            hint = did_you_mean(value, HOLDS) if what == "hold" else ""
            raise DataError(
                f"{what}: {name!r} has the {entry.noun} {value!r}; "
                f"expected {entry.expected}.{hint}"
            )
    return {name: entry.kept_as(value) for name, value in told.items()}


def hold_of_each(hold: Any, inputs: Sequence[str]) -> np.ndarray:
    """What each input does between samples: words of `HOLDS`, (n_inputs,).

    An input that a mapping leaves out is "linear".

    Args:
        hold: One of `HOLDS` for all inputs, or a mapping from their names.
        inputs: The names of the inputs.

    Raises:
        DataError: It is none of them, or an input is unknown.
    """
    if isinstance(hold, Mapping):
        told = dict.fromkeys(inputs, "linear") | checked_by_name(hold, inputs, "hold")
        return np.array(list(told.values()), dtype=str)
    require_known(hold, HOLDS, f"hold={hold!r} is unknown", DataError)
    return np.array([hold] * len(inputs), dtype=str)


def checked_hold(hold: Any, inputs: Sequence[str]) -> str | dict[str, str]:
    """What inputs do between samples: one of `HOLDS`, or one by input if they differ.

    Raises:
        DataError: It is none of them, or an input is unknown.
    """
    by_input = dict(zip(inputs, hold_of_each(hold, inputs).tolist(), strict=True))
    if isinstance(hold, str):
        return hold
    words = list(dict.fromkeys(by_input.values())) or ["linear"]
    return by_input if len(words) > 1 else words[0]


def numbered_names(prefix: str, n: int) -> list[str]:
    """The names of n things that nobody named: "u1", "u2", ..."""
    return [f"{prefix}{i}" for i in range(1, n + 1)]
