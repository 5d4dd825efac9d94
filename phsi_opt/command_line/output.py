"""What a command says: texts on standard output, or JSON and nothing else.

Progress, and what went wrong, go to standard error.
"""

import contextlib
import json
import shutil
import sys
import textwrap
from collections.abc import Iterator
from typing import Any, NoReturn, TextIO

import typer

from phsi_opt.command_line.job import Answer, ExitCode, Job
from phsi_opt.command_line.supervision import Supervised, answer_to, supervise
from phsi_opt.errors import DataError, PhsiOptError
from phsi_opt.study_file.study_text import add_effects


def finish(answer: Answer, as_json: bool, **further: Any) -> NoReturn:
    """Say an answer and end with its exit code.

    Args:
        answer: what there is to say.
        as_json: whether standard output is for a program.
        **further: more for JSON.
    """
    is_done = answer.code in (ExitCode.DONE, ExitCode.MISSING)
    if as_json:
        content = {"exit_code": int(answer.code), **answer.content, **further}
        typer.echo(json.dumps(content, indent=1, allow_nan=False, default=str))
    if not (is_done and as_json):
        stream = sys.stdout if is_done else sys.stderr
        typer.echo(_fitted(answer.text, stream), file=stream)
    raise typer.Exit(int(answer.code))


def _fitted(text: str, stream: TextIO) -> str:
    """Sentences broken at words where a terminal would break them anywhere."""
    if not stream.isatty():
        return text
    width = shutil.get_terminal_size().columns
    lines = []
    for line in text.split("\n"):
        indent = " " * (len(line) - len(line.lstrip()) + 2)
        broken = textwrap.wrap(line, width, subsequent_indent=indent)
        lines += broken if len(line) > width else [line]
    return "\n".join(lines)


@contextlib.contextmanager
def told_errors(as_json: bool = False) -> Iterator[None]:
    """Say what the package refuses, without a trace, and end with the exit code."""
    try:
        yield
    except PhsiOptError as error:
        finish(answer_to(error), as_json)


def do(job: Job, as_json: bool) -> NoReturn:
    """Have a job done, say how it ended, and end with the exit code."""
    with told_errors(as_json):
        check_places(job)
    ended = supervise(job)
    kept = ended.kept
    found = [] if kept is None else list(kept.found)
    files = [] if kept is None else list(map(str, kept.files))
    notes = [f"written: {file}" for file in files]
    if found:
        notes += _found_effects(job, found)
    further = {"written": files, "seconds": round(ended.seconds, 2), "found": found}
    if ended.answer is None:
        finish(_interrupted(ended, notes), as_json, **further)
    if not as_json:
        typer.echo("\n".join(notes), err=True, nl=bool(notes))
    if ended.answer.code == ExitCode.FAILED and kept is not None:
        further = {**kept.content, **further}
        if not as_json:
            typer.echo(f"The steps that were finished are kept:\n{kept.text}")
    finish(ended.answer, as_json, **further)


def check_places(job: Job) -> None:
    """Say before the work, not after it, that a file cannot be written.

    Raises:
        DataError: a folder is not there.
    """
    for path in job.places:
        if path.is_dir() or not path.parent.is_dir():
            raise DataError(
                f"{path} cannot be written: {path.parent} is no folder, or {path} is "
                "one. Give the name of a file in a folder that is there."
            )


def _found_effects(job: Job, found: list[str]) -> list[str]:
    """What became of the effects that were found, or what can become of them."""
    if not job.write:
        commands = [f'phsi-opt add "{name}" {job.study}' for name in found]
        return ["to keep what was found in the study file:", *commands]
    try:
        backup = add_effects(job.study, found)
    except PhsiOptError as error:
        return [str(error)]
    return [f"written into {job.study}: {', '.join(found)}; before: {backup}"]


def _interrupted(ended: Supervised, notes: list[str]) -> Answer:
    """What was kept, and how to go on from it."""
    said = [f"stopped after {ended.seconds:.0f} s."]
    content: dict[str, Any] = {"interrupted": True}
    if ended.kept is None:
        said.append("No step was finished; nothing was written.")
    else:
        content |= ended.kept.content
        said += ["The steps that were finished are kept:", ended.kept.text, *notes]
    return Answer("\n".join(said), content, ExitCode.INTERRUPTED)
