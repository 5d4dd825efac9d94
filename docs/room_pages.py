"""The pages of the rooms, written from what is in the package.

The order of the rooms is that of ``[tool.importlinter]`` in pyproject.toml, their
one-line descriptions those of design.md; every public module of a room is on its page.
"""

import re
import tomllib
from pathlib import Path

FOLDER = "rooms/"
DESCRIPTION = re.compile(r"^ (\w+) {2,}(\S.*)$", re.MULTILINE)
INDEX = """\
The rooms
=========

The sub-packages (rooms), from high level to low level. A room imports only from rooms
below it; see :doc:`/design`. The reference documents the names that users import from
``phsi_opt``.

.. toctree::
   :maxdepth: 1

"""


def write(docs: Path) -> None:
    """Write ``rooms/index.rst`` and a page per room into the folder of the docs."""
    package = docs.parent / "phsi_opt"
    described = dict(DESCRIPTION.findall((docs / "design.md").read_text()))
    pages = {}
    toctree = ""
    for room in _rooms(docs.parent / "pyproject.toml"):
        pages[f"{room}.rst"] = _page(package, room, described.get(room, ""))
        toctree += f"   {room}\n"
    pages["index.rst"] = INDEX + toctree
    folder = docs / FOLDER
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.rst"):
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        _write_if_changed(folder / name, text)


def _rooms(pyproject: Path) -> list[str]:
    configuration = tomllib.loads(pyproject.read_text())
    contracts = configuration["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c["id"] == "rooms")
    rooms = []
    for layer in layers:
        rooms.extend(layer.split(" : "))
    return rooms


def _page(package: Path, room: str, description: str) -> str:
    name = room.replace("_", " ").capitalize()
    module = f"phsi_opt.{room}"
    if (package / f"{room}.py").exists():
        return f"{_title(name, '=')}.. automodule:: {module}\n"
    sentence = f"{description[:1].upper()}{description[1:]}."
    text = f"{_title(name, '=')}{sentence}\n\n"
    if (package / room / "__init__.py").read_text():
        text += f".. automodule:: {module}\n   :no-members:\n\n"
    for path in sorted((package / room).glob("[!_]*.py")):
        part = f"{module}.{path.stem}"
        text += f"{_title(part, '-')}.. automodule:: {part}\n\n"
    return text


def _title(name: str, underline: str) -> str:
    escaped = name.replace("_", r"\_")
    return f"{escaped}\n{underline * len(escaped)}\n\n"


def _write_if_changed(path: Path, text: str) -> None:
    """An untouched file is not read by Sphinx again."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)
