"""The picture beside the verdict: the run and channel where what is missing shows."""

import numpy as np

from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import window_of
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.durations import scale_of_time
from phsi_opt.presentation.numbers import number
from phsi_opt.presentation.report_content import Failure, Glance, Run, Runs
from phsi_opt.study.run_content import TRAINING

BASE_MODEL = 0  # its number among the models that are drawn


def glance_of(
    diagnosis: Diagnosis, number: int, failure: Failure, runs: Runs
) -> Glance | None:
    """What is missing, where it is seen best; None where no force is sure.

    Args:
        diagnosis: that the verdict tells of.
        number: of it among those that are told; ``failure``: what is told of it.
        runs: that are drawn.
    """
    force = EquationForce.of(diagnosis.analysis, None)
    name = str(force.where["trajectory"])
    called = [one.equation for one in failure.forces]
    drawn = [(run.name, run.part) for run in runs.runs]
    rate = f"d{force.equation}/dt"
    if force.is_uncertain or rate not in called or (name, TRAINING) not in drawn:
        return None
    row = called.index(rate)
    place = drawn.index((name, TRAINING))
    channel = _worst_channel(runs.runs[place])
    window = window_of(str(force.where["time_window"]))
    if window is not None:
        longest = float(force.record.t.max())
        scale = scale_of_time(longest, force.record.units.get("t", ""))
        window = (window[0] / scale.size, window[1] / scale.size)
    sentence = (
        f"{_called(runs, place, channel)}; below, what is missing in {rate}, with two "
        "standard deviations."
    )
    if window is not None:
        sentence += " Shaded: where that is strongest."
    shown = [one.name for one in failure.forces[row].runs].index(name)
    return Glance(place, channel, number, row, shown, window, sentence)


def _called(runs: Runs, place: int, channel: int) -> str:
    """The channel of a run, with how far off the base model is in it."""
    run = runs.runs[place]
    info = runs.channels[channel]
    error = run.channels[channel].errors[BASE_MODEL]
    off = "" if error is None else f" (off by {number(error, 3)}{spaced(info.unit)})"
    return f"{info.name} of {run.name}, training data, measured and simulated{off}"


def _worst_channel(run: Run) -> int:
    """The channel whose base model is farthest off, beside its own movement."""
    shares = []
    for channel in run.channels:
        known = np.array([one for one in channel.measured if one is not None])
        moves = float(np.std(known)) if len(known) else 0.0
        error = channel.errors[BASE_MODEL] or 0.0
        shares.append(error / moves if moves > 0 else 0.0)
    return int(np.argmax(shares))
