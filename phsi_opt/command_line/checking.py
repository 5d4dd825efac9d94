"""``phsi-opt check``: what a study file that can be used says."""

from pathlib import Path

from phsi_opt.command_line.job import Answer
from phsi_opt.data.wording import number_of
from phsi_opt.initialization.finite_rates import check_rates
from phsi_opt.model.catalogue import catalogue
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.transcription.alignment import AlignedData


def checked(path: Path) -> Answer:
    """A summary of a study file.

    Raises:
        StudyFileError: something in it cannot be used; with all that is wrong.
        ModelError: a formula has no value at the measurements.
    """
    file = StudyFile.read(path)
    train, held_out = file.split()
    model = file.model()
    check_rates(model, AlignedData.of(model, train).grid)
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
    ]
    without_unit = [name for name in train.measured if not train.units.get(name)]
    if without_unit:
        named = ", ".join(without_unit)
        text.append(f"no unit is given for {named}: sizes are told without units")
    content = {
        "states": list(model.states),
        "inputs": list(model.inputs),
        "measured": list(train.measured),
        "free": list(model.free),
        "added": list(file.steps.added),
        "n_runs": file.measurements().n_trajectories,
        "n_samples": file.measurements().n_samples,
        "n_held_out": 0 if held_out is None else held_out.n_samples,
    }
    return Answer("\n".join(text), content)
