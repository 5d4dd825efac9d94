"""Where the measured data lie: the variable PHSI_OPT_DATA, else ../shared/data from the
project's root.
"""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def folder(name: str) -> Path:
    """Folder of a set of measurements; it may not exist."""
    return Path(os.environ.get("PHSI_OPT_DATA", ROOT.parent / "shared" / "data")) / name
