"""What a study tells of missing forces: along runs, over states, laws, candidates."""

import numpy as np

from phsi_opt.criteria import SURE_DEVIATIONS
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.pictures import force_of, force_runs
from phsi_opt.presentation.content import (
    HELD_OUT,
    TRAINING,
    Channel,
    Force,
    ForceRun,
    Glance,
    Ranked,
    Run,
)
from phsi_opt.presentation.durations import Scale
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.units import scale_of_errors, spaced
from phsi_opt.study.answers import evidence_words
from phsi_opt.study.record import StudyRecord

# ---- forces --------------------------------------------------------------------------


def sure_forces(diagnosis: Diagnosis, time: Scale) -> tuple[Force, ...]:
    """The missing forces that are surely there, the four strongest."""
    found = map(diagnosis.analysis.force_in, diagnosis.where["equation"])
    sure = [force for force in found if not force.is_uncertain]
    return tuple(force_of(force, time) for force in sure[:4])


def all_forces(study: StudyRecord, time: Scale) -> tuple[ForceRun, ...]:
    """The missing force of the present model, by part, equation and run."""
    parts = {TRAINING: study.last.train, HELD_OUT: study.last.held_out}
    found: tuple[ForceRun, ...] = ()
    for part, compared in parts.items():
        if compared is not None:
            for force in ForceAnalysis.of(compared.record).forces:
                found += force_runs(force, part, time)
    return found


# ---- candidates ----------------------------------------------------------------------


def ranking_of(diagnosis: Diagnosis) -> tuple[Ranked, ...]:
    """The candidates, best first; errors in the unit in which they are told."""
    size, _ = scale_of_errors(diagnosis.base.error_unit)
    classes: dict[str, list[str]] = {}
    for finding in diagnosis.findings:
        names = list(map(str, finding.effects))
        for name in names:
            classes[name] = [one for one in names if one != name]
    ranked = []
    for one in diagnosis.ranking:
        alike = dict.fromkeys([*classes.get(one.name, []), *one.confusable_with])
        share = _known(one.share)
        found = Ranked(
            one.name,
            float(one.coefficient),
            float(one.std_error),
            one.unit,
            evidence_words(one),
            None if share is None else min(max(share, 0.0), 1.0),
            _known(size * one.train_rmse),
            _known(size * one.held_out_rmse),
            tuple(alike),
            one.lost,
        )
        ranked.append(found)
    return tuple(ranked)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


# ---- where it shows best -------------------------------------------------------------


def glance_of(
    diagnosis: Diagnosis, runs: tuple[Run, ...], time: Scale, model: int
) -> Glance | None:
    """What is missing, where it is seen best; None where no force is sure.

    That is the run in which the missing force is strongest; or one of the data held
    out, where these are far worse.

    Args:
        diagnosis: that the verdict tells of.
        runs: that are drawn.
        time: unit of their times.
        model: that was diagnosed, among those that are drawn.
    """
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return None
    name = force.window.trajectory
    training = [run for run in runs if run.part == TRAINING and run.name == name]
    if not training:
        return None
    run = worst_run(training, model)
    judged = worst_run([one for one in runs if one.part != TRAINING] or [run], model)
    shares = [worst_channel(one, model).share_off(model) for one in (run, judged)]
    along = window = None
    if shares[1] > 2 * shares[0]:  # the model follows what it was fitted to
        run = judged
        channel = worst_channel(run, model)
        off = np.abs(channel.measured - channel.models[model])
        t = float(channel.t[np.nanargmax(off)])
    else:
        channel = worst_channel(run, model)
        if not force.window.is_whole:
            window = (force.window.begin / time.size, force.window.end / time.size)
        along = force_runs(force, TRAINING, time)[force.strongest_run]
        t = worst_moment(along, channel, model, window)
    said = say(
        __package__,
        "glance",
        run=run,
        channel=channel,
        error=channel.errors[model],
        unit=spaced(channel.unit),
        force=along,
        window=window,
    )
    places = (runs.index(run), run.channels.index(channel))
    return Glance(*places, said.lead, along, window, t)


def worst_run(runs: list[Run], model: int) -> Run:
    """The run in whose worst channel a model is off most, beside the movement."""
    return max(runs, key=lambda run: worst_channel(run, model).share_off(model))


def worst_channel(run: Run, model: int) -> Channel:
    """The channel of a run in which a model is off most, beside its movement."""
    return max(run.channels, key=lambda one: one.share_off(model))


def worst_moment(
    force: ForceRun,
    channel: Channel,
    model: int,
    window: tuple[float, float] | None,
) -> float:
    """When a model is off most while the missing force is sure, within the window.

    Where the force is sure at no time of it, when it is surest.
    """
    begin, end = window or (-np.inf, np.inf)
    sureness = np.abs(force.force) / force.std
    inside = (force.t >= begin) & (force.t <= end)
    if not inside.any():
        inside = np.ones(len(force.t), dtype=bool)
    is_sure = inside & (sureness > SURE_DEVIATIONS)
    if not is_sure.any():
        return float(force.t[np.argmax(np.where(inside, sureness, -1.0))])
    off = np.abs(np.nan_to_num(channel.measured - channel.models[model]))
    found = np.where(is_sure, np.interp(force.t, channel.t, off), -1.0)
    return float(force.t[np.argmax(found)])
