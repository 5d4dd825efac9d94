"""Where the measured data lie: --data=FOLDER on the command line, else the variable
PHSI_OPT_DATA, else ../shared/data from the project's root.
"""

import os
from pathlib import Path

from problems.tools.command_line import option
from problems.tools.provenance import ROOT


def folder(name: str) -> Path:
    """Folder of a set of measurements; it may not exist."""
    default = os.environ.get("PHSI_OPT_DATA", str(ROOT.parent / "shared" / "data"))
    return Path(option("data", default)) / name


def is_present(path: Path) -> bool:
    """Whether the data are there; says where they were looked for if not."""
    if not path.exists():
        print(
            f"skipped: the data are not at {path}; "
            "give their folder as --data=FOLDER, or set PHSI_OPT_DATA"
        )
    return path.exists()
