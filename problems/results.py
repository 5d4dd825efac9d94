"""Which pages in results/ are older than the code that made them.

    python -m problems.results                  # lists them
    python -m problems.results --run --hours=8  # makes them again, the fastest first

A page begins with the command and the commit that made it. It is out of date if a file
that its script imports, directly or through others, has changed since. A page that
fails is left as it was and reported. Measured data are read from the folder that
PHSI_OPT_DATA names.
"""

import ast
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import typer

from problems.tools.provenance import RESULTS, ROOT, git

PACKAGES = ("phsi_opt", "problems")
HEAD = re.compile(
    r"<!-- command: (?P<command>.+?); commit: (?P<commit>\w+);"
    r"(?: seconds: (?P<seconds>\d+);)?"
)
UNKNOWN_SECONDS = 3600.0  # of a page that does not say how long it took


@dataclass(frozen=True)
class Page:
    """A page of results, by its first line.

    Args:
        path: the page.
        command: what made it.
        commit: the code that made it.
        seconds: how long that took.
    """

    path: Path
    command: str
    commit: str
    seconds: float

    @property
    def module(self) -> str:
        """The script that made it, with dots."""
        return self.command.split()[2]

    @property
    def state(self) -> str:
        """ "current", or why it is not."""
        if git("cat-file", "-e", f"{self.commit}^{{commit}}") is None:
            return f"commit {self.commit} is unknown"
        files = sorted(str(one.relative_to(ROOT)) for one in sources(self.module))
        changed = git("diff", "--name-only", self.commit, "--", *files)
        n_changed = len((changed or "").split())
        return f"{n_changed} files have changed" if n_changed else "current"


def pages() -> list[Page]:
    """The pages that say what made them, the fastest first."""
    found = []
    for path in RESULTS.rglob("*.md"):
        head = HEAD.match(path.read_text("utf-8"))
        if head and head["command"].startswith("python -m "):
            seconds = float(head["seconds"] or UNKNOWN_SECONDS)
            found.append(Page(path, head["command"], head["commit"], seconds))
    return sorted(found, key=lambda page: (page.seconds, page.path))


@cache
def sources(module: str) -> frozenset[Path]:
    """The files of the project that a module needs, its own among them."""
    waiting = [module]
    found: set[Path] = set()
    while waiting:
        path = _file_of(waiting.pop())
        if path is not None and path not in found:
            found.add(path)
            waiting += _imports(path)
    if not found:
        raise FileNotFoundError(f"there is no module {module} in the project")
    return frozenset(found)


def _file_of(module: str) -> Path | None:
    """The file of a module of the project; None for a name inside a module."""
    path = ROOT.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


@cache
def _imports(path: Path) -> tuple[str, ...]:
    """The modules and names of the project that a file, or its stub, imports."""
    found = []
    for source in (path, path.with_suffix(".pyi")):
        if source.exists():
            found += list(_imported(ast.parse(source.read_text("utf-8"))))
    return tuple(one for one in found if one.split(".")[0] in PACKAGES)


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{one.name}" for one in node.names)


def main(run: bool = False, hours: float = 8.0) -> None:
    """List the pages that are out of date, or make them again."""
    stale: dict[str, Page] = {}  # by command: one command may write several pages
    for page in pages():
        state = page.state
        print(f"{page.path.relative_to(ROOT)!s:40} {page.commit:9} {state}")
        if state != "current":
            stale.setdefault(page.command, page)
    print(f"{len(stale)} commands have pages that are out of date.")
    begun = time.monotonic()
    for page in stale.values() if run else ():
        if time.monotonic() - begun + page.seconds > 3600 * hours:
            print(f"not enough time left: {page.command}")
            continue
        print(page.command, flush=True)
        _, *arguments = shlex.split(page.command)
        done = subprocess.run([sys.executable, *arguments], cwd=ROOT, check=False)
        if done.returncode:
            print(f"failed with exit code {done.returncode}: {page.command}")


if __name__ == "__main__":
    typer.run(main)
