"""The checks that all measurements pass, wherever they come from.

Every check raises `DataError`, which names the offender, its value, what is expected
and how to repair it. A function called ``checked_...`` returns what it checked, in the
form in which `Measurements` keeps it. Nothing is repaired, interpolated or scaled here.
"""

import keyword
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from phsi_opt.arguments import is_size, require_known
from phsi_opt.errors import DataError, PhsiOptError, did_you_mean, shown
from phsi_opt.presentation.units import unit_of

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
# what may be given by a channel's name: noun, type, test, and what is expected
BY_NAME: dict[str, tuple[str, Callable[[Any], Any], Callable[[Any], bool], str]] = {
    "units": (
        "unit",
        unit_of,
        str.isprintable,
        "text such as 'm' in one line, or '' when unknown",
    ),
    "noise": (
        "standard deviation",
        float,
        lambda sigma: is_size(sigma) and sigma > 0,
        "a positive number in the state's unit; leave it out when it is unknown",
    ),
    "labels": ("label", str, str.isprintable, "text in one line"),
    "hold": ("hold", str, HOLDS.__contains__, "'linear', 'zero' or 'cubic'"),
}


def read_only_floats(values: Any, n_axes: int, title: str) -> np.ndarray:
    """A read-only float64 copy of an array with one or two axes.

    Masked entries become NaN, not measured; (n_samples,) may stand for (n_samples, 1).
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
        kind = "text" if array.dtype.kind in "US" else array.dtype
        raise DataError(
            f"{title} has the type {kind}; expected real numbers, and NaN for missing "
            "values. Convert it by astype(float); dates are read by from_dataframe."
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
    """Whole numbers that floats cannot hold, counted from the first; all else as it is.

    Nanoseconds since 1970 are 1.7e18, where neighbouring floats are 256 apart. What
    stands in ``first`` begins with the one to count from; (): the values.
    """
    try:
        whole = np.asarray(values)
    except ValueError:  # `read_only_floats` says of which this is
        return values
    if whole.dtype.kind not in "iu" or not (whole.ndim and whole.size):
        return values
    begin = int(np.asarray(first if np.size(first) else whole).flat[0])
    if max(abs(int(whole.max())), abs(int(whole.min()))) <= LARGEST_EXACT:
        return values
    return (whole.astype(object) - begin).astype(np.int64)


def check_values(
    values: np.ndarray, place_of: Callable[..., str], may_be_missing: bool
) -> None:
    """Refuse infinite and huge values, and NaN where no sample may be missing.

    The array is (n_samples,) or (n_samples, n_channels); ``place_of`` gives the words
    for the place of the value with these indices.
    """
    is_bad = np.abs(values) > LARGEST_VALUE
    if not may_be_missing:
        is_bad |= np.isnan(values)
    if not is_bad.any():
        return
    place = np.unravel_index(np.argmax(is_bad), is_bad.shape)
    value = values[place]
    if np.isnan(value):
        expected = (
            "times and inputs must be known at every sample. Drop the sample or fill "
            "the gap."
        )
    elif np.isinf(value):
        expected = (
            "expected a finite value. Correct it; a state that was not measured is NaN."
        )
    else:
        expected = (
            f"expected at most {LARGEST_VALUE:g} in size. Correct it or choose a "
            "larger unit."
        )
    raise DataError(f"{place_of(*place)} is {value}; {expected}")


def check_unique(
    names: Sequence[str], what: str, error: type[PhsiOptError] = DataError
) -> None:
    """Refuse a name that is used twice; ``what`` is such as "trajectory name"."""
    for name, n_uses in Counter(names).items():
        if n_uses > 1:
            raise error(
                f"the {what} {name!r} is used {n_uses} times; "
                "each must be used once. Rename one."
            )


def checked_names(
    names: Sequence[str],
    what: str,
    reserved: Collection[str] = RESERVED_NAMES,
    error: type[PhsiOptError] = DataError,
) -> tuple[str, ...]:
    """Names of channels that formulas can use: "states", "inputs" or "memory".

    There must be at least one state; those of derivatives are reserved, and more.
    """
    listed = tuple(names)
    if what == "states" and not listed:
        raise error("states=[] names no state; expected at least one.")
    for name in listed:
        is_identifier = isinstance(name, str) and name.isidentifier()
        if not is_identifier or keyword.iskeyword(name):
            raise error(
                f"{what}: {shown(name)} cannot be used in a formula; "
                "expected letters, digits, _ as in 'q_1'; several names as a list."
            )
        if name in reserved or name.startswith(RESERVED_PREFIXES):
            raise error(
                f"{what}: the name {name!r} is reserved, as are {', '.join(reserved)} "
                f"and the derivatives {'... and '.join(RESERVED_PREFIXES)}...; choose "
                "another name, to which a column can be mapped."
            )
    return listed


def checked_by_name(
    given: Mapping[str, Any], names: Sequence[str], what: str
) -> dict[str, Any]:
    """What ``what`` says of channels, such as "units", by name, in the given order."""
    noun, kept_as, fits, expected = BY_NAME[what]
    for name, value in given.items():
        require_known(name, names, f"{what} names the unknown {name!r}", DataError)
        if not fits(value):
            hint = did_you_mean(value, HOLDS) if what == "hold" else ""
            raise DataError(
                f"{what}: {name!r} has the {noun} {shown(value)}; "
                f"expected {expected}.{hint}"
            )
    return {name: kept_as(value) for name, value in given.items()}


def hold_of_each(hold: Any, inputs: Sequence[str]) -> np.ndarray:
    """What each input does between samples: words of `HOLDS`, (n_inputs,).

    An input that a mapping leaves out is "linear".
    """
    if isinstance(hold, Mapping):
        given = checked_by_name(hold, inputs, "hold")
        return np.array([given.get(name, "linear") for name in inputs], dtype=str)
    require_known(hold, HOLDS, f"hold={shown(hold)} is unknown", DataError)
    return np.full(len(inputs), hold)


def checked_hold(hold: Any, inputs: Sequence[str]) -> str | dict[str, str]:
    """One of `HOLDS` for all inputs, or one by input if they differ."""
    of_each = hold_of_each(hold, inputs).tolist()
    if isinstance(hold, str):
        return hold
    if len(set(of_each)) > 1:
        return dict(zip(inputs, of_each, strict=True))
    return of_each[0] if of_each else "linear"


def numbered_names(prefix: str, n: int) -> list[str]:
    """The names of n things that nobody named: "u1", "u2", ..."""
    return [f"{prefix}{i}" for i in range(1, n + 1)]
