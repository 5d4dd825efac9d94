"""Where the measured data lie: the variable PHSI_OPT_DATA, else ../shared/data from the
project's root.
"""

import os
from pathlib import Path

from problems.tools.command_line import chosen
from problems.tools.provenance import ROOT


def folder(name: str) -> Path:
    """Folder of a set of measurements; it may not exist."""
    default = ROOT.parent / "shared" / "data"
    return Path(os.environ.get("PHSI_OPT_DATA", default)) / name


def given(default: Path) -> Path:
    """The path on the command line, else ``default``."""
    paths = chosen()
    return Path(paths[0]) if paths else default


def is_present(path: Path) -> bool:
    """Whether the data are there; says where they were looked for if not."""
    if path.exists():
        return True
    print(
        f"skipped: the data are not at {path}; "
        "give their path as an argument, or set PHSI_OPT_DATA"
    )
    return False
