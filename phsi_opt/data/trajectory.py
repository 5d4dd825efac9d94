"""TODO."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.checks import check_values, counted, read_only_floats
from phsi_opt.errors import DataError


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One experiment. The arrays are read-only float64 copies; times increase strictly.

    The values of x and u are checked by `Measurements`, which knows the channels'
    names.
    """

    name: str
    t: np.ndarray  # (n_samples,)
    x: np.ndarray  # (n_samples, n_states), NaN where not measured
    u: np.ndarray  # (n_samples, n_inputs)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise DataError(
                f"trajectory name {self.name!r} is not a text; give each trajectory a non-empty name."
            )
        for label, n_axes in (("t", 1), ("x", 2), ("u", 2)):
            array = read_only_floats(
                getattr(self, label), n_axes, f"trajectory {self.name!r}: {label}"
            )
            object.__setattr__(self, label, array)
        _check_lengths(self)
        _check_times(self)

    @property
    def n_samples(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Trajectory({self.name!r}, {self.n_samples} samples, t = {self.t[0]:g} to {self.t[-1]:g})"

    def __reduce__(self) -> tuple[Any, ...]:  # unpickled arrays would be writeable
        return type(self), (self.name, self.t, self.x, self.u)


def _check_lengths(run: Trajectory) -> None:
    for label, array in (("x", run.x), ("u", run.u)):
        if len(array) != len(run.t):
            raise DataError(
                f"trajectory {run.name!r}: {label} has {len(array)} rows and t has {len(run.t)}; "
                "expected one row per time. Check that the arrays belong together and are not transposed."
            )
    if len(run.t) < 2:
        found = counted(len(run.t), "sample", "samples")
        raise DataError(
            f"trajectory {run.name!r} has {found}; expected at least 2. Leave the trajectory out."
        )


def _check_times(run: Trajectory) -> None:
    check_values(
        run.t, lambda i: f"trajectory {run.name!r}: t[{i}]", may_be_missing=False
    )
    late = np.flatnonzero(np.diff(run.t) <= 0)
    if late.size:
        k = int(late[0])
        raise DataError(
            f"trajectory {run.name!r}: t[{k + 1}]={float(run.t[k + 1])} is not after t[{k}]={float(run.t[k])}; "
            "times must increase strictly. Sort the samples or drop the duplicate."
        )


def check_channels(
    run: Trajectory, states: tuple[str, ...], inputs: tuple[str, ...]
) -> None:
    for word, names, values in (("state", states, run.x), ("input", inputs, run.u)):
        if values.shape[1] != len(names):
            raise DataError(
                f"trajectory {run.name!r} has {counted(values.shape[1], f'{word} column', f'{word} columns')}; "
                f"expected {len(names)}, one for each of {list(names)}. Name every column of the array."
            )
        for name, column in zip(names, values.T, strict=True):
            where = functools.partial(sample_word, run, f"{word} {name!r}")
            check_values(column, where, may_be_missing=word == "state")
    if not np.isfinite(run.x).any():
        raise DataError(
            f"trajectory {run.name!r} has no measured value in any of the states {list(states)}; "
            "expected at least one measured state. Map a state to its column or leave the trajectory out."
        )


def sample_word(run: Trajectory, channel: str, i: int) -> str:
    return f"trajectory {run.name!r}: {channel} at sample {i} (t={run.t[i]})"
