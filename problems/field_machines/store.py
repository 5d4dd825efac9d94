"""The tables in which examined cases are kept: results/field_machines/<kind>.csv, and
<kind>_prepared.csv for the preparations.

A case is appended as it is examined, so that an interrupted run goes on where it
stopped.
"""

from pathlib import Path

import pandas as pd

from problems.field_machines.preparation import PREPARED
from problems.tools import provenance
from problems.tools.kept_tables import append_rows

COLUMNS = [
    "kind",
    "seed",
    "noise",
    "hidden",
    "truth",
    "coefficient",
    "listed",
    "disturbance",
    "ratio",
    "disturbed",
    "measured",
    "inputs",
    "free",
    "n_train",
    "sensor",
    "answer",
    "findings",
    "verdicts",
    "added",
    "after",
    "seconds",
    "drawing",
    "outcome",
    "commit",
]
PREPARED_COLUMNS = ["kind", "seed", *PREPARED, "same", "outcome", "commit"]
FORMAT = "%.6g"
TEXTS = ("truth", "findings", "verdicts", "added", "inputs", "free", "answer")


def path_of(kind: str, is_prepared: bool = False) -> Path:
    """The table of a kind; it may not exist."""
    end = "_prepared" if is_prepared else ""
    return provenance.RESULTS / "field_machines" / f"{kind}{end}.csv"


def table(kind: str, is_prepared: bool = False) -> pd.DataFrame:
    """The kept cases of a kind, in the order of their seeds."""
    path = path_of(kind, is_prepared)
    if not path.exists():
        return pd.DataFrame(columns=_columns(is_prepared))
    texts = PREPARED if is_prepared else TEXTS
    # As written: a column of "false" alone would be read as a truth value.
    rows = pd.read_csv(path, dtype=dict.fromkeys(texts, str))
    rows[list(texts)] = rows[list(texts)].fillna("")
    return rows.sort_values("seed", kind="stable", ignore_index=True)


def append(record: dict[str, object], is_prepared: bool = False) -> None:
    """Keep one more case."""
    path = path_of(str(record["kind"]), is_prepared)
    line = pd.DataFrame([record], columns=_columns(is_prepared))
    append_rows(path, line, FORMAT)


def _columns(is_prepared: bool) -> list[str]:
    return PREPARED_COLUMNS if is_prepared else COLUMNS
