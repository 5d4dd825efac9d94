"""One experiment: times, states and inputs, checked where they enter.

A trajectory knows neither the names nor the units of its channels: all trajectories of
a `Measurements` share those. `check_channels` is the check that needs the names.
"""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phsi_opt.data.checks import check_unique, check_values, read_only_floats
from phsi_opt.errors import DataError
from phsi_opt.presentation.numbers import number_of


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One experiment. The arrays are read-only float64 copies; times increase strictly.

    The values of x and u are checked by `Measurements`, which knows the channels'
    names.

    Attributes:
        name: A text of one line that is not empty, unique within the measurements.
        t: Times, (n_samples,), at least 2.
        x: States, (n_samples, n_states), NaN where not measured.
        u: Inputs, (n_samples, n_inputs); of a single channel (n_samples,) will do.
        origin: The moment at which t is 0, where the times were dates; else None.

    Raises:
        DataError: The name is no text, an array is not real or has another shape, or
            the times do not increase.
    """

    name: str
    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    origin: dt.datetime | None = None

    def __post_init__(self) -> None:
        is_text = isinstance(self.name, str) and self.name
        if not is_text or not self.name.isprintable():
            raise DataError(
                f"trajectory name {self.name!r} is not a text of one line; "
                "give each trajectory a non-empty name."
            )
        for label, n_axes in (("t", 1), ("x", 2), ("u", 2)):
            title = f"trajectory {self.name!r}: {label}"
            array = read_only_floats(getattr(self, label), n_axes, title)
            object.__setattr__(self, label, array)
        _check_samples(self)

    @property
    def n_samples(self) -> int:
        """The number of samples."""
        return len(self.t)

    def __repr__(self) -> str:
        """Name, number of samples and the span of time."""
        span = f"t = {self.t[0]:g} to {self.t[-1]:g}"
        return f"Trajectory({self.name!r}, {self.n_samples} samples, {span})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Through the constructor, because unpickled arrays would be writeable."""
        return type(self), (self.name, self.t, self.x, self.u, self.origin)


def part_of(run: Trajectory, rows: slice) -> Trajectory:
    """The trajectory of some of the samples, under the same name.

    Raises:
        DataError: Fewer than 2 samples are left.
    """
    return replace(run, t=run.t[rows], x=run.x[rows], u=run.u[rows])


def checked_trajectories(trajectories: Any) -> tuple[Trajectory, ...]:
    """At least one trajectory, each under a name of its own, as a tuple.

    Raises:
        DataError: This is no such list or tuple.
    """
    is_sequence = isinstance(trajectories, Sequence)
    if not is_sequence or isinstance(trajectories, str) or not trajectories:
        raise DataError(
            f"trajectories={trajectories!r}; "
            "expected a list or tuple of at least one Trajectory."
        )
    for i, run in enumerate(trajectories):
        if not isinstance(run, Trajectory):
            raise DataError(
                f"trajectories[{i}] is a {type(run).__name__}; "
                "expected a Trajectory (see from_arrays)."
            )
    check_unique([run.name for run in trajectories], "trajectory name")
    return tuple(trajectories)


def check_channels(
    run: Trajectory, states: tuple[str, ...], inputs: tuple[str, ...]
) -> None:
    """Check the columns of a trajectory against the names of the channels.

    Raises:
        DataError: A column has no name or a name no column, a value is infinite or
            huge, an input is missing, or no state was measured at all.
    """
    _check_columns(run, "state", states, run.x)
    _check_columns(run, "input", inputs, run.u)
    if not np.isfinite(run.x).any():
        raise DataError(
            f"trajectory {run.name!r} has no measured value in any of the states "
            f"{list(states)}; expected at least one measured state. "
            "Map a state to its column or leave the trajectory out."
        )


def _check_columns(
    run: Trajectory, kind: str, names: tuple[str, ...], values: np.ndarray
) -> None:
    n_columns = values.shape[1]
    if n_columns != len(names):
        found = number_of(n_columns, f"{kind} column")
        raise DataError(
            f"trajectory {run.name!r} has {found}; "
            f"expected {len(names)}, one for each of {list(names)}. "
            "Name every column of the array."
        )

    def place_of(i: int, k: int) -> str:
        where = f"at sample {i} (t={run.t[i]})"
        return f"trajectory {run.name!r}: {kind} {names[k]!r} {where}"

    check_values(values, place_of, may_be_missing=kind == "state")


def _check_samples(run: Trajectory) -> None:
    for label, array in (("x", run.x), ("u", run.u)):
        if len(array) != run.n_samples:
            raise DataError(
                f"trajectory {run.name!r}: {label} has {len(array)} rows "
                f"and t has {run.n_samples}; expected one row per time. "
                "Check that the arrays belong together and are not transposed."
            )
    if run.n_samples < 2:
        raise DataError(
            f"trajectory {run.name!r} has {number_of(run.n_samples, 'sample')}; "
            "expected at least 2. Leave the trajectory out."
        )
    place_of = f"trajectory {run.name!r}: t[{{}}]".format
    check_values(run.t, place_of, may_be_missing=False)
    is_late = np.diff(run.t) <= 0
    if is_late.any():
        before = int(np.argmax(is_late))
        after = before + 1
        raise DataError(
            f"trajectory {run.name!r}: t[{after}]={float(run.t[after])} is not after "
            f"t[{before}]={float(run.t[before])}; times must increase strictly. "
            "Sort the samples or drop the duplicate."
        )
