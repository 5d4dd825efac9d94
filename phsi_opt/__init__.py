"""Identify energy-based models of dynamical systems from measurements.

A name is imported from its module when it is first asked for, so that a command such as
``phsi-opt --help`` does not wait for the solver's libraries. Which name is where stands
in ``__init__.pyi``, which type checkers read too.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any


def _module_of_each() -> dict[str, str]:
    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    modules = {}
    for line in ast.parse(stub).body:
        if isinstance(line, ast.ImportFrom):
            modules |= {one.name: str(line.module) for one in line.names}
    return modules


MODULES = _module_of_each()
__all__ = sorted(MODULES)


def __getattr__(name: str) -> Any:
    """A public name, imported from its module."""
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(MODULES[name]), name)
    globals()[name] = value  # the next time it is found at once
    return value


def __dir__() -> list[str]:
    """The public names."""
    return list(__all__)
