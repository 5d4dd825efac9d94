"""The picture beside the verdict: the run and channel where what is missing shows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import window_of
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.axes import label
from phsi_opt.presentation.durations import scale_of_time
from phsi_opt.presentation.numbers import number
from phsi_opt.presentation.report_content import (
    ChannelRun,
    Failure,
    Force,
    Glance,
    Runs,
)
from phsi_opt.study.run_content import TRAINING

BASE_MODEL = 0  # its number among the models that are drawn
# Times the training data's error, beside its movement, from which on the data held out
# show better what is wrong: the model follows what it was fitted to.
FOLLOWED_TIMES = 2.0
FAILS_HERE = "The model's parameters follow the training data, and fail here."


@dataclass(frozen=True)
class _Shown:
    """A channel of a run, and how far the base model is off, beside its movement."""

    run: int
    channel: int
    share: float


def glance_of(diagnosis: Diagnosis, failure: Failure, runs: Runs) -> Glance | None:
    """What is missing, where it is seen best; None where no force is sure.

    That is the run in which the missing force is strongest; or one of the data held
    out, where these are far worse.

    Args:
        diagnosis: that the verdict tells of; ``failure``: what is told of it.
        runs: that are drawn.
    """
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return None
    name = str(force.where["trajectory"])
    told = [one for one in failure.forces if one.equation == f"d{force.equation}/dt"]
    strongest = _worst(runs, TRAINING, name)
    if not told or strongest is None:
        return None
    judged = _worst(runs, None, None)
    if judged is not None and judged.share > FOLLOWED_TIMES * strongest.share:
        sentence = f"{_called(runs, judged)}. {FAILS_HERE}"
        return Glance(judged.run, judged.channel, sentence)
    return _with_force(force, told[0], runs, strongest)


def _with_force(
    force: EquationForce, told: Force, runs: Runs, strongest: _Shown
) -> Glance:
    """The run in which the force is strongest, with the force."""
    record = force.record
    sentence = (
        f"{_called(runs, strongest)}; below, what is missing in {told.equation}, with "
        "two standard deviations."
    )
    window = window_of(str(force.where["time_window"]))
    if window is not None:
        scale = scale_of_time(float(record.t.max()), record.units.get("t", ""))
        window = (window[0] / scale.size, window[1] / scale.size)
        sentence += " Shaded: where that is strongest."
    (along,) = (one for one in told.runs if one.name == runs.runs[strongest.run].name)
    missing = label(f"missing in {told.equation}", force.scale.unit)
    place = (strongest.run, strongest.channel)
    return Glance(*place, sentence, along, window, missing)


def _worst(runs: Runs, part: str | None, name: str | None) -> _Shown | None:
    """The worst channel of the runs of a part and name; None: all but training."""
    found = list(_channels(runs, part, name))
    return max(found, key=lambda one: one.share) if found else None


def _channels(runs: Runs, part: str | None, name: str | None) -> Iterator[_Shown]:
    for place, run in enumerate(runs.runs):
        is_meant = run.part == part if part else run.part != TRAINING
        if is_meant and name in (None, run.name):
            for k, channel in enumerate(run.channels):
                yield _Shown(place, k, _share(channel))


def _share(channel: ChannelRun) -> float:
    """The base model's error in a channel, beside what was measured of it."""
    known = np.array([one for one in channel.measured if one is not None])
    moves = float(np.std(known)) if len(known) else 0.0
    error = channel.errors[BASE_MODEL] or 0.0
    return error / moves if moves > 0 else 0.0


def _called(runs: Runs, shown: _Shown) -> str:
    """The channel of a run, with how far off the base model is in it."""
    run = runs.runs[shown.run]
    info = runs.channels[shown.channel]
    error = run.channels[shown.channel].errors[BASE_MODEL]
    off = "" if error is None else f", off by {number(error, 3)}{spaced(info.unit)}"
    part = "training data" if run.part == TRAINING else "data held out"
    simulated = "simulated from a start that the whole run gives"
    return f"{info.name} of {run.name} ({part}), measured and {simulated}{off}"
