"""The tables in which the examined cases are kept: results/hidden_effects/<row>.csv.

A case is appended as it is examined, so that an interrupted run goes on where it
stopped.
"""

from pathlib import Path

import pandas as pd

from problems.tools import provenance
from problems.tools.kept_tables import append_rows, rewrite

COLUMNS = [
    "row",
    "seed",
    "noise",
    "masses",
    "measured",
    "input",
    "free",
    "known",
    "n_train",
    "truth",
    "equation",
    "value",
    "listed",
    "target",
    "base_ratio",
    "base_error",
    "verdict",
    "first",
    "first_equation",
    "confusable_with",
    "right",
    "tie",
    "misfit",
    "coefficient",
    "std_error",
    "covered",
    "after",
    "rank",
    "added",
    "seconds",
    "drawing",
    "outcome",
    "commit",
]
FORMAT = "%.6g"


def path_of(name: str) -> Path:
    """The table of a row; it may not exist."""
    return provenance.RESULTS / "hidden_effects" / f"{name}.csv"


def table(name: str) -> pd.DataFrame:
    """The kept cases of a row; none where it was not run."""
    path = path_of(name)
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    return pd.read_csv(path)


def append(record: dict[str, object]) -> None:
    """Keep one more case."""
    line = pd.DataFrame([record], columns=COLUMNS)
    append_rows(path_of(str(record["row"])), line, FORMAT)


def sort(name: str) -> pd.DataFrame:
    """Put the cases of a row in the order of their seeds."""
    rows = table(name).sort_values("seed", kind="stable")
    rewrite(path_of(name), rows, FORMAT)
    return rows
