"""TODO."""

import keyword
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from types import MappingProxyType
from typing import Any

import numpy as np

from phsi_opt.errors import DataError, did_you_mean

HOLDS = ("linear", "zero")
RESERVED_NAMES = (
    "t",
    "trajectory",
)  # the time in formulas; the first column of to_dataframe
RESERVED_PREFIX = "dH_d"  # formulas write dH_dp for the velocity dH/dp
LARGEST = (
    1e100  # squares of larger values leave the range of float64 in sums of squares
)


def read_only_floats(values: Any, n_axes: int, where: str) -> np.ndarray:
    """A read-only float64 copy; masked entries become NaN, which says that they were
    not measured.
    """
    try:
        array = np.ma.asanyarray(values)
    except ValueError as error:
        raise DataError(
            f"{where} is not a regular array ({error}); every row must have the same length."
        ) from error
    if array.dtype.kind not in "biuf":
        raise DataError(
            f"{where} has the type {array.dtype}; expected real numbers, NaN where nothing was measured."
        )
    if array.ndim != n_axes:
        expected = "(n_samples,)" if n_axes == 1 else "(n_samples, n_channels)"
        raise DataError(
            f"{where} has the shape {array.shape}; expected {expected}. Reshape the array."
        )
    floats: np.ndarray = np.array(array.astype(np.float64).filled(np.nan))
    floats.flags.writeable = False
    return floats


def check_values(
    values: np.ndarray, where: Callable[[int], str], may_be_missing: bool
) -> None:
    """Refuse infinite and huge values, and NaN unless a sample may be missing; `where`
    names the i-th value.
    """
    bad = np.abs(values) > LARGEST
    if not may_be_missing:
        bad |= np.isnan(values)
    if not bad.any():
        return
    i = int(np.argmax(bad))
    if np.isnan(values[i]):
        problem = "is nan; times and inputs must be known at every sample. Drop the sample or fill the gap."
    elif np.isinf(values[i]):
        problem = f"is {values[i]}; expected a finite value. Correct it; a state that was not measured is NaN."
    else:
        problem = f"is {values[i]}; expected at most {LARGEST:g} in size. Correct it or choose a larger unit."
    raise DataError(f"{where(i)} {problem}")


def checked_names(names: Any, what: str) -> tuple[str, ...]:
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise DataError(
            f"{what}={names!r} is not a list of names; expected e.g. {what}=['a', 'b']."
        )
    if what == "states" and not names:
        raise DataError("states=[] names no state; expected at least one.")
    for name in names:
        if (
            not isinstance(name, str)
            or not name.isidentifier()
            or keyword.iskeyword(name)
        ):
            raise DataError(
                f"{what}: {name!r} cannot be used in a formula; expected letters, digits, _ as in 'q_1'."
            )
        if name in RESERVED_NAMES or name.startswith(RESERVED_PREFIX):
            raise DataError(
                f"{what}: the name {name!r} is reserved (the time 't', the column 'trajectory', the derivatives "
                f"'{RESERVED_PREFIX}...'); choose another name and map it to the column."
            )
    return tuple(names)


def check_unique(names: Sequence[str], what: str) -> None:
    twice = [(name, n_uses) for name, n_uses in Counter(names).items() if n_uses > 1]
    if twice:
        name, n_uses = twice[0]
        raise DataError(
            f"the {what} {name!r} is used {n_uses} times; each must be used once. Rename one."
        )


def checked_units(units: Any, names: tuple[str, ...]) -> Mapping[str, str]:
    _check_keys(units, names, "units")
    for name, unit in units.items():
        if not isinstance(unit, str):
            raise DataError(
                f"units: {name!r} has the unit {unit!r}; expected text such as 'm', or '' when unknown."
            )
    return MappingProxyType({name: units.get(name, "") for name in names})


def checked_noise(noise: Any, states: tuple[str, ...]) -> Mapping[str, float] | None:
    if noise is None:
        return None
    _check_keys(noise, states, "noise")
    for name, sigma in noise.items():
        if not isinstance(sigma, Real) or not 0 < float(sigma) < np.inf:
            raise DataError(
                f"noise: {name!r} has the standard deviation {sigma!r}; expected a positive number in the "
                "state's unit. Leave it out when it is unknown."
            )
    return MappingProxyType({name: float(sigma) for name, sigma in noise.items()})


def _check_keys(mapping: Any, names: tuple[str, ...], what: str) -> None:
    if not isinstance(mapping, Mapping):
        raise DataError(
            f"{what}={mapping!r} is not a mapping; expected e.g. {{{names[-1]!r}: ...}}."
        )
    for name in mapping:
        if name not in names:
            hint = did_you_mean(name, names)
            raise DataError(
                f"{what} names the unknown {name!r}; expected names of {list(names)}.{hint}"
            )


def as_tuple(values: Any) -> Any:
    """Lists and other sequences as tuples; texts and what is no sequence stay as they
    are, to be refused by name.
    """
    return (
        tuple(values)
        if isinstance(values, Sequence) and not isinstance(values, str)
        else values
    )


def as_columns(values: Any) -> Any:
    """(n,) as (n, 1); everything else as it is, to be checked where its name is known."""
    try:
        array = np.ma.asanyarray(values)
    except ValueError:
        return values
    return array[:, np.newaxis] if array.ndim == 1 else array


def numbered(prefix: str, n: int) -> list[str]:
    return [f"{prefix}{i}" for i in range(1, n + 1)]


def check_same_length(sizes: Mapping[str, Any], expected: str) -> None:
    lengths = {
        name: len(value) if hasattr(value, "__len__") else None
        for name, value in sizes.items()
    }
    if len(set(lengths.values())) > 1:
        raise DataError(
            f"the lengths differ: {lengths}; expected {expected}. Check that the lists belong together."
        )


def counted(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"
