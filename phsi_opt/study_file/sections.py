"""The sections of a study file about measurements, as records.

Paths stay as they were written, relative to the folder of the study file.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from phsi_opt.data.file_opening import text_files
from phsi_opt.data.layout import table_layout, trajectories_in
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.tables import Table, table_of_csv
from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError
from phsi_opt.study_file.times import COUNTED, counted_times, dates_as_seconds, within

SHARE_DIGITS = 12  # of 1 - share, so that 1 - 0.4 reads 0.6


@dataclass(frozen=True)
class Channel:
    """A column of the table: a state, an input, or the time.

    Attributes:
        column: its name; None for a state that nobody measured.
        unit: such as "m"; "" where it is unknown.
        noise: standard deviation of a state's noise, in its unit; None: estimated.
    """

    column: str | None
    unit: str = ""
    noise: float | None = None


@dataclass(frozen=True)
class DataSection:
    """Where the measurements are and which column is what.

    Attributes:
        files: relative to the folder of the study file, or absolute.
        time: the column of the times; without a column where ``step`` is given.
        states: by name.
        inputs: by name.
        trajectory: the column that names each line's run; None: a run per file.
        hold: what inputs do between samples, "linear" or "zero".
        step: the time between neighbouring lines, where no column has the times.
        dates: whether the times are dates; they become seconds since the first one.
        between: first and last time that are used, of every run; None: all.
    """

    files: tuple[str, ...]
    time: Channel
    states: Mapping[str, Channel]
    inputs: Mapping[str, Channel] = field(default_factory=dict)
    trajectory: str | None = None
    hold: str = "linear"
    step: float | None = None
    dates: bool = False
    between: tuple[float, float] | None = None

    @property
    def is_plain(self) -> bool:
        """Whether `Measurements.from_csv` alone gives the measurements."""
        is_numbers = self.step is None and not self.dates
        return is_numbers and self.between is None

    @property
    def units(self) -> dict[str, str]:
        """The units that are known, of the time, the states and the inputs."""
        channels = {"t": self.time, **self.states, **self.inputs}
        units = {}
        for name, channel in channels.items():
            if channel.unit:
                units[name] = channel.unit
        return units

    @property
    def noise(self) -> dict[str, float] | None:
        """The noise that is known, by state; None where none is."""
        noise = {}
        for name, channel in self.states.items():
            if channel.noise is not None:
                noise[name] = channel.noise
        return noise or None

    @property
    def state_columns(self) -> dict[str, str | None]:
        """The column of each state."""
        return {name: channel.column for name, channel in self.states.items()}

    @property
    def input_columns(self) -> dict[str, str | None]:
        """The column of each input."""
        return {name: channel.column for name, channel in self.inputs.items()}

    def paths(self, folder: Path) -> list[Path]:
        """The files, from the folder of the study file."""
        return [folder / file for file in self.files]

    def moved(self, old: Path, new: Path) -> "DataSection":
        """The same files, as they are called from another folder."""
        files = []
        for file in self.files:
            if not Path(file).is_absolute():
                file = Path(os.path.relpath(old / file, new)).as_posix()
            files.append(file)
        return replace(self, files=tuple(files))

    def measurements(self, folder: Path) -> Measurements:
        """Read the files.

        Args:
            folder: that of the study file.

        Raises:
            DataError: something in them cannot be used; with file, column and line.
        """
        data = self._whole_measurements(self.paths(folder))
        if self.between is None:
            return data
        begin, end = self.between
        runs = [within(run, begin, end) for run in data.trajectories]
        return replace(data, trajectories=tuple(runs))

    def _whole_measurements(self, paths: Sequence[Path]) -> Measurements:
        if self.step is not None or self.dates:
            return self._timed_measurements(paths)
        return Measurements.from_csv(
            paths if len(paths) > 1 else paths[0],
            time=str(self.time.column),
            states=self.state_columns,
            inputs=self.input_columns,
            trajectory=self.trajectory,
            hold=self.hold,
            units=self.units,
            noise=self.noise,
        )

    def _timed_measurements(self, paths: Sequence[Path]) -> Measurements:
        """The measurements, where the times are counted or are dates."""
        column = COUNTED if self.step is not None else str(self.time.column)
        layout = table_layout(
            column, self.state_columns, self.input_columns, self.trajectory
        )
        tables = []
        for file in text_files(list(paths)):
            table = table_of_csv(file, layout.columns())
            tables.append(self.with_times(table))
        return Measurements(
            trajectories_in(tables, layout),
            states=tuple(self.states),
            inputs=tuple(self.inputs),
            units=self.units,
            hold=self.hold,
            noise=self.noise,
        )

    def with_times(self, table: Table) -> Table:
        """The table with its times as numbers.

        Raises:
            DataError: a cell is no date.
        """
        if self.step is not None:
            return counted_times(table, self.step, self.trajectory)
        column = str(self.time.column)
        if self.dates and list(table.frame.columns).count(column) == 1:
            return dates_as_seconds(table, column)
        return table


@dataclass(frozen=True)
class HeldOut:
    """What is kept from fitting; one of three ways, the others are None.

    Attributes:
        runs: names of the runs held out.
        share: the last share of the runs; of a single run, of its samples.
        after: a time; of every run, the samples from then on.
    """

    runs: tuple[str, ...] | None = None
    share: float | None = None
    after: float | None = None

    @property
    def training_share(self) -> float:
        """What `Measurements.split` is asked for."""
        return round(1 - (self.share or 0.0), SHARE_DIGITS)

    def split(self, data: Measurements) -> tuple[Measurements, Measurements]:
        """Training data and data held out.

        Raises:
            DataError: there is no such run, or one of the parts would be empty.
        """
        if self.runs is not None:
            return _by_runs(data, self.runs)
        if self.after is not None:
            return _by_time(data, self.after)
        return data.split(self.training_share)


def _by_runs(
    data: Measurements, runs: tuple[str, ...]
) -> tuple[Measurements, Measurements]:
    held_out = {data.trajectory_number(run) for run in runs}
    kept: list[Trajectory] = []
    judging: list[Trajectory] = []
    for number, run in enumerate(data.trajectories):
        (judging if number in held_out else kept).append(run)
    if not kept or not judging:
        raise DataError(
            f"{len(judging)} of {data.n_trajectories} runs are held out; expected at "
            "least one, and at least one to fit."
        )
    return (
        replace(data, trajectories=tuple(kept)),
        replace(data, trajectories=tuple(judging)),
    )


def _by_time(data: Measurements, after: float) -> tuple[Measurements, Measurements]:
    before = []
    later = []
    for run in data.trajectories:
        n_before = int((run.t < after).sum())
        if n_before < 2 or run.n_samples - n_before < 2:
            raise DataError(
                f"run {run.name!r} goes from t = {run.t[0]:g} to {run.t[-1]:g}; after "
                f"= {after:g} leaves {n_before} samples before and "
                f"{run.n_samples - n_before} after; expected at least 2 of each."
            )
        before.append(part_of(run, slice(n_before)))
        later.append(part_of(run, slice(n_before, None)))
    return (
        replace(data, trajectories=tuple(before)),
        replace(data, trajectories=tuple(later)),
    )
