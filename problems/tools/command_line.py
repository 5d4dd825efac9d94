"""What the scripts read from the command line, and how they print tables.

Names and flags such as ``--seeds=3``; no more than these scripts need.
"""

import sys


def chosen() -> list[str]:
    """The arguments that are names, not options."""
    return [name for name in sys.argv[1:] if not name.startswith("-")]


def flag(name: str) -> bool:
    """Whether ``--name`` was given."""
    return f"--{name}" in sys.argv


def option(name: str, default: str) -> str:
    """The text of ``--name=text``."""
    for argument in sys.argv:
        if argument.startswith(f"--{name}="):
            return argument.split("=", 1)[1]
    return default
