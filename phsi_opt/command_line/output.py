"""What a command says: texts on standard output, or JSON and nothing else.

Progress, and what went wrong, go to standard error.
"""

import contextlib
import json
import sys
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import typer

from phsi_opt.command_line.exit_codes import ExitCode
from phsi_opt.command_line.job import Answer, Job
from phsi_opt.command_line.supervision import Supervised, supervise
from phsi_opt.command_line.worker import answer_to
from phsi_opt.errors import PhsiOptError


def finish(answer: Answer, as_json: bool, **further: Any) -> NoReturn:
    """Say an answer and end with its exit code.

    Args:
        answer: what there is to say.
        as_json: whether standard output is for a program.
        **further: more for JSON.

    Raises:
        typer.Exit: always, with the exit code.
    """
    is_done = answer.code in (ExitCode.DONE, ExitCode.MISSING)
    if as_json:
        _print_json({**answer.content, **further}, answer.code)
    elif is_done:
        typer.echo(answer.text)
    if not is_done:
        typer.echo(answer.text, err=True)
    raise typer.Exit(int(answer.code))


def _print_json(content: Mapping[str, Any], code: int) -> None:
    everything = {"exit_code": int(code), **content}
    typer.echo(json.dumps(everything, indent=1, allow_nan=False, default=str))


@contextlib.contextmanager
def told_errors(as_json: bool = False) -> Iterator[None]:
    """Say what the package refuses, without a trace, and end with the exit code.

    Raises:
        typer.Exit: where something was refused.
    """
    try:
        yield
    except PhsiOptError as error:
        finish(answer_to(error), as_json)


def do(job: Job, as_json: bool) -> NoReturn:
    """Have a job done, say how it ended, and end with the exit code.

    Raises:
        typer.Exit: always, with the exit code.
    """
    ended = supervise(job)
    written = [str(path) for path in ended.files]
    if ended.answer is None:
        _interrupted(ended, as_json)
    if not as_json:
        for path in written:
            typer.echo(f"written: {path}", err=True)
    finish(ended.answer, as_json, written=written, seconds=round(ended.seconds, 2))


def _interrupted(ended: Supervised, as_json: bool) -> NoReturn:
    """Say what was kept, and how to go on from it."""
    kept = ended.kept
    content: dict[str, Any] = {"interrupted": True}
    said = [f"stopped after {ended.seconds:.0f} s."]
    if kept is None:
        said.append("No step was finished; nothing was written.")
    else:
        content.update(kept.content)
        said.append("Kept are the steps that were finished:")
        said.append(kept.text)
        said += [f"written: {path}" for path in ended.files]
        if kept.added:
            names = ", ".join(kept.added)
            said.append(f"Effects in the last step: {names}.")
    content["written"] = [str(path) for path in ended.files]
    if as_json:
        _print_json(content, ExitCode.INTERRUPTED)
    sys.stdout.flush()
    typer.echo("\n".join(said), err=True)
    raise typer.Exit(int(ExitCode.INTERRUPTED))
