"""Measurements: what was recorded, checked once, and never changed afterwards.

Every later step relies on what is checked here: times increase, inputs are known at
every sample, states are finite or NaN (not measured), names can be used in formulas.
Values are reported when they are wrong, never repaired, interpolated, scaled or
filtered. How tables are read is in `table_readers`, how integration steps join in
`trajectory`.
"""

import hashlib
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import compress
from textwrap import fill
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from phsi_opt.arguments import is_count, is_of, require_known, require_share, typed
from phsi_opt.data.checks import (
    Hold,
    check_unique,
    checked_by_name,
    checked_hold,
    checked_names,
    hold_of_each,
    numbered_names,
)
from phsi_opt.data.noticed import DataLook, breaks_of
from phsi_opt.data.preparation import detrended_run, resampled_run, thinned_run
from phsi_opt.data.table_readers import TableReaders
from phsi_opt.data.trajectory import (
    Trajectory,
    check_channels,
    run_numbers,
    trajectories_in_arrays,
)
from phsi_opt.errors import DataError, shown, some_of
from phsi_opt.presentation.numbers import LINE_WIDTH, number_of
from phsi_opt.presentation.summary import Part, Summarised, Summary, printed_table
from phsi_opt.presentation.units import Unit, in_si, scale_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from phsi_opt.presentation.charts import Chart
    from phsi_opt.presentation.tables import PrintedTable


