"""Tables of the pages in results/."""

from collections.abc import Mapping, Sequence

import pandas as pd


def table(records: pd.DataFrame | Sequence[Mapping[str, object]]) -> str:
    """A table in Markdown; a bar inside a cell would end it and becomes "or"."""
    frame = pd.DataFrame(records)
    header = [str(name) for name in frame.columns]
    rows = [header, ["---"] * len(header), *frame.astype(str).to_numpy().tolist()]
    return "\n".join(_line(row) for row in rows)


def _line(cells: Sequence[object]) -> str:
    shown = [str(cell).replace("|", " or ") for cell in cells]
    return f"| {' | '.join(shown)} |"
