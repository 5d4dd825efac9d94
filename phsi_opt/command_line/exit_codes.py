"""What the exit codes of ``phsi-opt`` mean."""

from enum import IntEnum


class ExitCode(IntEnum):
    """How a command ended, for the shell."""

    DONE = 0  # what was asked for was done
    MISSING = 1  # with --exit-code alone: the model lacks something
    BAD_INPUT = 2  # the arguments, the study file or the data cannot be used
    FAILED = 3  # no solution was found, or the work broke off
    INTERRUPTED = 130  # by Ctrl-C; what was finished is kept


MEANINGS = {
    ExitCode.DONE: "what was asked for was done",
    ExitCode.MISSING: "with --exit-code alone: the model lacks something",
    ExitCode.BAD_INPUT: "the arguments, the study file or the data cannot be used",
    ExitCode.FAILED: "no solution was found, or the work broke off",
    ExitCode.INTERRUPTED: "stopped by Ctrl-C; what was finished is kept",
}
