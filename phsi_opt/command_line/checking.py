"""``phsi-opt check``: what a study file says, what is wrong and what is empty."""

from pathlib import Path

from phsi_opt.command_line.job import Answer
from phsi_opt.command_line.worker import answer_to
from phsi_opt.data.wording import number_of
from phsi_opt.errors import Complaint, ModelError, StudyFileError
from phsi_opt.model.catalogue import catalogue
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.study_file.unfilled import unfilled
from phsi_opt.transcription.alignment import AlignedData

EMPTY = "Also empty; fill in what applies:"


def checked(path: Path) -> Answer:
    """A summary of a study file, or everything that is wrong with it.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    empty = unfilled(path)
    try:
        file = StudyFile.read(path)
        file.check_formulas()
    except StudyFileError as error:
        return _with_empty(answer_to(error), empty)
    except ModelError as error:
        wrong = StudyFileError(path, [Complaint("model", "", str(error))])
        return _with_empty(answer_to(wrong), empty)
    has_dates = any(run.origin is not None for run in file.measurements())
    return _with_empty(_summary(path, file), unfilled(path, has_dates))


def _with_empty(answer: Answer, empty: tuple[str, ...]) -> Answer:
    """An answer that tells what stands empty too."""
    content = {**answer.content, "empty": list(empty)}
    lines = [answer.text]
    if empty:
        lines += ["", EMPTY, *[f"  {one}" for one in empty]]
    return Answer("\n".join(lines), content, answer.code)


def _summary(path: Path, file: StudyFile) -> Answer:
    """What a study file that can be used holds."""
    train, held_out = file.split()
    model = file.model()
    notes = AlignedData.of(model, train).notes
    n_effects = len(catalogue(model, file.data.units))
    free = ", ".join(model.free) or "none, all values are known"
    judged = "nothing is held out: the training data judge"
    if held_out is not None:
        n_runs = held_out.n_trajectories
        judged = f"held out: {number_of(n_runs, 'run')}, {held_out.n_samples} samples"
    text = [
        f"{path} can be used.",
        str(file.measurements()),
        f"to fit: {number_of(train.n_trajectories, 'run')}, {train.n_samples} samples; "
        f"{judged}",
        f"model: {type(model).__name__} with states {', '.join(model.states)}",
        f"unknown parameters: {free}",
        f"effects added: {', '.join(file.steps.added) or 'none'}; "
        f"{n_effects} more in the catalogue",
        *notes,
    ]
    content = {
        "states": list(model.states),
        "inputs": list(model.inputs),
        "measured": list(train.measured),
        "free": list(model.free),
        "added": list(file.steps.added),
        "n_runs": file.measurements().n_trajectories,
        "n_samples": file.measurements().n_samples,
        "n_held_out": 0 if held_out is None else held_out.n_samples,
        "warnings": list(notes),
    }
    return Answer("\n".join(text), content)
