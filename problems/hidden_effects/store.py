"""The tables in which the examined cases are kept."""

from pathlib import Path

import pandas as pd

from problems.tools.provenance import RESULTS

FOLDER = RESULTS / "hidden_effects"


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


def path_of(name: str) -> Path:
    return FOLDER / f"{name}.csv"


def table(name: str) -> pd.DataFrame:
    """The kept cases of a row."""
    return pd.read_csv(path_of(name))
