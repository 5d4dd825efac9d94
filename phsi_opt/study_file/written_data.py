"""Measurements that lie in no file yet: the table, and the section that reads it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError
from phsi_opt.reading import file_text
from phsi_opt.study_file.sections import Channel, DataSection, HeldOut, Times
from phsi_opt.writing import write_whole

RUN_COLUMN = "trajectory"  # as in `Measurements.to_dataframe`
TIME_COLUMN = "t"


def section_of(data: Measurements, file: str) -> DataSection:
    """The section [data] of measurements that are written by `write_table`."""
    noise = data.noise or {}
    states = {}
    for name in data.states:
        column = name if name in data.measured else None
        states[name] = Channel(column, data.units[name], noise.get(name))
    hold = data.hold
    inputs = {}
    for name in data.inputs:
        own = None if isinstance(hold, str) else hold[name]
        inputs[name] = Channel(name, data.units[name], hold=own)
    return DataSection(
        files=(file,),
        time=Times(TIME_COLUMN, data.units["t"]),
        states=states,
        inputs=inputs,
        trajectory=RUN_COLUMN,
        hold=hold if isinstance(hold, str) else "linear",
    )


def write_table(data: Measurements, path: Path) -> None:
    """Write the measurements as CSV.

    Raises:
        DataError: another file is there.
    """
    unmeasured = [name for name in data.states if name not in data.measured]
    frame = data.to_dataframe().drop(columns=unmeasured)
    text = frame.to_csv(
        index=False, lineterminator="\n"
    )  # every number with all digits
    if path.exists() and not _holds(path, text):
        raise DataError(
            f"{path} is there already and holds something else; move it, or write the "
            "study file under another name."
        )
    write_whole(path, text)


def _holds(path: Path, text: str) -> bool:
    try:
        return file_text(path) == text
    except (OSError, UnicodeDecodeError):  # no regular file, or none of text
        return False


def joined(
    train: Measurements, held_out: Measurements | None
) -> tuple[Measurements, HeldOut | None]:
    """Training data and data held out as one, and what tells them apart again.

    Raises:
        DataError: they have other channels, or runs of one name that are not parts of
            one record, cut at one time.
    """
    if held_out is None:
        return train, None
    for what in ("states", "inputs", "units", "hold", "noise"):
        one = getattr(train, what)
        other = getattr(held_out, what)
        if one != other:
            raise DataError(
                f"{what} of the data held out, {other}, differ from {one} of the "
                "training data; a study file has one description for both."
            )
    names = [run.name for run in train.trajectories]
    judging = [run.name for run in held_out.trajectories]
    if not set(names) & set(judging):
        both = (*train.trajectories, *held_out.trajectories)
        return replace(train, trajectories=both), HeldOut(runs=tuple(judging))
    cut = float(held_out.stacked("t").min())
    if names != judging or float(train.stacked("t").max()) >= cut:
        raise DataError(
            f"the runs {names} and those held out, {judging}, have names in common and "
            "are not cut at one time; give the runs names of their own."
        )
    whole = []
    for first, then in zip(train.trajectories, held_out.trajectories, strict=True):
        parts: dict[str, Any] = {
            label: np.concatenate([getattr(first, label), getattr(then, label)])
            for label in ("t", "x", "u")
        }
        whole.append(replace(first, **parts))
    return replace(train, trajectories=tuple(whole)), HeldOut(after=cut)
