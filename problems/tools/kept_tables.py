"""Tables of results that grow while they are computed, and are never cut."""

from pathlib import Path

import pandas as pd

from phsi_opt.writing import write_whole


def append_rows(path: Path, rows: pd.DataFrame, float_format: str) -> None:
    """Add rows below those of a table, which may not exist yet.

    What was there stays to the byte, but for a last line that an older program's end
    has cut.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = path.read_text(encoding="utf-8") if path.exists() else ""
    whole = kept[: kept.rfind("\n") + 1]
    added = rows.to_csv(index=False, header=not whole, float_format=float_format)
    write_whole(path, whole + added)


def rewrite(path: Path, rows: pd.DataFrame, float_format: str | None = None) -> None:
    """Write a table anew."""
    write_whole(path, rows.to_csv(index=False, float_format=float_format))
