"""The steps of a study as a table: what was done, and the errors since."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from phsi_opt.presentation.table_making import printed_table
from phsi_opt.study.step import Step

if TYPE_CHECKING:
    import pandas as pd

HISTORY_COLUMNS = (
    "step",
    "effect",
    "train_rmse",
    "held_out_rmse",
    "noise_floor",
    "bic",
)


def history_table(steps: Sequence[Step]) -> "pd.DataFrame":
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
    return printed_table(rows, columns=list(HISTORY_COLUMNS))
