"""What the scripts read from the command line.

Names and flags such as ``--seeds=3``; no more than these scripts need. ``--help``
prints the first lines of a script.
"""

import sys

if "--help" in sys.argv and "problems" in sys.argv[0]:
    print(sys.modules["__main__"].__doc__)
    raise SystemExit(0)


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
