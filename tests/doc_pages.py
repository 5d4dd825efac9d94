"""README and pages in docs/ as programs: Python blocks and commands, run in order.

A fence of Python is run in the page's namespace, a ``console`` fence runs its lines
that begin with ``$ phsi-opt``, a ``toml`` fence that begins with ``# NAME.toml`` is
written into that file. A ``text`` fence after either is what it printed: the
lines must be there, in this order, where ``...`` stands for any lines or the rest of
one. Words and whole numbers agree exactly, others as they are printed: what was printed,
rounded to the digits that are shown, is what is shown.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from markdown_it import MarkdownIt

from problems.examples.docs_data import FOLDER

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
HOW_TO = "how_to"
# A page whose files come with the package: what `phsi-opt demo` writes.
DEMO_DATA = ROOT / "phsi_opt" / "study_file" / "examples" / "spring"
WITH_DEMO_DATA = ("command_line",)
RUN = ("python", "console", "toml")
FILE_NAME = re.compile(r"# (\w+\.toml)\n")
PROGRAM = "$ phsi-opt "
ANYTHING = "..."
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    """A fence of a page: its language, its text, and the line that it begins on."""

    language: str
    text: str
    line: int


def blocks_of(page: Path) -> list[Block]:
    """The fences of a page that are run or compared."""
    found = []
    for token in MarkdownIt().parse(page.read_text("utf-8")):
        if token.type == "fence" and token.map is not None:
            language = token.info.strip()
            if language in (*RUN, "text"):
                found.append(Block(language, token.content, token.map[0] + 1))
    return found


def pages() -> list[Path]:
    """The pages that have something to run."""
    found = []
    for page in sorted(DOCS.rglob("*.md")):
        is_built = "_build" in page.parts
        if not is_built and any(block.language in RUN for block in blocks_of(page)):
            found.append(page)
    return found


def name_of(page: Path) -> str:
    """A page by its place in the documentation."""
    return page.relative_to(DOCS).with_suffix("").as_posix()


def run_as_shown(page: Path) -> int:
    """Run a page beside its data in the present folder, and compare what it prints.

    Returns:
        How many blocks were run.
    """
    shipped = DEMO_DATA if name_of(page) in WITH_DEMO_DATA else FOLDER
    for data in shipped.iterdir():
        shutil.copy(data, Path.cwd())
    for block, printed in run_page(page):
        where = f"{name_of(page)}.md, line {block.line}"
        assert not first_difference(block.text, printed), f"{where}\n{printed}"
    return sum(block.language in RUN for block in blocks_of(page))


def run_page(page: Path) -> list[tuple[Block, str]]:
    """Run the blocks of a page in the present folder.

    Returns:
        Each block of expected text with what was printed by the block before it.
    """
    namespace = {"__name__": "__main__"}
    printed = ""
    shown = []
    for block in blocks_of(page):
        if block.language == "text":
            shown.append((block, printed))
        elif block.language == "python":
            printed = _run_python(block, page, namespace)
        elif block.language == "console":
            printed = _run_commands(block.text)
        else:
            _write_file(block.text)
    return shown


def _run_python(block: Block, page: Path, namespace: dict[str, str]) -> str:
    lines_before = "\n" * block.line  # so that a traceback names the line of the page
    code = compile(lines_before + block.text, str(page), "exec")
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(code, namespace)
    return output.getvalue()


def _write_file(text: str) -> None:
    name = FILE_NAME.match(text)
    if name is not None:
        Path(name[1]).write_text(text, "utf-8")


def _run_commands(text: str) -> str:
    printed = ""
    for line in text.splitlines():
        assert line.startswith(PROGRAM), f"{line!r} is no command that is tested"
        arguments = shlex.split(line.removeprefix(PROGRAM))
        command = [sys.executable, "-m", "phsi_opt.command_line", *arguments]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        printed += done.stdout
    return printed


def first_difference(shown: str, printed: str) -> str:
    """The first shown line that was not printed where it should be; "" if none.

    Args:
        shown: lines of the page; a line ``...`` stands for any lines.
        printed: what was printed.
    """
    lines = [line for line in printed.splitlines() if line.strip()]
    may_skip = False
    at = 0
    for expected in shown.splitlines():
        if expected.strip() == ANYTHING:
            may_skip = True
        elif expected.strip():
            found = _find(expected, lines, at, may_skip)
            if found is None:
                return expected
            at = found + 1
            may_skip = False
    is_all = may_skip or at == len(lines)
    return "" if is_all else f"more was printed: {lines[at]}"


def _find(expected: str, lines: list[str], at: int, may_skip: bool) -> int | None:
    last = len(lines) if may_skip else min(at + 1, len(lines))
    for number in range(at, last):
        if agree(expected, lines[number]):
            return number
    return None


def agree(expected: str, line: str) -> bool:
    """Whether words are the same, and numbers when rounded to the digits shown."""
    if expected.rstrip().endswith(ANYTHING):
        expected = expected.rstrip().removesuffix(ANYTHING)
        n_numbers = len(NUMBER.findall(expected))
        words = NUMBER.split(line)[: n_numbers + 1]
        words[-1] = words[-1].lstrip()[: len(NUMBER.split(expected)[-1].strip())]
        numbers = NUMBER.findall(line)[:n_numbers]
    else:
        words = NUMBER.split(line)
        numbers = NUMBER.findall(line)
    wanted = [" ".join(part.split()) for part in NUMBER.split(expected)]
    if wanted != [" ".join(part.split()) for part in words]:
        return False
    pairs = zip(NUMBER.findall(expected), numbers, strict=True)
    return all(_close(first, second) for first, second in pairs)


def _close(shown: str, printed: str) -> bool:
    if shown.isdigit():  # a count
        return shown == printed
    last_digit = Decimal(1).scaleb(int(Decimal(shown).as_tuple().exponent))
    return abs(Decimal(shown) - Decimal(printed)) <= last_digit / 2
