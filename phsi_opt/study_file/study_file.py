"""The study file: measurements, model and study of one text that a person can read.

A study file is TOML; docs/command_line.md lists its keys. Reading one never runs code:
formulas go through the parser of the package.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Self

from phsi_opt.arguments import typed
from phsi_opt.data.checks import Hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError
from phsi_opt.initialization.relative_guesses import check_rates
from phsi_opt.model.catalogue import catalogue, effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.study_file.reading import read_sections
from phsi_opt.study_file.sections import (
    Channel,
    DataSection,
    HeldOut,
    Sections,
    StudySection,
    Times,
    own_effect,
    parts_of,
)
from phsi_opt.study_file.study_text import study_script, study_text
from phsi_opt.sweeps.sweep import Progress
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.writing import write_new, write_whole

if TYPE_CHECKING:
    from phsi_opt.study import Study
    from phsi_opt.study_file.kept_fits import KeptFits

UNWRITTEN = "measurements.csv"  # called so until it is known beside which file it lies


@dataclass(frozen=True, kw_only=True)
class StudyFile(Sections):
    """A study file: `read` reads it from TOML, `write` writes it with comments.

    Attributes:
        base: the base model, without added effects.
        data: the files, their columns, units and noise.
        held_out: the held-out data; None: no data are held out.
        final: the data for a final test; None: one of three or more runs.
        steps: effects added, effects to consider and to exclude.
        own_effects: effects that are not in the catalogue.
        loss: how to fit.
        folder: of the file; the data's paths are relative to it.
        unwritten: measurements that are not in a file yet; `write` writes them.
    """

    folder: Path = Path()
    unwritten: Measurements | None = None

    @classmethod
    @partial(typed, error=DataError)
    def read(cls, path: str | Path, places: Mapping[str, Path] | None = None) -> Self:
        """Read a study file and its data, and check everything in them.

        Args:
            path: of the study file.
            places: paths of data files that are not where the study file says, by their
                names in it; messages and runs keep these names.

        Raises:
            StudyFileError: the file has mistakes; the error lists all of them.
        """
        sections, measured = read_sections(Path(path), places)
        file = cls(**vars(sections), folder=Path(path).parent)
        file.__dict__["_measured"] = measured  # they have been read
        return file

    @classmethod
    @typed
    def of(
        cls,
        model: Model,
        data: DataSection | Measurements,
        held_out: HeldOut | Measurements | None = None,
        *,
        final: HeldOut | Measurements | None = None,
        added: tuple[str, ...] = (),
        effects: tuple[str, ...] | None = None,
        without: tuple[str, ...] = (),
        own_effects: tuple[Effect, ...] = (),
        loss: MaximumLikelihood | None = None,
        folder: str | Path = ".",
    ) -> Self:
        """The study file of a model and of data.

        `write` writes measurements that were not read from files as a table next to the
        study file.

        Args:
            model: the base model.
            data: the files and which column is what; or the measurements to fit.
            held_out: the part of the files that is held out; or, with measurements as
                ``data``, the held-out measurements.
            final: likewise for a final test, as in `Study`; None: with measurements
                as ``data`` there are none.
            added: names of the effects added, such as ``"coulomb friction on p"``.
            effects: names of effects to consider; None: the catalogue.
            without: names of effects to exclude.
            own_effects: effects that are not in the catalogue.
            loss: how to fit; its noise belongs to the channels of ``data``.
            folder: to which the data's paths are relative.

        Raises:
            DataError: training data and held-out data have other channels.
            ModelError: a study file cannot represent a part of the model.
        """
        unwritten = None
        if not isinstance(data, DataSection):
            if isinstance(held_out, HeldOut):
                unwritten = in_written_units(data)
            else:
                unwritten, held_out = joined(data, held_out, "held out")
            if isinstance(final, Measurements):
                unwritten, final = joined(unwritten.in_si(), final, "final")
            final = final or HeldOut(runs=())
            data = section_of(unwritten, UNWRITTEN)
        elif isinstance(held_out, Measurements) or isinstance(final, Measurements):
            raise DataError(
                "held_out or final is Measurements, but data is a DataSection; give a "
                "HeldOut that says which part of the files it is."
            )
        file = cls(
            base=model,
            data=data,
            held_out=held_out,
            final=final,
            steps=StudySection(added, effects, without),
            own_effects=own_effects,
            loss=loss or MaximumLikelihood(),
            folder=Path(folder),
            unwritten=unwritten,
        )
        file.text()  # refuses what cannot be written
        return file

    def with_added(self, *names: str) -> Self:
        """The same with further effects, such as ``"coulomb friction on p"``.

        Raises:
            ModelError: there is no such effect, or the model has it.
        """
        added = (*self.steps.added, *names)
        file = replace(self, steps=replace(self.steps, added=added))
        file.model()  # refuses what is unknown, or there already
        return file

    def with_hold(self, hold: Hold) -> Self:
        """The same where inputs do this between their samples."""
        inputs = {}
        for name, one in self.data.inputs.items():
            held = hold if isinstance(hold, str) else hold[name]
            inputs[name] = replace(one, hold=None if held == self.data.hold else held)
        return replace(self, data=replace(self.data, inputs=inputs))

    def write(self, path: str | Path) -> Path:
        """Write the file, with comments; return its path.

        The paths of the data are adapted to the folder. An existing study file is
        overwritten. Measurements that are not in a file yet are written next to it.

        Raises:
            DataError: the table of the measurements would overwrite another file.
            ModelError: a study file cannot represent a part of the model.
        """
        path = Path(path)
        file = self.moved(path.parent)
        if self.unwritten is not None:
            table = path.with_name(f"{path.stem}_measurements.csv")
            write_table(self.unwritten, table)
            file = replace(file, data=replace(self.data, files=(table.name,)))
        return write_whole(path, file.text())

    def moved(self, folder: str | Path) -> Self:
        """The same study as a file of another folder."""
        folder = Path(folder)
        if os.path.realpath(folder) == os.path.realpath(self.folder):
            return replace(self, folder=folder)
        data = self.data.moved(self.folder, folder)
        return replace(self, data=data, folder=folder)

    def text(self) -> str:
        """The text of the file, TOML with comments.

        Raises:
            ModelError: a study file cannot represent a part of the model.
        """
        return study_text(self)

    def script(self) -> str:
        """The equivalent Python script; it expects the data in its own folder."""
        return study_script(self)

    @cached_property
    def _measured(self) -> Measurements:
        if self.unwritten is not None:
            return self.unwritten.in_si()
        return self.data.measurements(self.folder)

    def measurements(self) -> Measurements:
        """All measurements, for training and held out.

        Raises:
            DataError: the data files are not valid.
        """
        return self._measured

    def check_formulas(self) -> None:
        """Refuse formulas without a finite value at the training measurements.

        Raises:
            ModelError: there is one.
            DataError: the data files are not valid.
        """
        train, _ = self.split()
        model = self.model()
        check_rates(model, AlignedData.of(model, train).grid)

    def split(self) -> tuple[Measurements, Measurements | None]:
        """The training measurements, and the held-out ones (or None).

        Raises:
            DataError: the data files are not valid, or a part is empty.
        """
        return self.parts()[:2]

    def parts(self) -> tuple[Measurements, Measurements | None, Measurements | None]:
        """The data to fit, held-out data, data for a final test; None: no such part.

        Raises:
            DataError: the data files are not valid, or a part is empty.
        """
        return parts_of(self.measurements(), self.held_out, self.final)

    def model(self) -> Model:
        """The model with all effects added so far.

        Raises:
            ModelError: one of the effects is unknown, or the model has it already.
        """
        model = self.base
        for name in self.steps.added:
            model = model.add(self.meant(model, name))
        return model

    def meant(self, model: Model, name: str) -> Effect:
        """The effect with a name such as ``"coulomb friction on p"``.

        Raises:
            ModelError: there is no such effect.
        """
        own = own_effect(name, self.own_effects)
        return own or effect_named(model, name, units=self.measurements().units)

    def effects(self) -> list[Effect | str] | None:
        """The effects to consider, as `Study` takes them; None: the catalogue."""
        names = self.steps.effects
        if names is None:
            if not self.own_effects:
                return None
            offered = catalogue(self.base, self.measurements().units)
            return [*map(str, offered), *self.own_effects]
        return [own_effect(name, self.own_effects) or name for name in names]

    def study(
        self,
        progress: Progress | None = None,
        after_each: "Callable[[Study], None] | None" = None,
        kept: "KeptFits | None" = None,
    ) -> "Study":
        """The study: the base model fitted, then each effect added.

        Args:
            progress: called with a line of text about the progress, such as ``print``.
            after_each: called with the study after each of these steps.
            kept: fits and diagnoses that are taken instead of new ones.

        Raises:
            DataError: the data files are not valid.
            ModelError: one of the effects is unknown.
            SolveError: a model could not be fitted.
        """
        from phsi_opt.study import Study  # what checking a file does not need

        train, held_out, final = self.parts()
        study = Study(
            self.base,
            train,
            held_out,
            final=final,
            effects=self.effects(),
            without=self.steps.without,
            loss=self.loss,
            title=self.steps.title or f"Study of {', '.join(self.data.files)}",
            progress=progress,
            fit=None if kept is None else kept.with_effects(),
        )
        if kept is not None:
            study.recalled = kept.diagnosis
        tell = after_each or (lambda study: None)
        tell(study)
        for name in self.steps.added:
            effect = self.meant(study.model, name)
            added = (*study.added, effect)
            study.add(effect, fit=None if kept is None else kept.with_effects(added))
            tell(study)
        return study


# ---- measurements that lie in no file yet --------------------------------------------


def section_of(data: Measurements, file: str) -> DataSection:
    """The section [data] of measurements that are written by `write_table`."""
    noise = data.noise or {}
    states = {}
    for name in data.states:
        column = name if name in data.measured else None
        states[name] = Channel(column, data.units[name], noise.get(name))
    hold = data.hold
    by_input: Mapping[str, str] = {} if isinstance(hold, str) else hold
    inputs = {}
    for name in data.inputs:
        inputs[name] = Channel(name, data.units[name], hold=by_input.get(name))
    return DataSection(
        files=(file,),
        time=Times("t", data.units["t"]),  # columns as in `Measurements.to_dataframe`
        states=states,
        inputs=inputs,
        trajectory="trajectory",
        hold=hold if isinstance(hold, str) else "linear",
    )


def write_table(data: Measurements, path: Path) -> None:
    """Write the measurements as CSV, every number with all digits."""
    unmeasured = [name for name in data.states if name not in data.measured]
    frame = data.to_dataframe().drop(columns=unmeasured)
    text = frame.to_csv(index=False, lineterminator="\n")
    otherwise = "move it, or write the study file under another name."
    write_new(path, text.encode(), otherwise)


def in_written_units(data: Measurements) -> Measurements:
    """Measurements for a study file, which computes in SI units."""
    if data.in_si() is not data:
        units = ", ".join(filter(None, data.units.values()))
        raise DataError(
            f"the data are in {units}, and a study file computes in SI units. Give "
            "data.in_si(), and a model whose numbers are in SI units."
        )
    return data.as_written()


def joined(
    train: Measurements, held_out: Measurements | None, part: str
) -> tuple[Measurements, HeldOut | None]:
    """Training data and data held out as one, and what tells them apart again.

    A run that was split in time becomes two; the second one has the part in its name.
    """
    train = in_written_units(train)
    if held_out is None:
        return train, None
    held_out = in_written_units(held_out)
    for what in ("states", "inputs", "units", "hold", "noise"):
        one = getattr(train, what)
        other = getattr(held_out, what)
        if one != other:
            raise DataError(
                f"{what} of the data held out, {other}, differ from {one} of the "
                "training data; a study file has one description for both."
            )
    runs = {run.name: run for run in train.trajectories}
    judging = []
    for run in held_out.trajectories:
        name = f"{run.name} {part}" if run.name in runs else run.name
        runs[name] = replace(run, name=name)
        judging.append(name)
    both = replace(train, trajectories=tuple(runs.values()))
    return both, HeldOut(runs=tuple(judging))
