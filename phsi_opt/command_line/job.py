"""What a command asks of the working process, what that answers, and the exit codes.

Records of texts and numbers alone: the process that waits needs none of the libraries
of the one that works.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Any

from phsi_opt.errors import PhsiOptError, SolveError, StudyFileError

FIT = "fit"
COMPARE = "compare"
DIAGNOSE = "diagnose"
EXPORT = "export"
GO_THROUGH = "study"
EXPERIMENT = "experiment"


class ExitCode(IntEnum):
    """How a command ended, for the shell."""

    DONE = 0
    MISSING = 1
    BAD_INPUT = 2
    FAILED = 3
    INTERRUPTED = 130


MEANINGS = {
    ExitCode.DONE: "the command succeeded",
    ExitCode.MISSING: (
        "only with --exit-code: an effect or a force is missing in the model"
    ),
    ExitCode.BAD_INPUT: "the arguments, the study file or the data are not valid",
    ExitCode.FAILED: "the solver found no solution, or the command failed",
    ExitCode.INTERRUPTED: "stopped by Ctrl-C; completed steps are kept",
}


class Reach(StrEnum):
    """How clear the evidence of an effect has to be, as in `Study.auto`."""

    DECISIVE = "decisive"
    STRONG = "strong"


@dataclass(frozen=True)
class Job:
    """One piece of work."""

    kind: str  # one of those above
    study: Path  # the study file
    fit: Path | None = None  # a saved fit to take in place of a new one; None: fit anew
    is_auto: bool = False  # whether effects are looked for and added
    # How many are added at most; None: what the study file says.
    max_steps: int | None = None
    save: Path | None = None  # where the fit is saved
    report: Path | None = None  # where the report is written; or None
    exit_code: bool = False  # whether something missing shows in the exit code
    # Whether effects that were found are written into the study file.
    write: bool = False
    reach: Reach = Reach.DECISIVE  # how clear an effect has to be that is added
    plan: "ExperimentPlan | None" = None  # of `EXPERIMENT`
    export: Path | None = None  # where the model is written; or None
    figures: Path | None = None  # the folder in which figures are written
    kinds: tuple[str, ...] = ()  # of the files of a figure

    @property
    def places(self) -> list[Path]:
        planned = self.plan.table if self.plan else None
        return [*filter(None, (self.save, self.report, self.export, planned))]


@dataclass(frozen=True)
class ExperimentPlan:
    """Limits and starts as they were typed, in the units of the data."""

    table: Path  # where times and inputs are written
    limits: tuple[str, ...] = ()  # such as "u=-5:5"
    starts: tuple[str, ...] = ()  # such as "q=0", or "q=0:1" to choose from
    sharpen: str | None = None


@dataclass(frozen=True)
class Finished:
    """A step was finished: what is kept if the work stops now."""

    text: str = ""  # the steps as a table
    content: Mapping[str, Any] = field(default_factory=dict)  # the same for ``--json``
    files: tuple[Path, ...] = ()  # that were written
    # Names of the effects added beyond those of the study file.
    found: tuple[str, ...] = ()


@dataclass(frozen=True)
class Answer:
    """The end of the work: for a person, for ``--json``, and the exit code."""

    text: str
    content: Mapping[str, Any]
    code: int = ExitCode.DONE


Message = str | Finished | Answer  # a text is a line about what is being done


def answer_to(error: PhsiOptError) -> Answer:
    """What is said where the input cannot be used, or no solution was found."""
    content: dict[str, object] = {"error": str(error)}
    if isinstance(error, StudyFileError):
        content["complaints"] = list(map(vars, error.complaints))
    is_failure = isinstance(error, SolveError)
    code = ExitCode.FAILED if is_failure else ExitCode.BAD_INPUT
    return Answer(str(error), content, code)
