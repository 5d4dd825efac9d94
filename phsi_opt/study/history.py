"""The steps of a study as a table: what was done, and the errors since."""

from collections.abc import Sequence

import pandas as pd

from phsi_opt.presentation.tables import PrintedTable
from phsi_opt.study.step import Step

HISTORY_COLUMNS = (
    "step",
    "effect",
    "train_rmse",
    "held_out_rmse",
    "noise_floor",
    "bic",
)


def history_table(steps: Sequence[Step]) -> pd.DataFrame:
    """A row per step, in `HISTORY_COLUMNS`; held_out_rmse NaN without such data."""
    rows = []
    for number, step in enumerate(steps):
        held_out = float("nan")
        if step.held_out is not None:
            held_out = step.held_out.rmse
        rows.append(
            (
                number,
                step.label,
                step.train.rmse,
                held_out,
                step.judged.noise_floor,
                step.fit.bic,
            )
        )
    return PrintedTable(rows, columns=list(HISTORY_COLUMNS))
