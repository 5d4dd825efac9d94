"""What the tests of the page share: small tables, and a server on a free port."""

import os
import re
import shutil
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from problems.examples.friction_spring import CSV
from tests.waiting import HANGS_AFTER, wait_for

if TYPE_CHECKING:
    from playwright.sync_api import Page

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
RUNS = ("run 1", "run 2", "run 3")


def thinned_table(text: str) -> bytes:
    """Every second sample of three runs: enough to see the friction, sooner solved."""
    lines = text.splitlines()
    kept = [lines[0]]
    for number, line in enumerate(lines):
        if line.startswith(RUNS) and number % 2:
            kept.append(line)
    return "\n".join(kept).encode()


def spring_table() -> bytes:
    """The spring of the demonstration, with its hidden friction."""
    return thinned_table(CSV.read_text())


# The header of a table that is a pickle at once: it runs a command where it is read.
LOADED_PICKLE = "Va,\"x\ncos\nsystem\n(S'touch {}'\ntR.\""


def loaded_table(marker: Path) -> bytes:
    """A table whose header makes a file where somebody unpickles it."""
    return f"{LOADED_PICKLE.format(marker)}\n0,1\n1,2\n2,3\n3,5\n".encode()


def browser_path() -> str:
    """An installed Chromium; skips where there is none, and fails in CI."""
    for name in BROWSERS:
        found = shutil.which(name)
        if found:
            return found
    reason = f"none of {', '.join(BROWSERS)} is installed (make browser installs one)"
    if os.environ.get("CI") == "true":
        pytest.fail(reason)
    pytest.skip(reason)


SERVER = """
if __name__ == "__main__":  # the processes that it starts do not need these
    from phsi_opt.command_line.__main__ import main
    from phsi_opt.page import draft_views, session
    from tests import page_tools
    {changed}
    main()
"""


def endless(*_: object) -> None:
    """Take the place of what reads files, and never give Python back."""
    re.match("(a+)+$", "a" * 60 + "b")


@contextmanager
def served(folder: Path, changed: str = "", failure: str = "") -> Iterator[str]:
    """The page in a process of its own, on a free port; its address.

    Whatever it does meanwhile, it logs no exception.

    Args:
        folder: of its files.
        changed: Python that changes the server before it starts.
        failure: the only exception that it logs after all.
    """
    port = _free_port()
    script, log = folder / "server.py", folder / "server.log"
    script.write_text(SERVER.format(changed=changed))
    with log.open("w") as output:
        server = subprocess.Popen(
            [sys.executable, script, "page", "--no-show", "--port", str(port)],
            cwd=folder,
            env={**_environment(), "TMPDIR": str(folder)},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    address = f"http://127.0.0.1:{port}"
    try:
        wait_for(lambda: _is_up(address), server)
        yield address
    finally:
        server.terminate()
        try:
            server.wait(10)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait(10)
    logged = log.read_text()
    failures = re.findall("(?m)^Traceback.*(?:\n .*)*\n(.*)", logged)
    assert set(failures) == ({failure} if failure else set()), logged


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _environment() -> dict[str, str]:
    """Without what tells the framework that it is under test, and with the package."""
    root = str(Path(__file__).resolve().parents[1])
    environment = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
    for name in list(environment):
        if name.startswith(("PYTEST", "NICEGUI")):
            del environment[name]
    return environment


def _is_up(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=HANGS_AFTER):
            return True
    except OSError:
        return False


def faults(page: "Page") -> list[str]:
    """What keeps people from using a page, by axe-core: serious and critical faults."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page).response["violations"]
    told = []
    for one in found:
        places = [node["html"][:200] for node in one["nodes"]]
        if one["impact"] in ("serious", "critical"):
            told.append(f"{one['help']}: {places}")
    return told
