"""The process that works; it loads nothing of the one that waits for it."""

import os
import sys
import traceback
from multiprocessing.connection import Connection

from phsi_opt.command_line.job import Answer, ExitCode, Job, answer_to
from phsi_opt.errors import PhsiOptError
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
    except Exception as error:  # a mistake of the package: its trace helps
        trace = "".join(traceback.format_exception(error))
        told = f"{trace}\nThis is a bug in phsi_opt; please report it with this text."
        content = {"error": repr(error), "trace": trace}
        pipe.send(Answer(told, content, ExitCode.FAILED))
