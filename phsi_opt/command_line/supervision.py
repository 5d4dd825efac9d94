"""The waiting process: it starts the work, shows its progress, and ends it on Ctrl-C.

A solver in C++ does not always hear Ctrl-C. So the work is done by a process of its
own, which is ended at once; what it finished is written already.
"""

import contextlib
import glob
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from phsi_opt.command_line.job import DIAGNOSE, Answer, ExitCode, Finished, Job
from phsi_opt.errors import PhsiOptError, SolveError, StudyFileError
from phsi_opt.presentation.forecast import Forecast
from phsi_opt.sweeps.local_workers import begin_worker

Show = Callable[[str | None], None]


@dataclass
class Supervised:
    """How the work ended.

    Attributes:
        answer: what it answered; None: it was interrupted.
        kept: the last step that was finished; None: none was.
        seconds: how long it took.
    """

    answer: Answer | None = None
    kept: Finished | None = None
    seconds: float = 0.0


def supervise(job: Job) -> Supervised:
    """Have a job done by a process of its own; Ctrl-C ends it at once."""
    ended = Supervised()
    # One effect is added as a rule, and a last diagnosis finds nothing.
    forecast = Forecast(2 if job.is_auto else int(job.kind == DIAGNOSE))
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()  # both ways: each end sees that the other is gone
    process = context.Process(target=work, args=(there, job), daemon=True)
    with _ignored_interrupts():  # inherited: the work never hears of Ctrl-C
        process.start()
    there.close()
    with contextlib.suppress(KeyboardInterrupt), _shown(forecast) as show:
        ended.answer = _listen(here, process, show, ended)
    with _ignored_interrupts():
        process.kill()
        process.join(timeout=0.5)
        here.close()
        _remove_parts(job)
    ended.seconds = forecast.elapsed
    return ended


@contextlib.contextmanager
def _shown(forecast: Forecast) -> Iterator[Show]:
    """Shows lines with the time that is left, None: the last one again.

    On standard error: a line that changes in a terminal, plain lines elsewhere.
    """
    last = "starting"
    terminal = _terminal_line() if sys.stderr.isatty() else contextlib.nullcontext()
    with terminal as update:

        def show(line: str | None) -> None:
            nonlocal last
            if line is not None:
                forecast.said(line)
                last = " ".join(line.split())
            text = f"[{forecast.words}] {last}"
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
    pipe: Connection, process: BaseProcess, show: Show, ended: Supervised
) -> Answer:
    """The answer; progress is shown, and finished steps are remembered."""
    while True:
        try:
            # The clock on the screen goes by the wait.
            message = pipe.recv() if pipe.poll(0.2) else None
        except EOFError:
            return _died(process)
        if isinstance(message, Answer):
            return message
        if isinstance(message, Finished):
            ended.kept = message
        else:
            show(message)


def _died(process: BaseProcess) -> Answer:
    process.join(timeout=0.5)
    text = (
        f"The working process ended without an answer (exit code {process.exitcode}); "
        "the memory may have been too small. What was finished before is kept."
    )
    return Answer(text, {"error": text}, ExitCode.FAILED)


def _remove_parts(job: Job) -> None:
    """Remove what `write_whole` had not finished when the process was ended."""
    for path in job.places:
        for part in path.parent.glob(f".{glob.escape(path.name[:40])}.*.part"):
            part.unlink(missing_ok=True)


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


# ---- the working process -------------------------------------------------------------


def work(pipe: Connection, job: Job) -> None:
    """Do a job and send what it tells, the answer last."""
    begin_worker(pipe)
    # Standard output belongs to the answer; what libraries print goes to the errors.
    sys.stdout = sys.stderr
    os.dup2(2, 1)
    try:
        from phsi_opt.command_line.jobs import run  # the solver's libraries

        pipe.send(run(job, pipe.send))
    except PhsiOptError as error:
        pipe.send(answer_to(error))
    except BrokenPipeError:
        pass  # nobody is waiting any more
    except Exception as error:  # a mistake of the package: its trace helps
        trace = "".join(traceback.format_exception(error))
        told = f"{trace}\nThis is a mistake of phsi_opt; please report it with this."
        content = {"error": repr(error), "trace": trace}
        pipe.send(Answer(told, content, ExitCode.FAILED))


def answer_to(error: PhsiOptError) -> Answer:
    """What is told where the input cannot be used, or no solution was found."""
    content: dict[str, object] = {"error": str(error)}
    if isinstance(error, StudyFileError):
        content["complaints"] = [vars(one) for one in error.complaints]
    is_failure = isinstance(error, SolveError)
    code = ExitCode.FAILED if is_failure else ExitCode.BAD_INPUT
    return Answer(str(error), content, code)
