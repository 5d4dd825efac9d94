"""How a command is carried out: in a process of its own, which Ctrl-C ends at once.

A solver in C++ does not always hear Ctrl-C. So the work is done by another process;
what it finished is written already. This one shows its progress, says the answer on
standard output (texts, or JSON and nothing else) and ends with an exit code. Progress,
and what went wrong, go to standard error. It needs none of the solver's libraries.
"""

import contextlib
import json
import multiprocessing
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn, TextIO

import typer

from phsi_opt.command_line.job import Answer, ExitCode, Finished, Job, answer_to
from phsi_opt.command_line.worker import work
from phsi_opt.errors import PhsiOptError
from phsi_opt.presentation.numbers import duration
from phsi_opt.study_file.toml_text import add_effects, tables_of
from phsi_opt.writing import remove_unfinished, written_path

Show = Callable[[str | None], None]


# ---- the end of a command ------------------------------------------------------------


def finish(answer: Answer, as_json: bool, **further: Any) -> NoReturn:
    """Say an answer and end with its exit code."""
    is_done = answer.code in (ExitCode.DONE, ExitCode.MISSING)
    if as_json:
        content = {"exit_code": int(answer.code), **answer.content, **further}
        typer.echo(json.dumps(content, indent=1, allow_nan=False, default=str))
    if not (is_done and as_json):
        stream = sys.stdout if is_done else sys.stderr
        typer.echo(_broken_at_words(answer.text, stream), file=stream)
    raise typer.Exit(int(answer.code))


def _broken_at_words(text: str, stream: TextIO) -> str:
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
def told_errors(as_json: bool = False, study: Path | None = None) -> Iterator[None]:
    """Say what the package refuses, without a trace, and end with the exit code.

    A study file that is missing or no TOML is refused first: no library is loaded yet.
    """
    try:
        if study is not None:
            tables_of(study)
        yield
    except PhsiOptError as error:
        finish(answer_to(error), as_json)


def do(job: Job, as_json: bool) -> NoReturn:
    """Have a job done, say how it ended, and end with the exit code."""
    with told_errors(as_json, job.study):
        for path in job.places:  # before the work, not after it
            written_path(path)
    answer, done, seconds = supervise(job)
    files = list(map(str, done.files))
    notes = [f"written: {file}" for file in files] + _found_effects(job, done.found)
    end = {"written": files, "seconds": round(seconds, 2), "found": done.found}
    is_kept = f"The completed steps are kept:\n{done.text}"
    if answer is None:
        said = ["No step was completed; nothing was written."]
        if done.text:
            said = [is_kept, *notes]
        text = "\n".join([f"stopped after {seconds:.0f} s.", *said])
        content = {"interrupted": True, **done.content}
        finish(Answer(text, content, ExitCode.INTERRUPTED), as_json, **end)
    if not as_json:
        typer.echo("\n".join(notes), err=True, nl=bool(notes))
    if answer.code == ExitCode.FAILED and done.text:
        end = {**done.content, **end}
        if not as_json:
            typer.echo(is_kept)
    finish(answer, as_json, **end)


def _found_effects(job: Job, found: tuple[str, ...]) -> list[str]:
    """What became of the effects that were found, or what can become of them."""
    if not found:
        return []
    if not job.write:
        commands = [f'phsi-opt add "{name}" {job.study}' for name in found]
        return ["To keep what was found (or run with --write):", *commands]
    try:
        backup = add_effects(job.study, found)
    except PhsiOptError as error:
        return [str(error)]
    return [f"written into {job.study}: {', '.join(found)}; previous version: {backup}"]


# ---- the waiting process -------------------------------------------------------------


def supervise(job: Job) -> tuple[Answer | None, Finished, float]:
    """Have a job done by a process of its own; Ctrl-C ends it at once.

    Returns:
        What it answered (None: it was interrupted), the last step that was finished
        (without a text: none was), and how many seconds it took.
    """
    answer: Answer | None = None
    kept = [Finished()]
    began = time.monotonic()
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()  # both ways: each end sees that the other is gone
    process = context.Process(target=work, args=(there, job), daemon=True)
    with _ignored_interrupts():  # inherited: the work never hears of Ctrl-C
        process.start()
    there.close()
    with contextlib.suppress(KeyboardInterrupt), _shown(began) as show:
        answer = _listen(here, process, show, kept)
    with _ignored_interrupts():
        process.kill()
        process.join(timeout=0.5)
        here.close()
        for path in job.places:
            remove_unfinished(path)
    return answer, kept[-1], time.monotonic() - began


@contextlib.contextmanager
def _shown(began: float) -> Iterator[Show]:
    """Shows lines with the time so far, None: the last one again."""
    last = "starting"
    terminal = _terminal_line() if sys.stderr.isatty() else contextlib.nullcontext()
    with terminal as update:

        def show(line: str | None) -> None:
            nonlocal last
            if line is not None:
                last = " ".join(line.split())
            text = f"[{duration(time.monotonic() - began)}] {last}"
            if update is not None:
                update(text)
            elif line is not None:
                print(text, file=sys.stderr, flush=True)

        yield show


@contextlib.contextmanager
def _terminal_line() -> Iterator[Callable[[str], None]]:
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status("") as status:
        yield lambda text: status.update(Text(text, no_wrap=True, overflow="ellipsis"))


def _listen(
    pipe: Connection, process: BaseProcess, show: Show, kept: list[Finished]
) -> Answer:
    """The answer; progress is shown, and finished steps are remembered."""
    while True:
        try:
            # The clock on the screen goes by the wait.
            message = pipe.recv() if pipe.poll(0.2) else None
        except EOFError:
            process.join(timeout=0.5)
            text = (
                "The worker process ended without a result (exit code "
                f"{process.exitcode}); perhaps the memory was too small. Completed "
                "steps are kept."
            )
            return Answer(text, {"error": text}, ExitCode.FAILED)
        if isinstance(message, Answer):
            return message
        if isinstance(message, Finished):
            kept.append(message)
        else:
            show(message)


@contextlib.contextmanager
def _ignored_interrupts() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