@partial(typed, error=DataError)
@dataclass(frozen=True, eq=False, repr=False)
class Measurements(TableReaders, Summarised):
    """Several trajectories of the same channels, with names, units and noise levels.

    Created by `from_csv`, `from_excel`, `from_mat`, `from_dataframe` or `from_arrays`.

    Attributes:
        trajectories: At least one `Trajectory`; their names differ.
        states: The names of the states, one for each column of x.
        inputs: The names of the inputs, one for each column of u.
        units: The unit of every state and input and of the time "t", "" when unknown.
        hold: What inputs do between samples: "linear" interpolation, "zero" (the
            sample's value is kept until the next sample), or "cubic" (a smooth input:
            the spline through the samples). A mapping such as {"u": "zero"} sets single
            inputs; the others are "linear".
        noise: Standard deviations of the measurement noise by state, in the state's
            unit; None, or a state left out: unknown.
        labels: What people read for states and inputs, by name, such as {"q":
            "Position"}: the headers of their columns, unless that is no better.

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
    labels: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        trajectories = tuple(self.trajectories)
        if not trajectories:
            raise DataError("trajectories=[]; expected at least one Trajectory.")
        check_unique([run.name for run in trajectories], "trajectory name")
        states = checked_names(self.states, "states")
        inputs = checked_names(self.inputs, "inputs")
        check_unique(states + inputs, "name")
        names = ("t", *states, *inputs)
        units = checked_by_name(self.units, names, "units")
        checked = {
            "trajectories": trajectories,
            "states": states,
            "inputs": inputs,
            "hold": checked_hold(self.hold, inputs),
            "units": dict.fromkeys(names, "") | units,
            "noise": self.noise and checked_by_name(self.noise, states, "noise"),
            "labels": checked_by_name(self.labels, names[1:], "labels"),
        }
        for name, value in checked.items():
            frozen = MappingProxyType(value) if isinstance(value, dict) else value
            object.__setattr__(self, name, frozen)
        for run in trajectories:
            check_channels(run, states, inputs)

    @classmethod
    @partial(typed, error=DataError)
    def from_arrays(
        cls,
        t: Any,
        x: Any,
        u: Any = None,
        *,
        states: Sequence[str] = (),
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
        channels = (tuple(states), tuple(inputs))
        return cls(trajectories, *channels, units or {}, hold, noise)

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
        return tuple(compress(self.states, is_measured))

    def stacked(self, what: str) -> np.ndarray:
        """One array of all trajectories, one after the other, (n_samples, ...).

        Args:
            what: "t" for the times, "x" for the states, "u" for the inputs.
        """
        require_known(what, ("t", "x", "u"), f"stacked: {shown(what)}", DataError)
        return np.concatenate([getattr(run, what) for run in self.trajectories])

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the trajectories' names, times, states and inputs, as hex digits.

        A fit keeps it to recognise the measurements that it came from.
        """
        digest = hashlib.sha256()
        for run in self.trajectories:
            digest.update(run.name.encode())
            for array in (run.t, run.x, run.u, run.past):
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def __len__(self) -> int:
        """The number of trajectories."""
        return self.n_trajectories

    def __iter__(self) -> Iterator[Trajectory]:
        """The trajectories in order."""
        return iter(self.trajectories)

    def in_si(self) -> Self:
        """The same measurements in SI units, for models whose numbers are in SI units.

        Times are in s, angles in rad, temperatures in degC (K where all are), a share
        is 1 for 100 %. The units that were given are remembered: texts, tables with a
        unit, charts and reports show results in them. Unknown units are kept; if the
        time has no unit, nothing is converted.

        Returns:
            New measurements; these, where all is in SI units already.

        Examples:
            >>> cart = ph.Measurements.from_arrays(
            ...     [0, 20, 40], [1.0, 1.5, 1.8], states=["q"],
            ...     units={"q": "mm", "t": "ms"},
            ... )
            >>> cart.in_si().stacked("t").tolist()
            [0.0, 0.02, 0.04]
            >>> cart.in_si().units["q"]
            'm'
        """
        units = in_si(self.units)
        read = {}
        for name, unit in units.items():
            if unit is not self.units[name]:
                read[name] = scale_of(unit).read
        return self._converted(units, read) if read else self

    def as_written(self) -> Self:
        """The same measurements in the units that were given; the reverse of `in_si`.

        Examples:
            >>> data.in_si().as_written().units == data.units
            True
        """
        units = dict(self.units)
        shown_as = {}
        for name, unit in self.units.items():
            if isinstance(unit, Unit):
                units[name] = unit.scale.unit
                shown_as[name] = unit.scale.shown
        return self._converted(units, shown_as) if shown_as else self

    def _converted(
        self, units: Mapping[str, str], converted: Mapping[str, Callable[[Any], Any]]
    ) -> Self:
        """The same in other units; values are converted by the channel's name."""
        runs = []
        for run in self.trajectories:
            t, x, u = map(np.array, (run.t, run.x, run.u))
            past = np.array(run.past)
            names = (*self.units, "t", *self.inputs)
            columns = (t, *x.T, *u.T, *past.T)  # views
            for name, values in zip(names, columns, strict=True):
                if name in converted:
                    values[:] = converted[name](values)
            runs.append(replace(run, t=t, x=x, u=u, past=past))
        noise = dict(self.noise or {})
        for name in noise.keys() & converted.keys():
            noise[name] = converted[name](noise[name]) - converted[name](0.0)
        return self._of(runs, units=units, noise=noise or None)

    def _of(self, runs: Iterable[Trajectory], **changes: Any) -> Self:
        """The same with other trajectories."""
        return replace(self, trajectories=tuple(runs), **changes)

    def __getitem__(self, key: int | slice | str) -> Self:
        """The measurements of one trajectory (by number or name) or of a slice."""
        if isinstance(key, slice):
            _check_slice([run.name for run in self.trajectories], key)
            return self._of(self.trajectories[key])
        return self._of([self.trajectories[self.trajectory_number(key)]])

    def trajectory_number(self, trajectory: str | int) -> int:
        """The number of a trajectory, counted from 0, by its name or its number.

        Negative numbers count from the end, as in a list.

        Raises:
            DataError: There is no such trajectory.
        """
        names = [run.name for run in self.trajectories]
        if isinstance(trajectory, str):
            said = f"there is no trajectory {trajectory!r}"
            require_known(trajectory, names, said, DataError)
            return names.index(trajectory)
        if not isinstance(trajectory, int | np.integer):
            raise DataError(
                f"trajectory {shown(trajectory)} is unknown; expected a name "
                f"({some_of(names)}) or a number, counted from 0. Samples are chosen "
                "by data.between(begin, end)."
            )
        number = operator.index(trajectory)
        if number not in range(-len(names), len(names)):
            raise DataError(
                f"there is no trajectory {shown(number)}; there are {len(names)}, "
                f"counted from 0: {some_of(names)}."
            )
        return number % len(names)

    def split(self, fraction: float = 0.7) -> tuple[Self, Self]:
        """Training and test data: the first trajectories, and the others.

        A single trajectory is split in time instead: its first round(fraction *
        n_samples) samples, and the samples after them. The split follows the order of
        the file and is not random. Each part has at least one trajectory, or two
        samples, and no sample is in both.

        Args:
            fraction: The share of the training data, between 0 and 1.

        Raises:
            DataError: The fraction is not between 0 and 1, or a single trajectory has
                fewer than 4 samples.
        """
        require_share("fraction", fraction, DataError)
        if self.n_trajectories > 1:
            n_train = _size_of_first(self.n_trajectories, fraction, at_least=1)
            return self[:n_train], self[n_train:]
        (run,) = self.trajectories
        if run.n_samples < 4:
            raise DataError(
                f"trajectory {run.name!r} has {run.n_samples} samples; "
                "a split in time needs at least 4."
            )
        n_train = _size_of_first(run.n_samples, fraction, at_least=2)
        train = _part_of(run, 0, n_train)
        test = _part_of(run, n_train, run.n_samples)
        return self._of([train]), self._of([test])

    def between(self, begin: float | None, end: float | None) -> Self:
        """The samples with begin <= t <= end of every trajectory.

        Times are not shifted, so inputs and forces that depend on time are kept.

        Args:
            begin: The first time, in the unit of the times; None: from the start.
            end: The last time; None: to the end.

        Raises:
            DataError: The times are not in order, or a trajectory has fewer than 2
                samples between them.
        """
        said = f"between({shown(begin)}, {shown(end)})"
        for value in (begin, end):
            if value is not None and not (is_of(value, float) and value == value):
                raise DataError(
                    f"{said}: {shown(value)} is not a time; expected numbers in the "
                    "unit of the times, or None."
                )
        first = -np.inf if begin is None else float(begin)
        last = np.inf if end is None else float(end)
        if not first < last:
            raise DataError(f"{said}: the first time must be less than the last.")
        return self._of(_between(run, first, last) for run in self.trajectories)

    def thinned(self, n: int, by: str = "mean") -> Self:
        """Fewer samples: one for every n of each trajectory.

        With ``by="mean"`` states and inputs are filtered alike: a sample is the mean of
        n neighbouring ones, at the mean of their times, which prevents aliasing of
        motions that are faster than the new sampling rate. A state is missing if one of
        its n samples is missing. Noise that is given becomes smaller by sqrt(n), as if
        the errors of samples were independent. Samples that do not fill a group of n,
        at the end or before a gap, are dropped.

        With ``by="picking"`` every n-th sample is kept as it is, from the first. Use it
        if the signals are smooth at the new rate, or if states have gaps.

        What happens within n samples is lost: choose n well below the fastest time
        constant. A held input (``hold="zero"``) keeps its course: where it changes
        between two new samples there is one more, without a measured state, from which
        on it has its mean until the next.

        Args:
            n: Number of samples that become one.
            by: "mean" or "picking".

        Raises:
            DataError: n is not a positive number, or a trajectory would have fewer than
                2 samples.
        """
        require_known(by, ("mean", "picking"), f"by={shown(by)} is unknown", DataError)
        if not is_count(n):
            raise DataError(
                f"thinned({shown(n)}): expected the number of samples that become one, "
                "such as 10."
            )
        width = int(n) if by == "mean" else 1
        hold = hold_of_each(self.hold, self.inputs)
        runs = [thinned_run(run, int(n), width, hold) for run in self.trajectories]
        noise = dict(self.noise or {})
        for name, sigma in noise.items():
            noise[name] = sigma / np.sqrt(width)
        return self._of(runs, noise=noise or None)

    @partial(typed, error=DataError)
    def resampled(self, step: float) -> Self:
        """A sample every ``step``, behind a low-pass filter against aliasing.

        States and inputs are interpolated to even times and pass the same linear-phase
        filter (that of `scipy.signal.resample_poly`: a Kaiser window, half of the
        amplitude at half of the new sampling rate), so that a linear model of them
        stays true; inputs are smooth then (``hold="cubic"``). Ten new samples at each
        end, and beside each gap, are dropped, as the filter needs them. Noise that is
        given becomes smaller, as if it were white.

        Args:
            step: Time between new samples, in the unit of the times; not shorter than
                between those that there are.

        Raises:
            DataError: The time is not a positive number, shorter than a sampling step,
                or too long for a trajectory.
        """
        if not 0 < step < np.inf:
            raise DataError(
                f"resampled({shown(step)}): expected a time between new samples that "
                "is greater than 0."
            )
        hold = hold_of_each(self.hold, self.inputs)
        unit = self.units["t"]
        runs = [resampled_run(run, float(step), hold, unit) for run in self]
        share = np.sqrt(np.max(self.computed_look.typical_steps) / step)
        noise = {name: sigma * share for name, sigma in (self.noise or {}).items()}
        return self._of(runs, hold="cubic", noise=noise or None)

    @partial(typed, error=DataError)
    def detrended(self, channels: Sequence[str]) -> Self:
        """Some channels without the line that they follow in each trajectory.

        The line goes through the means of whole periods where the channel oscillates,
        as `noticed` tells it, else it is that of least squares; the mean of the
        channel stays. Use it for a sensor that drifts. A trend that the machine has
        belongs into the model.

        Args:
            channels: Names of states and inputs.

        Raises:
            DataError: There is no such channel.
        """
        places = {name: k for k, name in enumerate(self.states + self.inputs)}
        chosen = {}
        for name in channels:
            told = f"detrended({shown(channels)}): there is no channel {shown(name)}"
            require_known(name, tuple(places), told, DataError)
            chosen[name] = places[name]
        units = self.units
        return self._of(detrended_run(run, chosen, units) for run in self)

    def to_dataframe(self) -> "pd.DataFrame":
        """All samples as a table.

        Returns:
            One row per sample, with the columns trajectory, t, the states and the
            inputs.
        """
        import pandas as pd

        values = np.column_stack(list(map(self.stacked, ("t", "x", "u"))))
        frame = pd.DataFrame(values, columns=["t", *self.states, *self.inputs])
        names = np.array([run.name for run in self.trajectories], object)
        frame.insert(0, "trajectory", names[run_numbers(self.trajectories)])
        return frame

    @cached_property
    def computed_look(self) -> DataLook:
        """The clock and every channel in the units in which they are computed."""
        fields = (self.trajectories, self.states, self.inputs, self.units)
        hold = tuple(hold_of_each(self.hold, self.inputs))
        return DataLook(*fields, hold, self.labels)

    @cached_property
    def look(self) -> DataLook:
        """The clock and every channel as they are seen before there is a model."""
        return self.as_written().computed_look

    @property
    def noticed(self) -> "PrintedTable":
        """What the samples show before there is a model.

        Returns:
            A row for the clock and one for each channel, with the columns channel, part
            ("time", "state" or "input"), unit, lowest, highest, resolution (the step in
            which the values are quantised), noise (standard deviation: the given one,
            else from differences of neighbours) and noticed: how regular the clock is,
            and its gaps; missing samples; single samples far from both neighbours;
            values at which a channel stays. The last, guess, is the simplest linear
            system that a state responds like: a lag or an oscillation, with its dead
            time. NaN stands for what is not known.

        Examples:
            >>> t = np.linspace(0.0, 1.0, 101)
            >>> q = np.sin(t)
            >>> q[40] = 3.0
            >>> data = ph.Measurements.from_arrays(t, q, states=["q"])
            >>> print(data.noticed["noticed"][1])
            1 outlier of one sample, at t = 0.4
        """
        table = printed_table(self.look.rows)
        given = table["channel"].map(dict(self.as_written().noise or {}))
        table["noise"] = given.fillna(table["noise"]).astype(float)
        return table

    def chart(
        self,
        held_out: "Measurements | None" = None,
        final: "Measurements | None" = None,
    ) -> "Chart":
        """Every measured channel over time, as page and report draw it.

        Args:
            held_out: Further runs, on the ground of data that are not fitted.
            final: Further runs, on that of data for the final test.
        """
        from phsi_opt.data.data_chart import (
            FINAL_GROUND,
            FITTED_GROUND,
            HELD_OUT_GROUND,
            data_chart,
        )

        runs = list(self.look.trajectories)
        grounds = [FITTED_GROUND] * len(runs)
        for data, ground in ((held_out, HELD_OUT_GROUND), (final, FINAL_GROUND)):
            further = () if data is None else data.look.trajectories
            runs += further
            grounds += [ground] * len(further)
        return data_chart(replace(self.look, trajectories=tuple(runs)), grounds)

    def plot(self, ax: "Axes | None" = None, *, over: str = "time") -> "Axes":
        """Every measured channel over time, states first, the runs one after another.

        What `noticed` tells is marked: gaps, single samples far from both neighbours,
        and samples at a limit of a sensor. Over frequency, the amplitude of each
        channel without its trend is drawn (Hann's window; runs and stretches without
        gaps are averaged in the mean square): a sine has the peak of its amplitude.

        Args:
            over: "time" or "frequency".
            ax: Axes whose place is divided among the channels; None: a new figure.

        Returns:
            The axes of the first channel; those of the others are in its figure.

        Examples:
            >>> data.plot().figure.savefig("data.png")
        """
        from phsi_opt.presentation.charts import drawn

        told = f"plot(over={shown(over)}) is unknown"
        require_known(over, ("time", "frequency"), told, DataError)
        return drawn(self.chart() if over == "time" else self.spectrum, ax=ax)

    @property
    def spectrum(self) -> "Chart":
        """The amplitude of every channel over frequency, as `plot` draws it.

        Examples:
            >>> frequencies = data.spectrum.panels[0].curves[0].x
        """
        from phsi_opt.data.data_chart import spectrum_chart

        return spectrum_chart(self.look)

    def _summary(self) -> Summary:
        """Numbers of trajectories and samples, span of time, and what is noticed."""
        runs = number_of(self.n_trajectories, "trajectory", "trajectories")
        table = self.noticed
        clock = table.iloc[0]
        unit = f" [{clock.unit}]" if clock.unit else ""
        span = f"t = {clock.lowest:g} to {clock.highest:g}{unit}"
        title = f"Measurements: {runs}, {self.n_samples} samples, {span}"
        channels = table[1:].drop(columns=["noticed", "guess"])
        guesses = table.guess.mask(table.guess != "", "first guess: " + table.guess)
        told = table.noticed.str.cat(guesses, sep="; ").str.strip("; ")
        lines = (table.channel + ": " + told)[told != ""]
        folded = lines.map(partial(fill, width=LINE_WIDTH, subsequent_indent="  "))
        return Summary(title, (Part(table=channels), Part(code="\n".join(folded))))

    def __reduce__(self) -> tuple[Any, ...]:
        """Through the constructor, because a mappingproxy cannot be pickled."""
        arguments = []
        for one in fields(self):
            value = getattr(self, one.name)
            is_mapping = isinstance(value, MappingProxyType)
            arguments.append(dict(value) if is_mapping else value)
        return type(self), tuple(arguments)


