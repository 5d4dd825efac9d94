"""What a study tells of missing forces: along runs, over states, laws, candidates."""

from collections.abc import Mapping

import numpy as np

from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import window_of
from phsi_opt.force_analysis.state_plots import Bins, Dependence
from phsi_opt.force_analysis.state_plots import ForceMap as MeanForce
from phsi_opt.force_analysis.units import spaced
from phsi_opt.force_analysis.words import dependence_title, map_title, sentence
from phsi_opt.presentation.axes import label
from phsi_opt.presentation.content import (
    TRAINING,
    Channel,
    Follows,
    Force,
    ForceMap,
    ForceRun,
    Glance,
    Ranked,
    Run,
)
from phsi_opt.presentation.durations import TimeScale
from phsi_opt.presentation.numbers import number, proper_names
from phsi_opt.presentation.thinning import thinned
from phsi_opt.presentation.units import scale_of_errors
from phsi_opt.study.certainty import evidence_words
from phsi_opt.study.fitting import EffectLaw

MOST_FORCE_SAMPLES = 20_000  # of one force, in all trajectories
MOST_PER_CURVE = 1_500  # two for each pixel of a wide screen
FEWEST_PER_CURVE = 120
MOST_DRAWN_DOTS = 1_500  # of a force against what it follows
MOST_FORCES = 4  # equations whose missing force is drawn
# Times the training data's error, beside its movement, from which on the data held out
# show better what is wrong: the model follows what it was fitted to.
FOLLOWED_TIMES = 2.0
FAILS_HERE = "The model's parameters follow the training data, and fail here."
SURE = 2.0  # standard deviations beyond which a force counts as sure at one time


# ---- forces --------------------------------------------------------------------------


def sure_forces(diagnosis: Diagnosis, time: TimeScale) -> tuple[Force, ...]:
    """The missing forces that are surely there, the strongest first."""
    found = map(diagnosis.analysis.force_in, diagnosis.where["equation"])
    sure = [force for force in found if not force.is_uncertain]
    return tuple(_force(force, time) for force in sure[:MOST_FORCES])


def _force(force: EquationForce, time: TimeScale) -> Force:
    variable = force.single_variable
    follows = _follows(
        Dependence.of(force, variable), force, "", dependence_title(force, variable)
    )
    return Force(
        f"d{force.equation}/dt",
        follows.y_label,
        sentence(force),
        force_runs(force, TRAINING, time),
        force.record.trajectories.index(str(force.where["trajectory"])),
        _map(force),
        follows,
    )


def all_forces(record: Record, part: str, time: TimeScale) -> tuple[ForceRun, ...]:
    """The missing force of a model's record, by equation and run."""
    found: tuple[ForceRun, ...] = ()
    for force in ForceAnalysis.of(record).forces:
        found += force_runs(force, part, time)
    return found


def force_runs(
    force: EquationForce, part: str, time: TimeScale
) -> tuple[ForceRun, ...]:
    """A force along each trajectory of its part of the data."""
    record = force.record
    deviation = force.deviation
    share = MOST_FORCE_SAMPLES / len(record.trajectories)
    most = int(np.clip(share, FEWEST_PER_CURVE, MOST_PER_CURVE))
    scale = force.scale
    runs = []
    for place, name in enumerate(record.trajectories):
        inside = np.flatnonzero(record.run == place)
        kept = inside[thinned([force.w[inside]], most)]
        t = record.t[kept] / time.size
        w = force.w[kept] / scale.size
        std = deviation[kept] / scale.size
        origin = record.origin_of(name)
        runs.append(ForceRun(name, part, force.equation, scale.unit, t, w, std, origin))
    return tuple(runs)


def _map(force: EquationForce) -> ForceMap | None:
    names = force.map_variables
    if len(names) < 2:
        return None
    found = MeanForce.of(force, names)
    return ForceMap(
        force.variable_label(names[0]),
        force.variable_label(names[1]),
        (found.edges_a[:-1] + found.edges_a[1:]) / 2,
        (found.edges_b[:-1] + found.edges_b[1:]) / 2,
        found.mean.T.filled(np.nan) / force.scale.size,
        map_title(force, names),
    )


