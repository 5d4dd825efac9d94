"""Measurements: what was recorded, checked once, and never changed afterwards.

Every later step relies on what is checked here: times increase, inputs are known at
every sample, states are finite or NaN (not measured), names can be used in formulas.
Values are reported when they are wrong, never repaired, interpolated, scaled or
filtered. How tables are read is told in `table_readers`, which column is what in
`layout`, how integration steps join in `arrays`, how parts are taken in `selection`.
"""

import hashlib
import itertools
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self

import numpy as np

from phsi_opt.data.arrays import joined_pairs, trajectories_in_arrays
from phsi_opt.data.checks import (
    Hold,
    check_unique,
    checked_by_name,
    checked_hold,
    checked_names,
    numbered_names,
)
from phsi_opt.data.selection import Selections
from phsi_opt.data.table_readers import TableReaders
from phsi_opt.data.trajectory import (
    Trajectory,
    check_channels,
    checked_trajectories,
)
from phsi_opt.presentation.numbers import number_of
from phsi_opt.presentation.summary import Part, Summarised, Summary, printed_table

if TYPE_CHECKING:
    import pandas as pd

Arguments = ParamSpec("Arguments")
Derived = Callable[Concatenate["Measurements", Arguments], np.ndarray]


def worked_out_once(make: Derived[Arguments]) -> Derived[Arguments]:
    """A function of measurements whose values, (n,) or more, are kept with them."""

    @wraps(make)
    def kept(
        data: "Measurements", *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> np.ndarray:
        key = (make.__name__, args)
        if key not in data._derived:
            data._derived[key] = make(data, *args, **kwargs)
        return data._derived[key].copy()

    return kept


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(TableReaders, Selections, Summarised):
    """Several trajectories of the same channels, with names, units and noise levels.

    Made by `from_csv`, `from_excel`, `from_mat`, `from_dataframe`, `from_arrays` or
    `from_pairs`.

    Attributes:
        trajectories: At least one `Trajectory`, each under a name of its own.
        states: The names of the states, one for each column of x.
        inputs: The names of the inputs, one for each column of u.
        units: The unit of every state and input and of the time "t", "" when unknown.
        hold: What inputs do between samples: "linear" interpolation, "zero" (the
            sample's value is kept until the next sample), or "cubic" (a smooth input:
            the spline through the samples); where they differ a mapping such as
            {"u": "zero"}, whose others are "linear".
        noise: Standard deviations of the measurement noise by state, in the state's
            unit; None, or a state left out: unknown.

    Raises:
        DataError: A name, a value, a unit or a noise level cannot be used.
    """

    _between = "\n"
    trajectories: tuple[Trajectory, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    hold: Hold = "linear"
    noise: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        trajectories = checked_trajectories(self.trajectories)
        states = checked_names(self.states, "states")
        inputs = checked_names(self.inputs, "inputs")
        check_unique(states + inputs, "name")
        names = ("t", *states, *inputs)
        units = checked_by_name(self.units, names, "units")
        noise = self.noise
        if noise is not None:
            noise = checked_by_name(noise, states, "noise")
        checked = {
            "trajectories": trajectories,
            "states": states,
            "inputs": inputs,
            "hold": checked_hold(self.hold, inputs),
            "units": dict.fromkeys(names, "") | units,
            "noise": noise,
        }
        for name, value in checked.items():
            frozen = MappingProxyType(value) if isinstance(value, dict) else value
            object.__setattr__(self, name, frozen)
        for run in trajectories:
            check_channels(run, states, inputs)

    @classmethod
    def from_arrays(
        cls,
        t: Any,
        x: Any,
        u: Any = None,
        *,
        states: Sequence[str],
        inputs: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
        hold: Hold = "linear",
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
    ) -> Self:
        """One trajectory from three arrays, or several from lists of arrays.

        Args:
            t: Times, (n_samples,).
            x: States, (n_samples, n_states), or (n_samples,) for a single state; NaN
                where not measured.
            u: Inputs, (n_samples, n_inputs), or (n_samples,) for a single input.
            states: The names of the states.
            inputs: The names of the inputs, u1, u2, ... where none are given.
            names: The names of the trajectories, "run 1", "run 2", ... where none are
                given.
            hold, units, noise: As the attributes of `Measurements`.

        Raises:
            DataError: Something cannot be used.
        """
        trajectories = trajectories_in_arrays(t, x, u, names)
        if inputs is None:
            inputs = numbered_names("u", trajectories[0].u.shape[1])
        return cls(
            trajectories,
            states=checked_names(states, "states"),
            inputs=checked_names(inputs, "inputs"),
            units={} if units is None else units,
            hold=hold,
            noise=noise,
        )

    @classmethod
    def from_pairs(
        cls,
        x_start: Any,
        x_end: Any,
        t_start: Any,
        t_end: Any,
        *,
        states: Sequence[str] | None = None,
        u_start: Any = None,
        u_end: Any = None,
        inputs: Sequence[str] | None = None,
        hold: Hold = "linear",
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
    ) -> Self:
        """From integration steps, each given by its start and its end.

        A pair which starts exactly where the pair before it ended (same time, same
        state, same input) continues its trajectory; any other pair starts a new one.
        With hold="zero" the input at the end of a pair acts on nothing: it is not
        compared, and ``u_end`` may be left out.

        Args:
            x_start: States at the starts, (n_pairs, n_states); a single state may be
                (n_pairs,).
            x_end: States at the ends, the same shape.
            t_start: Times of the starts, (n_pairs,).
            t_end: Times of the ends, (n_pairs,).
            states: The names of the states, x1, x2, ... where none are given.
            u_start: Inputs at the starts, (n_pairs, n_inputs).
            u_end: Inputs at the ends, the same shape.
            inputs: The names of the inputs, u1, u2, ... where none are given.
            hold, units, noise: As the attributes of `Measurements`.

        Raises:
            DataError: Something cannot be used.
        """
        t, x, u = joined_pairs(
            (t_start, t_end), (x_start, x_end), (u_start, u_end), inputs, hold
        )
        return cls.from_arrays(
            t,
            x,
            u,
            states=numbered_names("x", x[0].shape[1]) if states is None else states,
            inputs=inputs,
            hold=hold,
            units=units,
            noise=noise,
        )

    @property
    def n_states(self) -> int:
        """The number of states, measured or not."""
        return len(self.states)

    @property
    def n_inputs(self) -> int:
        """The number of inputs."""
        return len(self.inputs)

    @property
    def n_trajectories(self) -> int:
        """The number of trajectories."""
        return len(self.trajectories)

    @property
    def n_samples(self) -> int:
        """Samples of all trajectories together."""
        return sum(run.n_samples for run in self.trajectories)

    @property
    def measured(self) -> tuple[str, ...]:
        """The states with at least one finite value."""
        is_measured = np.isfinite(self.stacked("x")).any(axis=0)
        return tuple(itertools.compress(self.states, is_measured))

    def stacked(self, what: str) -> np.ndarray:
        """One array of all trajectories, one after the other, (n_samples, ...).

        Args:
            what: "t" for the times, "x" for the states, "u" for the inputs.
        """
        return np.concatenate([getattr(run, what) for run in self.trajectories])

    @cached_property
    def _derived(self) -> dict[Hashable, np.ndarray]:
        """What `worked_out_once` keeps."""
        return {}

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the trajectories' names, times, states and inputs, as hex digits.

        A fit keeps it to recognise the measurements that it came from.
        """
        digest = hashlib.sha256()
        for run in self.trajectories:
            digest.update(run.name.encode())
            for array in (run.t, run.x, run.u):
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def __len__(self) -> int:
        """The number of trajectories."""
        return self.n_trajectories

    def __iter__(self) -> Iterator[Trajectory]:
        """The trajectories in order."""
        return iter(self.trajectories)

    def with_noise(self, noise: Mapping[str, float] | None) -> Self:
        """The same measurements with other standard deviations of the noise.

        Args:
            noise: Standard deviations by state, in the state's unit; None: unknown.

        Raises:
            DataError: A name is no state, or a value is not positive.
        """
        return replace(self, noise=noise)

    def to_dataframe(self) -> "pd.DataFrame":
        """All samples as a table.

        Returns:
            One row per sample, with the columns trajectory, t, the states and the
            inputs.
        """
        import pandas as pd

        values = np.column_stack([self.stacked(what) for what in ("t", "x", "u")])
        frame = pd.DataFrame(values, columns=["t", *self.states, *self.inputs])
        names = [run.name for run in self.trajectories]
        n_samples = [run.n_samples for run in self.trajectories]
        frame.insert(0, "trajectory", np.repeat(np.array(names, object), n_samples))
        return frame

    def _channels(self) -> Iterator[dict[str, Any]]:
        """A row per channel; NaN for what is not known."""
        values_of = [*self.stacked("x").T, *self.stacked("u").T]
        parts = ["state"] * self.n_states + ["input"] * self.n_inputs
        channels = (*self.states, *self.inputs)
        noise = self.noise or {}
        for part, name, values in zip(parts, channels, values_of, strict=True):
            known = values[np.isfinite(values)]
            yield {
                "channel": name,
                "part": part,
                "unit": self.units[name],
                "measured": f"{known.size} of {values.size}",
                "lowest": known.min() if known.size else np.nan,
                "highest": known.max() if known.size else np.nan,
                "noise": noise.get(name, np.nan),
            }

    def _summary(self) -> Summary:
        """Number of trajectories and samples, span of time, and a line per channel."""
        runs = number_of(self.n_trajectories, "trajectory", "trajectories")
        t = self.stacked("t")
        unit = f" [{self.units['t']}]" if self.units["t"] else ""
        span = f"t = {t.min():g} to {t.max():g}{unit}"
        title = f"Measurements: {runs}, {self.n_samples} samples, {span}"
        table = printed_table(self._channels())
        return Summary(title, (Part(table=table),))

    def __reduce__(self) -> tuple[Any, ...]:
        """Through the constructor, because a mappingproxy cannot be pickled."""
        arguments = (
            self.trajectories,
            self.states,
            self.inputs,
            dict(self.units),
            checked_hold(self.hold, self.inputs),
            None if self.noise is None else dict(self.noise),
        )
        return type(self), arguments
