"""Times that a table does not hold as numbers: even steps, and dates.

Both become a column of seconds (or of the step's unit) before the table is read on.
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from phsi_opt.data.tables import Table
from phsi_opt.data.trajectory import Trajectory, part_of
from phsi_opt.errors import DataError

LEAST_SAMPLES = 2  # of a run
COUNTED = "time from the step"  # called so where a table has no column of times
NANOSECONDS = 1e9  # in a second


def counted_times(table: Table, step: float, trajectory: str | None) -> Table:
    """The table with a column `COUNTED`: 0, step, 2 step, ... in each run.

    Args:
        table: as it was read.
        step: time between neighbouring lines.
        trajectory: the column that names the runs.
    """
    frame = table.frame.copy()
    frame[COUNTED] = step * np.arange(len(frame))
    if trajectory is not None and list(frame.columns).count(trajectory) == 1:
        numbers = frame.groupby(trajectory, sort=False).cumcount()
        frame[COUNTED] = step * numbers.to_numpy()
    return replace(table, frame=frame)


def dates_as_seconds(table: Table, column: str) -> Table:
    """The table with dates replaced by seconds since the first of them.

    Raises:
        DataError: a cell is no date.
    """
    frame = table.frame.copy()
    cells = frame[column].astype(str)
    parsed = pd.to_datetime(cells, errors="coerce", format="mixed", utc=True)
    wrong = np.flatnonzero(parsed.isna().to_numpy())
    if len(wrong):
        first = int(wrong[0])
        raise DataError(
            f"{table.place(column, first)} {cells.iloc[first]!r} is not a date; "
            "expected one such as 2021-11-22 09:15:00."
        )
    since_first = (parsed - parsed.iloc[0]).to_numpy("timedelta64[ns]")
    frame[column] = since_first.astype(np.int64) / NANOSECONDS
    return replace(table, frame=frame)


def within(run: Trajectory, begin: float, end: float) -> Trajectory:
    """The samples of a run from one time to another, both included.

    Raises:
        DataError: fewer than two samples are left.
    """
    first = int(np.searchsorted(run.t, begin, side="left"))
    last = int(np.searchsorted(run.t, end, side="right"))
    if last - first < LEAST_SAMPLES:
        raise DataError(
            f"run {run.name!r} goes from t = {run.t[0]:g} to {run.t[-1]:g}; between "
            f"{begin:g} and {end:g} it has {max(last - first, 0)} samples; expected at "
            f"least {LEAST_SAMPLES}."
        )
    return part_of(run, slice(first, last))
