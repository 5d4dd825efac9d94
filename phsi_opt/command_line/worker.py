"""The working process: it works, tells by a pipe, and answers.

It is spawned, ignores Ctrl-C (which the waiting process hears), ends with that process
and may be ended at any moment: files are written whole or not at all.
"""

import os
import sys
import traceback
from multiprocessing.connection import Connection

from phsi_opt.command_line.job import Answer, ExitCode, Job
from phsi_opt.errors import PhsiOptError, SolveError, StudyFileError
from phsi_opt.sweeps.local_workers import begin_worker


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
    except Exception as error:
        pipe.send(_unexpected(error))


def answer_to(error: PhsiOptError) -> Answer:
    """What is told where the input cannot be used, or no solution was found."""
    content: dict[str, object] = {"error": str(error)}
    if isinstance(error, StudyFileError):
        content["complaints"] = [vars(one) for one in error.complaints]
    is_failure = isinstance(error, SolveError)
    code = ExitCode.FAILED if is_failure else ExitCode.BAD_INPUT
    return Answer(str(error), content, code)


def _unexpected(error: Exception) -> Answer:
    """A mistake of the package: its trace helps who repairs it."""
    trace = "".join(traceback.format_exception(error))
    text = f"{trace}\nThis is a mistake of phsi_opt; please report it with these lines."
    return Answer(text, {"error": repr(error), "trace": trace}, ExitCode.FAILED)
