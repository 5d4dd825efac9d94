"""Results of the code of a day, kept as JSON in results/judges."""

import json
from pathlib import Path
from typing import Any

from phsi_opt.writing import write_whole
from problems.tools import provenance

Record = dict[str, Any]


def path_of(name: str) -> Path:
    """The file of a judge; it may not exist."""
    return provenance.RESULTS / "judges" / name


def keep(name: str, records: dict[str, Record]) -> None:
    """Write records by name, with command, commit and machine."""
    path = path_of(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"provenance": provenance.provenance(), "records": records}
    write_whole(path, json.dumps(content, indent=1) + "\n")


def kept(name: str) -> dict[str, Record]:
    """Records by name; none where nothing was kept."""
    path = path_of(name)
    if not path.exists():
        return {}
    return dict(json.loads(path.read_text(encoding="utf-8"))["records"])
