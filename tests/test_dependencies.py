"""Everything that is declared is used, and everything that is used is declared."""

import ast
import re
import sys
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
OWN = {"phsi_opt", "problems", "tests", "model_pages", "result_pages", "room_pages"}

# Nothing imports these: a program of the Makefile, or what another tool loads by name.
TOOLS = {
    "furo",  # sphinx, by html_theme
    "mypy",
    "myst-parser",  # sphinx, by extensions
    "pandas-stubs",  # mypy
    "pre-commit",
    "pytest-xdist",  # pytest, by -n
    "ruff",
}
# What a user must have chosen before these files are imported.
EXTRAS_OF = {
    "phsi_opt/baselines": {"baselines"},
    "phsi_opt/learning": {"neural"},
    "phsi_opt/sweeps/local_workers.py": {"neural"},
    "phsi_opt/page": {"app"},
    "phsi_opt/data/array_reader.py": {"loggers"},
    "phsi_opt/data/logger_reader.py": {"loggers"},
}


def declared(*extras: str) -> set[str]:
    """Names of the distributions of the core, and of the extras."""
    texts = list(PROJECT["dependencies"])
    for extra in extras:
        texts += PROJECT["optional-dependencies"][extra]
    return {_plain(re.split(r"[\s<>=\[;!~]", text)[0]) for text in texts}


@cache
def imported(folder: str) -> dict[str, set[str]]:
    """Names of the distributions that the files of a folder import, with the files."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        if "_build" in path.parts:
            continue
        name = path.relative_to(ROOT).as_posix()
        for module in _modules(path):
            if module not in OWN and module not in sys.stdlib_module_names:
                found.setdefault(_distribution(module), set()).add(name)
    return found


def _modules(path: Path) -> set[str]:
    """Top-level names of the modules that a file imports anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(str(node.module))
    return {name.split(".")[0] for name in names}


def _distribution(module: str) -> str:
    """The distribution that brings a module; its own name where none is installed."""
    return _plain(_installed().get(module, [module])[0])


@cache
def _installed() -> Mapping[str, list[str]]:
    return packages_distributions()  # reads every installed file list: once


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_what_the_package_imports_is_declared_where_it_is_imported() -> None:
    undeclared: dict[str, list[str]] = {}
    for distribution, files in imported("phsi_opt").items():
        for name in files:
            extras: set[str] = set()
            for place, needed in EXTRAS_OF.items():
                if name.startswith(place):
                    extras |= needed
            if distribution not in declared(*extras):
                undeclared.setdefault(distribution, []).append(name)
    assert not undeclared


@pytest.mark.parametrize("folder", ["problems", "tests", "docs"])
def test_what_scripts_tests_and_docs_import_is_declared(folder: str) -> None:
    extras = PROJECT["optional-dependencies"]
    assert set(imported(folder)) <= declared(*extras)


def test_what_is_declared_is_imported() -> None:
    in_package = set(imported("phsi_opt"))
    anywhere = set(in_package)
    for folder in ("problems", "tests", "docs"):
        anywhere |= set(imported(folder))
    assert declared() <= in_package
    extras = PROJECT["optional-dependencies"]
    for extra in extras:
        needed = declared(extra) - declared()
        used = anywhere | TOOLS if extra == "dev" else anywhere
        assert needed <= used, extra


def test_every_declared_version_is_among_the_constraints() -> None:
    text = (ROOT / ".ci" / "constraints.txt").read_text("utf-8")
    held = set()
    for line in text.splitlines():
        if "==" in line:
            held.add(_plain(line.split("==")[0]))
    assert declared(*PROJECT["optional-dependencies"]) <= held
