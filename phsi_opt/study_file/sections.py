"""The sections of a study file as records, whose fields are keys of the file.

Paths stay as they were written, relative to the folder of the study file.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.arguments import typed
from phsi_opt.data.binary_tables import (
    LOGGERS,
    table_of_excel,
    table_of_groups,
    table_of_mat,
    table_of_vectors,
)
from phsi_opt.data.copies import check_can_judge, copies_in
from phsi_opt.data.file_opening import (
    READERS,
    DataFile,
    NamedFile,
    opened_files,
    run_names,
)
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.table_readers import columns_in
from phsi_opt.data.tables import Table
from phsi_opt.data.text_tables import TextFormat, table_of_csv
from phsi_opt.errors import DataError
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.presentation.numbers import chosen_fields
from phsi_opt.presentation.units import scale_of
from phsi_opt.transcription.losses import MaximumLikelihood

TEXT_READER = "from_csv"
OF_TEXTS = ("columns", "separator", "decimal", "skip", "units_row")


def reader_of(path: Path | DataFile) -> str:
    """The name of the reader of `Measurements` for a file, by its suffix."""
    return READERS.get(path.suffix.lower(), TEXT_READER)


@typed
@dataclass(frozen=True)
class Channel:
    """A column of the table: a state, or an input.

    Attributes are called like the keys of a state or input, which docs/command_line.md
    explains. ``column`` is None for a state that was not measured.
    """

    column: str | int | None = None
    unit: str = ""
    noise: float | None = None
    hold: str | None = None
    clock: str | int | None = None
    measured: bool = True

    def __post_init__(self) -> None:
        if self.column is None:
            object.__setattr__(self, "measured", False)


@typed
@dataclass(frozen=True)
class Times:
    """The column of the times, or the step between lines.

    Attributes are called like the keys of the times, which docs/command_line.md
    explains.
    """

    column: str | int | tuple[str, ...] | None = None
    unit: str = ""
    step: float | None = None
    start: str | None = None
    date_format: str | None = None


@typed
@dataclass(frozen=True)
class DataSection:
    """The data files and the meaning of their columns.

    The type of the tables (text, .xlsx, .mat) follows from the name of the first file;
    values that are None are detected, as by the readers of `Measurements`. Attributes
    are called like the keys of the section, which docs/command_line.md explains;
    ``places`` has the paths of files that are in another place than their names say.
    """

    files: tuple[str, ...] = ()
    time: Times = Times()
    states: Mapping[str, Channel] = field(default_factory=dict)
    inputs: Mapping[str, Channel] = field(default_factory=dict)
    trajectory: str | None = None
    hold: str = "linear"
    sheet: str | None = None
    group: str | None = None
    columns: tuple[str, ...] | None = None
    separator: str | None = None
    decimal: str | None = None
    skip: int | None = None
    units_row: int | None = None
    between: tuple[float, float] | None = None
    detrended: tuple[str, ...] | None = None
    resampled: float | None = None
    thinned: int | None = None
    places: Mapping[str, Path] = field(default_factory=dict)

    @classmethod
    def of(
        cls, content: Mapping[str, Any], places: Mapping[str, Path] | None = None
    ) -> "DataSection":
        """The section with these entries; empty ones count as left out."""
        settings = without(content, "", ())
        settings["time"] = Times(**content.get("time", {}))
        for what in ("states", "inputs"):
            channels = content.get(what, {}).items()
            settings[what] = {name: Channel(**one) for name, one in channels}
        return cls(**settings, places=places or {})

    @property
    def units(self) -> dict[str, str]:
        """The units that are known, of the time, the states and the inputs."""
        channels: dict[str, Any] = {"t": self.time, **self._channels}
        return {name: one.unit for name, one in channels.items() if one.unit}

    @property
    def _channels(self) -> dict[str, Channel]:
        return {**self.states, **self.inputs}

    def paths(self, folder: Path) -> list[DataFile]:
        """The files, from the folder of the study file."""
        return [
            NamedFile(self.places[file], file) if file in self.places else folder / file
            for file in self.files
        ]

    def moved(self, old: Path, new: Path) -> "DataSection":
        """The same files, with paths relative to another folder."""
        files = []
        for file in self.files:
            if file not in self.places and not Path(file).is_absolute():
                file = Path(os.path.relpath(old / file, new)).as_posix()
            files.append(file)
        return replace(self, files=tuple(files))

    @property
    def reader(self) -> str:
        """The name of the reader of `Measurements` for the first file."""
        return reader_of(Path(self.files[0] if self.files else ""))

    @property
    def wanted(self) -> list[Any]:
        """The columns that are asked for."""
        columns: list[Any] = [self.trajectory, *columns_in(self.time.column)]
        for channel in self._channels.values():
            columns += [channel.column, channel.clock]
        return [column for column in columns if column is not None]

    def measured(self, tables: Sequence[Table]) -> Measurements:
        """The measurements of tables that have been read, in SI units.

        Raises:
            DataError: the data are not valid; with file, column and line.
        """
        states = self.states.items()
        inputs = self.inputs.items()
        clocks = {name: one.clock for name, one in self._channels.items()}
        # `init` writes the units of headers; one that stands empty was taken away.
        data = Measurements.from_tables(
            tables,
            headers=False,
            states={name: one.column for name, one in states},
            time=self.time.column,
            inputs={name: one.column for name, one in inputs},
            hold={name: one.hold or self.hold for name, one in inputs},
            trajectory=self.trajectory,
            step=self.time.step,
            start=self.time.start or None,
            date_format=self.time.date_format,
            clocks=without(clocks, None),
            units=self.units,  # as they are written
            noise={name: one.noise for name, one in states if one.noise} or None,
        )
        if self.between is not None:
            data = data.between(*self.between)
        if self.detrended is not None:
            data = data.detrended(self.detrended)
        if self.resampled is not None:
            data = data.resampled(self.resampled)
        if self.thinned is not None:
            data = data.thinned(self.thinned)
        return data.in_si()

    def measurements(self, folder: Path) -> Measurements:
        """Read the files.

        Args:
            folder: that of the study file.

        Raises:
            DataError: the data are not valid; with file, column and line.
        """
        paths = self.paths(folder)
        names = zip(paths, run_names(paths), strict=True)
        return self.measured(
            [replace(table_at(one, self), run=run) for one, run in names]
        )


def table_at(
    path: DataFile, section: DataSection | None = None, part: str | None = None
) -> Table:
    """The table of a file, whose suffix tells what it is.

    Without a section of the user, all vectors of the commonest length are taken of a
    MATLAB file, and of a workbook or a logger's file the sheet or group of this name,
    or else the first with content.
    """
    given = section or DataSection(sheet=part, group=part)
    is_unknown = section is None
    reader = reader_of(path)
    (file,) = opened_files(path, as_text=reader == TEXT_READER)
    if reader in ("from_mat", "from_hdf5"):
        return table_of_mat(file, given.wanted) if section else table_of_vectors(file)
    if reader in LOGGERS:
        wanted = None if is_unknown else given.wanted
        return table_of_groups(file, wanted, reader, given.group)
    form = TextFormat(**{name: getattr(given, name) for name in OF_TEXTS})
    if reader == TEXT_READER:
        return table_of_csv(file, given.wanted, form)
    return table_of_excel(file, given.wanted, given.sheet, form, is_unknown)


@typed
@dataclass(frozen=True)
class HeldOut:
    """The held-out data, selected in one of three ways; the other two are None.

    Also describes the data for the final test. Attributes are called like the keys,
    which docs/command_line.md explains.
    """

    runs: tuple[str, ...] | None = None
    share: float | None = None
    after: float | None = None

    def split(self, data: Measurements) -> tuple[Measurements, Measurements]:
        """Training data and data held out.

        Raises:
            DataError: there is no such run, one of the parts would be empty, or a run
                held out is a copy of one that is fitted.
        """
        if self.runs is not None:
            train, held_out = _by_runs(data, self.runs)
        elif self.after is not None:
            after = float(scale_of(data.units["t"]).read(self.after))
            train = data.between(None, float(np.nextafter(after, -np.inf)))
            held_out = data.between(after, None)
        else:
            train, held_out = data.split(round(1 - (self.share or 0.0), 12))
        check_can_judge(train, held_out)
        return train, held_out


def parts_of(
    data: Measurements, held_out: HeldOut | None, final: HeldOut | None
) -> tuple[Measurements, Measurements | None, Measurements | None]:
    """Training data, data held out and data for the end; None for a part there is not.

    Without ``final``, the last of three or more runs is kept for the end; of runs held
    out by their names the last one, or, if that is a single one, the last one to fit.
    """
    last = None
    if final is not None and final.runs != ():
        data, last = final.split(data)
    if held_out is None:
        return data, None, last
    train, judging = held_out.split(data)
    if final is None and data.n_trajectories > 2 and not copies_in(data):
        if len(judging) > 1:
            judging, last = judging[:-1], judging[-1:]
        elif len(train) > 1:
            train, last = train[:-1], train[-1:]
            if held_out.runs is None:
                judging, last = last, judging
    return train, judging, last


def _by_runs(
    data: Measurements, runs: tuple[str, ...]
) -> tuple[Measurements, Measurements]:
    chosen = set(map(data.trajectory_number, runs))
    judging = tuple(data.trajectories[number] for number in sorted(chosen))
    kept = tuple(run for run in data if run not in judging)
    if not kept or not judging:
        raise DataError(
            f"{len(judging)} of {data.n_trajectories} runs are held out; expected at "
            "least one, and at least one to fit."
        )
    return replace(data, trajectories=kept), replace(data, trajectories=judging)


@dataclass(frozen=True)
class StudySection:
    """The section [study], with attributes called like its keys."""

    added: tuple[str, ...] = ()
    effects: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    max_steps: int = 4
    title: str = ""


@dataclass(frozen=True, kw_only=True)
class Sections:
    """All that a study file says, with the names of `StudyFile`."""

    base: Model
    data: DataSection
    held_out: HeldOut | None = None
    final: HeldOut | None = None
    steps: StudySection = StudySection()
    own_effects: tuple[Effect, ...] = ()
    loss: MaximumLikelihood = field(default_factory=MaximumLikelihood)


def told(record: Any) -> dict[str, Any]:
    """The fields of a record that say something: neither None nor the default."""
    return without(chosen_fields(record), None)


def without(content: Mapping[str, Any], *values: Any) -> dict[str, Any]:
    """The entries that have none of these values."""
    return {name: one for name, one in content.items() if one not in values}


def own_effect(name: str, own: Sequence[Effect]) -> Effect | None:
    """The effect of the user's own that is called so, with its place or without."""
    return next((one for one in own if name in (one.name, str(one))), None)
