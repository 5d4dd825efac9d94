"""The section [loss]: the settings of `MaximumLikelihood`."""

from dataclasses import fields
from typing import Any

from phsi_opt.errors import ModelError
from phsi_opt.study_file.part import Part
from phsi_opt.transcription.integrators import INTEGRATORS
from phsi_opt.transcription.losses import MaximumLikelihood

# The noise stands beside the column of its state.
SETTINGS = tuple(f.name for f in fields(MaximumLikelihood) if f.name != "noise")
COUNTS = ("steps", "starts")
FLAGS = ("model_error",)


def read_loss(file: Part) -> MaximumLikelihood:
    """The loss; what is wrong is noted, and the default taken."""
    part = file.part("loss")
    settings: dict[str, Any] = {}
    for name in SETTINGS:
        if name in part.content:
            settings[name] = _setting(part, name)
    for name in settings:
        _check_alone(part, name, settings[name])
    if file.complaints.about("loss"):
        return MaximumLikelihood()
    try:
        return MaximumLikelihood(**settings)
    except ModelError as error:  # settings that do not go together
        file.complaints.add("loss", str(error), part.content)
        return MaximumLikelihood()


def _check_alone(part: Part, name: str, value: Any) -> None:
    """Note a setting that is out of its range, whatever the others are."""
    settings: dict[str, Any] = {name: value}
    try:
        MaximumLikelihood(**settings)
    except ModelError as error:
        part.complain(name, str(error))


def _setting(part: Part, name: str) -> Any:
    if name == "integrator":
        return part.one_of(name, list(INTEGRATORS), "srk4")
    if name in COUNTS:
        return part.whole(name, 1)
    if name in FLAGS:
        return part.flag(name)
    return part.number(name)