def law_of(law: EffectLaw) -> Follows:
    """The law of an effect, to be drawn against what it follows."""
    said = (
        f"The law that was added: what d{law.force.equation}/dt lacks where "
        f"{law.effect} is left out of the present model and all other values stay"
    )
    title = proper_names(law.title)
    return _follows(law.dependence, law.force, title, proper_names(said))


def _follows(
    found: Dependence, force: EquationForce, heading: str, said: str
) -> Follows:
    w = found.w / force.scale.size
    bins = Bins.of(found.z, w)
    step = max(1, len(found.z) // MOST_DRAWN_DOTS)
    y_label = label("missing force", force.scale.unit)
    dots = (found.z[::step], w[::step])
    binned = (bins.centre, bins.mean, bins.std)
    return Follows(heading, found.label, y_label, *dots, *binned, said)


# ---- candidates ----------------------------------------------------------------------


def ranking_of(diagnosis: Diagnosis) -> tuple[Ranked, ...]:
    """The candidates, best first; errors in the unit in which they are told."""
    size, _ = scale_of_errors(diagnosis.base.error_unit)
    classes: dict[str, list[str]] = {}
    for finding in diagnosis.findings:
        names = [str(effect) for effect in finding.effects]
        classes |= {name: [one for one in names if one != name] for name in names}
    return tuple(_ranked(one, size, classes) for one in diagnosis.ranking)


def _ranked(one: Candidate, size: float, classes: Mapping[str, list[str]]) -> Ranked:
    alike = dict.fromkeys([*classes.get(one.name, []), *one.confusable_with])
    share = _known(one.share)
    return Ranked(
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


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


# ---- where it shows best -------------------------------------------------------------


def glance_of(
    diagnosis: Diagnosis, runs: tuple[Run, ...], time: TimeScale, model: int
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
    name = str(force.where["trajectory"])
    training = [run for run in runs if run.part == TRAINING and run.name == name]
    if not training:
        return None
    strongest = worst_run(training, model)
    others = [run for run in runs if run.part != TRAINING]
    if others:
        judged = worst_run(others, model)
        share = worst_channel(strongest, model).share_off(model)
        if worst_channel(judged, model).share_off(model) > FOLLOWED_TIMES * share:
            channel = worst_channel(judged, model)
            said = f"{_called(judged, channel, model)}. {FAILS_HERE}"
            off = np.abs(channel.measured - channel.models[model])
            t = float(channel.t[np.nanargmax(off)])
            place = judged.channels.index(channel)
            return Glance(runs.index(judged), place, said, t=t)
    channel = worst_channel(strongest, model)
    said = (
        f"{_called(strongest, channel, model)}; below, what is missing in "
        f"d{force.equation}/dt, with two standard deviations."
    )
    window = window_of(str(force.where["time_window"]))
    if window is not None:
        window = (window[0] / time.size, window[1] / time.size)
        said += " Shaded: where that is strongest."
    along = force_runs(force, TRAINING, time)[force.record.trajectories.index(name)]
    t = worst_moment(along, channel, model, window)
    place = strongest.channels.index(channel)
    return Glance(runs.index(strongest), place, said, along, window, t)


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
    is_sure = inside & (sureness > SURE)
    if not is_sure.any():
        return float(force.t[np.argmax(np.where(inside, sureness, -1.0))])
    off = np.abs(np.nan_to_num(channel.measured - channel.models[model]))
    found = np.where(is_sure, np.interp(force.t, channel.t, off), -1.0)
    return float(force.t[np.argmax(found)])


def _called(run: Run, channel: Channel, model: int) -> str:
    """The channel of a run, with how far off a model is in it."""
    error = channel.errors[model]
    off = "" if error is None else f", off by {number(error, 3)}{spaced(channel.unit)}"
    part = "training data" if run.part == TRAINING else "data held out"
    simulated = "simulated from a start that the whole run gives"
    return f"{channel.name} of {run.name} ({part}), measured and {simulated}{off}"
