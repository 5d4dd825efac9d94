"""Measurements beside the free runs of a study's models, thinned for a report."""

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.presentation.durations import date_words, scale_of_time
from phsi_opt.presentation.numbers import proper_names
from phsi_opt.presentation.report_content import Channel, ChannelRun, Run, Runs
from phsi_opt.presentation.thinning import rounded, thinned
from phsi_opt.study.record import StudyRecord
from phsi_opt.study.step import Step

TRAINING = "training"  # the part of the data that is fitted
# Together in all trajectories and channels: two megabytes of text.
MOST_DRAWN_SAMPLES = 60_000
MOST_PER_CURVE = 1_500  # two for each pixel of a wide screen
FEWEST_PER_CURVE = 120
MOST_DRAWN_RUNS = 200  # trajectories that are drawn
DIGITS_OF_TIME = 6  # over the range of a record: a zoomed curve has no steps


def runs_of(study: StudyRecord) -> Runs:
    """The trajectories of both parts, with base model, first step and present model."""
    steps = _shown_steps(study)
    parts = [(TRAINING, [step.train for step in steps])]
    if study.held_out is not None:
        held_out = [step.held_out for step in steps if step.held_out is not None]
        parts.insert(0, ("held out", held_out))
    n_runs = sum(len(part[0].data) for _, part in parts)
    channels = _channels(study)
    n_curves = max(min(n_runs, MOST_DRAWN_RUNS) * len(channels), 1)
    most = int(np.clip(MOST_DRAWN_SAMPLES / n_curves, FEWEST_PER_CURVE, MOST_PER_CURVE))
    longest = max(float(run.t[-1]) for run in study.train.trajectories)
    scale = scale_of_time(longest, study.train.units.get("t", ""))
    runs: list[Run] = []
    for name, part in parts:
        for number in range(len(part[0].data)):
            if len(runs) < MOST_DRAWN_RUNS:
                runs.append(_run(name, part, number, most, scale.size))
    shown = _worst(runs, parts[0][1][0].weights)
    left_out = ""
    if n_runs > MOST_DRAWN_RUNS:
        left_out = f"The first {MOST_DRAWN_RUNS} of {n_runs} runs are drawn."
    labels = tuple(_label(step, number) for number, step in _numbered(study))
    sentence = _sentence(study, len(labels))
    return Runs(scale.unit, channels, labels, runs, shown, sentence, left_out)


def _numbered(study: StudyRecord) -> list[tuple[int, Step]]:
    """The steps that are shown, each with its number: base, first, last."""
    numbers = sorted({0, min(1, len(study.steps) - 1), len(study.steps) - 1})
    return [(number, study.steps[number]) for number in numbers]


def _shown_steps(study: StudyRecord) -> list[Step]:
    return [step for _, step in _numbered(study)]


def _label(step: Step, number: int) -> str:
    if number == 0:
        return step.label
    is_addition = not step.label.startswith("without ")
    named = proper_names(step.label)
    return f"step {number}: {'with ' if is_addition else ''}{named}"


def _channels(study: StudyRecord) -> tuple[Channel, ...]:
    judged = study.last.judged
    channels = []
    for name, noise in judged.noise.items():
        channels.append(Channel(name, study.train.units.get(name, ""), noise))
    return tuple(channels)


def _run(
    part: str, comparisons: list[Comparison], number: int, most: int, size: float
) -> Run:
    """One trajectory with the free runs of all models; ``size``: that of a time."""
    first = comparisons[0]
    run = first.data.trajectories[number]
    channels = []
    for k, name in enumerate(first.model.states):
        if name in comparisons[-1].noise:
            # A state with a memory comes behind those of the base model.
            shown = [one.shown[number][:, k] for one in comparisons]
            channels.append(_channel_run(run.t / size, run.x[:, k], shown, most))
    return Run(run.name, part, channels, date_words(0.0, run.origin))


def _channel_run(
    t: np.ndarray, measured: np.ndarray, shown: list[np.ndarray], most: int
) -> ChannelRun:
    residuals = [measured - one for one in shown]
    errors: list[float | None] = []
    for residual in residuals:
        known = residual[np.isfinite(residual)]
        errors.append(float(np.sqrt(np.mean(known**2))) if len(known) else None)
    kept = thinned([measured, *shown], most)
    return ChannelRun(
        rounded(t[kept], DIGITS_OF_TIME),
        rounded(measured[kept]),
        [rounded(one[kept]) for one in shown],
        [rounded(residual[kept]) for residual in residuals],
        errors,
    )


def _worst(runs: list[Run], weights: np.ndarray) -> int:
    """The trajectory of the first part where the base model is farthest off."""
    scales = weights[weights > 0]
    sizes = []
    for run in runs:
        size = 0.0
        if run.part == runs[0].part:
            for scale, channel in zip(scales, run.channels, strict=False):
                size += (scale * (channel.errors[0] or 0.0)) ** 2
        sizes.append(size)
    return int(np.argmax(sizes))


def _sentence(study: StudyRecord, n_models: int) -> str:
    """What the reader should look for."""
    text = (
        "Free runs: each begins at a starting state estimated from the whole record "
        "of its run and never looks at the measurements again. Residuals "
        "(measured less model) that stay within the noise band are what noise leaves."
    )
    if n_models > 1:
        text += " Base model and present model are shown one over the other."
    if study.held_out is not None:
        text += " Data held out were used for starting states alone, not to fit."
    return text