# ---- parts ---------------------------------------------------------------------------


def _check_slice(names: Sequence[str], key: slice) -> None:
    """Refuse a slice beyond the trajectories, which was meant for samples."""

    def is_number(bound: Any) -> bool:
        bound = bound or 0
        return hasattr(bound, "__index__") and abs(operator.index(bound)) <= len(names)

    bounds = [key.start, key.stop, key.step]
    if all(map(is_number, bounds)) and names[key]:
        return
    written = ":".join("" if bound is None else repr(bound) for bound in bounds)
    if key.step is None:
        written = written.removesuffix(":")
    raise DataError(
        f"data[{written}] selects trajectories; there are {len(names)}: "
        f"{some_of(names)}. To select a time span, use data.between(begin, end); to "
        "reduce the number of samples, data.thinned(n)."
    )


def _size_of_first(n: int, fraction: float, at_least: int) -> int:
    """The size of the first of two parts of n things, each of ``at_least`` things."""
    return min(max(round(fraction * n), at_least), n - at_least)


def _between(run: Trajectory, first: float, last: float) -> Trajectory:
    """The samples of a trajectory with first <= t <= last, their times as they are."""
    begin = int(np.searchsorted(run.t, first))
    end = int(np.searchsorted(run.t, last, side="right"))
    n_samples = max(end - begin, 0)
    if n_samples < 2:
        raise DataError(
            f"trajectory {run.name!r} has {n_samples} samples between {first:g} and "
            f"{last:g}; expected at least 2. Its times go from {run.t[0]:g} to "
            f"{run.t[-1]:g}; choose other times, or select trajectories first: "
            "data[name]."
        )
    return _part_of(run, begin, end)


def _part_of(run: Trajectory, begin: int, end: int) -> Trajectory:
    """Some samples of a trajectory, at least 2, with the inputs before them."""
    rows = slice(begin, end)
    breaks = breaks_of(run)
    known = int(np.max(breaks[breaks < begin] + 1, initial=0))
    past = np.column_stack([run.t, run.u])[known:begin]
    if not known:
        past = np.vstack([run.past, past])
    return replace(run, t=run.t[rows], x=run.x[rows], u=run.u[rows], past=past)
