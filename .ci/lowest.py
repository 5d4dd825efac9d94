"""Print the lowest versions that pyproject.toml lets users have, as constraints."""

import tomllib
from itertools import chain
from pathlib import Path

PROJECT = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
DEVELOPMENT = ("peers", "dev")

bounds = set(PROJECT["dependencies"])
bounds.update(chain(*(EXTRAS[name] for name in EXTRAS if name not in DEVELOPMENT)))
print("# The lower bounds of pyproject.toml, without those of tools for development.")
print("# Written by 'make lowest'.")
print("\n".join(sorted(bound.replace(">=", "==") for bound in bounds)))
