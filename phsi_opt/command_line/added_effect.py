"""``phsi-opt add``: an effect of the catalogue, written into the study file."""

from pathlib import Path

from phsi_opt.command_line.job import Answer
from phsi_opt.study_file.adding import add_effects
from phsi_opt.study_file.effects import ON
from phsi_opt.study_file.study_file import StudyFile


def add_effect(path: Path, name: str, equation: str | None) -> Answer:
    """Write an effect into a study file, if the model can have it.

    Raises:
        StudyFileError: the file cannot be used as it is.
        DataError: the file is written in a way that cannot be changed safely.
        ModelError: there is no such effect, or the model has it.
    """
    file = StudyFile.read(path)
    asked = name
    if equation is not None and not name.endswith(f"{ON}{equation}"):
        asked = f"{name}{ON}{equation}"
    model = file.model()
    if equation is not None:
        model.index(equation, "--equation")
    effect = file.meant(model, asked)
    larger = model.add(effect)
    backup = add_effects(path, [str(effect)])
    free = [one for one in larger.free if one not in model.entries]
    text = (
        f"{effect} is in {path} now, with the unknown {', '.join(free)}.\n"
        f"The file as it was: {backup}\nNext: phsi-opt study {path}"
    )
    content = {
        "added": str(effect),
        "unknowns": free,
        "study_file": str(path),
        "backup": str(backup),
    }
    return Answer(text, content)
