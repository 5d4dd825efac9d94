"""Conversions of an MDF file from raw to physical values, as far as they are numbers.

A file states how raw values become physical ones; asammdf applies all of that, and
executes formulas. Here each kind that is a number is a function of its block in the
file and of the raw values x. Kinds and parameters are those of the ASAM standard; "old"
files are those of version 3.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

FORMULA = "its values follow from a formula, which is not executed"
TEXTS = "its values are texts"


def physical(block: Any, is_old: bool, x: np.ndarray) -> np.ndarray:
    """The physical values of raw ones; without a conversion, they are the same."""
    return x if block is None else KINDS[is_old][block.conversion_type](block, x)


def why_refused(block: Any, is_old: bool) -> str:
    """Why a conversion is not applied; "" where it is."""
    if block is None:
        return ""
    kind = block.conversion_type
    if KINDS[is_old].get(kind) is _beside_texts:
        others = list(filter(_is_conversion, block.referenced_blocks.values()))
        if block.referenced_blocks.get("default_addr") not in others:
            return TEXTS
        return max(why_refused(other, is_old) for other in others)
    if kind in KINDS[is_old]:
        return ""
    return FORMULA if kind in ((7, 8, 10) if is_old else (3,)) else TEXTS


def _is_conversion(block: Any) -> bool:
    return hasattr(block, "conversion_type")


def _same(block: Any, x: np.ndarray) -> np.ndarray:
    return x


def _linear(block: Any, x: np.ndarray) -> np.ndarray:
    return np.asarray(block.a * x + block.b)


def _rational(block: Any, x: np.ndarray) -> np.ndarray:
    above = [block.P1, block.P2, block.P3]
    below = [block.P4, block.P5, block.P6]
    if above[-1] == below[-1] == 0:  # a common factor x
        above.pop()
        below.pop()
    with np.errstate(all="ignore"):  # what is not finite is refused by its row
        return np.polyval(above, x.astype(float)) / np.polyval(below, x)


def _table(block: Any, x: np.ndarray, is_interpolated: bool) -> np.ndarray:
    n = getattr(block, "val_param_nr", 0) // 2 or block.ref_param_nr
    raw = np.array([block[f"raw_{i}"] for i in range(n)])
    values = np.array([block[f"phys_{i}"] for i in range(n)])
    if (np.diff(raw) <= 0).any():
        raise OSError("it has a table of a conversion whose raw values do not increase")
    if is_interpolated:
        return np.interp(x, raw, values)
    return values[np.searchsorted((raw[1:] + raw[:-1]) / 2, x)]  # of the nearest


def _of_ranges(block: Any, x: np.ndarray) -> np.ndarray:
    values = np.full(len(x), block.default, float)
    for i in range((block.val_param_nr - 1) // 3):
        values[_within(block, i, x)] = block[f"phys_{i}"]
    return values


def _beside_texts(block: Any, x: np.ndarray) -> np.ndarray:
    """A conversion of most values; others are texts, such as "no signal": missing."""
    others = dict(block.referenced_blocks)
    values = physical(others.pop("default_addr"), False, x).astype(float)
    for name, other in others.items():
        own = _within(block, name.removeprefix("text_"), x)
        is_number = _is_conversion(other)
        values[own] = physical(other, False, x[own]) if is_number else np.nan
    return values


def _within(block: Any, i: object, x: np.ndarray) -> np.ndarray:
    """A range of whole numbers includes its upper end, as does a single value."""
    if block.conversion_type == 7:
        return x == block[f"val_{i}"]
    high = block[f"upper_{i}"]
    return (block[f"lower_{i}"] <= x) & (x < high if x.dtype.kind == "f" else x <= high)


Kind = Callable[[Any, np.ndarray], np.ndarray]
INTERPOLATED: Kind = partial(_table, is_interpolated=True)
NEAREST: Kind = partial(_table, is_interpolated=False)
KINDS: dict[bool, dict[int, Kind]] = {
    True: {65535: _same, 0: _linear, 1: INTERPOLATED, 2: NEAREST, 9: _rational},
    False: {0: _same, 1: _linear, 2: _rational, 4: INTERPOLATED, 5: NEAREST}
    | {6: _of_ranges, 7: _beside_texts, 8: _beside_texts},
}
