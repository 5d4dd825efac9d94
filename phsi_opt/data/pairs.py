"""TODO."""

from typing import Any

import numpy as np

from phsi_opt.data.checks import as_columns, check_values, read_only_floats
from phsi_opt.errors import DataError


def pair_arrays(
    start: Any, end: Any, n_axes: int, label: str
) -> tuple[np.ndarray, np.ndarray]:
    names = f"{label}_start", f"{label}_end"
    columns = as_columns if n_axes == 2 else np.ma.asanyarray
    a, b = (
        read_only_floats(columns(v), n_axes, name)
        for v, name in zip((start, end), names, strict=True)
    )
    if a.shape != b.shape:
        raise DataError(
            f"{names[0]} has the shape {a.shape} and {names[1]} {b.shape}; expected the same shape."
        )
    return a, b


def pair_inputs(
    start: Any, end: Any, n_pairs: int, hold: str
) -> tuple[np.ndarray, np.ndarray]:
    if start is None and end is None:
        return np.empty((n_pairs, 0)), np.empty((n_pairs, 0))
    if start is None or (end is None and hold != "zero"):
        raise DataError(
            "only one of u_start and u_end is given; expected both. If u keeps its value: hold='zero'."
        )
    return pair_arrays(start, start if end is None else end, 2, "u")


def check_pair_times(t0: np.ndarray, t1: np.ndarray) -> None:
    if not len(t0):
        raise DataError(
            "there are no pairs; expected at least one row in x_start and t_start."
        )
    for label, t in (("t_start", t0), ("t_end", t1)):
        check_values(t, (label + "[{}]").format, may_be_missing=False)
    late = np.flatnonzero(t1 <= t0)
    if late.size:
        k = int(late[0])
        raise DataError(
            f"pair {k}: t_end[{k}]={float(t1[k])} is not after t_start[{k}]={float(t0[k])}; "
            "each pair must go forward in time. Exchange the two ends or drop the pair."
        )


def same_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    same: np.ndarray = ((a == b) | (np.isnan(a) & np.isnan(b))).all(axis=1)
    return same
