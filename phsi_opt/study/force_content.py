"""Where a study's model fails, for a report: forces in pictures, ranked effects."""

from collections.abc import Mapping

import numpy as np

from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.state_plots import Bins, Dependence
from phsi_opt.force_analysis.state_plots import ForceMap as MeanForce
from phsi_opt.force_analysis.units import spaced
from phsi_opt.force_analysis.words import dependence_title, map_title, sentence
from phsi_opt.presentation.axes import label
from phsi_opt.presentation.durations import date_words, scale_of_time
from phsi_opt.presentation.numbers import number, proper_names, with_error
from phsi_opt.presentation.report_content import (
    Failure,
    Follows,
    Force,
    ForceMap,
    ForceRun,
    Law,
    Number,
    Ranked,
)
from phsi_opt.presentation.thinning import rounded, thinned
from phsi_opt.study.certainty import evidence_words
from phsi_opt.study.effect_law import EffectLaw
from phsi_opt.study.run_content import DIGITS_OF_TIME, FEWEST_PER_CURVE, MOST_PER_CURVE

MOST_FORCE_SAMPLES = 20_000  # of one force, in all trajectories
MOST_DRAWN_DOTS = 1_500  # of a force against what it follows
MOST_LISTED = 12  # candidates that are listed
MOST_CONFUSED = 3  # effects that are named of those that one is confused with
MOST_FORCES = 4  # equations whose missing force is drawn


def failure_of(diagnosis: Diagnosis, heading: str, unit: str, told: str) -> Failure:
    """A diagnosis as a report tells it.

    Args:
        diagnosis: of one step's model.
        heading: which model that is.
        unit: of the errors.
        told: the diagnosis in a paragraph.
    """
    ranking = diagnosis.ranking
    classes = _classes(diagnosis)
    listed = [_ranked(one, unit, classes) for one in ranking[:MOST_LISTED]]
    return Failure(
        heading,
        told,
        str(diagnosis.verdict),
        diagnosis.reason,
        tuple(diagnosis.sentences),
        tuple(_sure_forces(diagnosis)),
        tuple(listed),
        max(len(ranking) - MOST_LISTED, 0),
    )


def _sure_forces(diagnosis: Diagnosis) -> list[Force]:
    forces: list[Force] = []
    for equation in diagnosis.where["equation"]:
        force = diagnosis.analysis.force_in(str(equation))
        if not force.is_uncertain and len(forces) < MOST_FORCES:
            forces.append(_force(force))
    return forces


def _force(force: EquationForce) -> Force:
    record = force.record
    names = record.trajectories
    scale = scale_of_time(float(record.t.max()), record.units.get("t", ""))
    t_label = label("t", scale.unit)
    return Force(
        f"d{force.equation}/dt",
        label("missing force", force.scale.unit),
        t_label,
        sentence(force),
        _force_runs(force, scale.size),
        names.index(str(force.where["trajectory"])),
        _map(force),
        _follows(force),
    )


def _force_runs(force: EquationForce, size: float) -> list[ForceRun]:
    """The force along each trajectory, times in a unit of so many of the user's."""
    record = force.record
    deviation = force.deviation
    share = MOST_FORCE_SAMPLES / len(record.trajectories)
    most = int(np.clip(share, FEWEST_PER_CURVE, MOST_PER_CURVE))
    runs = []
    for number_of_run, name in enumerate(record.trajectories):
        inside = np.flatnonzero(record.run == number_of_run)
        kept = inside[thinned([force.w[inside]], most)]
        t = rounded(record.t[kept] / size, DIGITS_OF_TIME)
        rate = force.scale.size
        w = rounded(force.w[kept] / rate)
        since = date_words(0.0, record.origin_of(name))
        runs.append(ForceRun(name, t, w, rounded(deviation[kept] / rate), since))
    return runs


def _map(force: EquationForce) -> ForceMap | None:
    names = force.map_variables
    if len(names) < 2:
        return None
    found = MeanForce.of(force, names)
    rows = []
    for row in found.mean.T:
        rows.append(rounded(np.ma.filled(row, np.nan) / force.scale.size))
    return ForceMap(
        force.variable_label(names[0]),
        force.variable_label(names[1]),
        rounded((found.edges_a[:-1] + found.edges_a[1:]) / 2),
        rounded((found.edges_b[:-1] + found.edges_b[1:]) / 2),
        rows,
        map_title(force, names),
    )


def _follows(force: EquationForce) -> Follows:
    variable = force.single_variable
    found = Dependence.of(force, variable)
    return _beside(found, dependence_title(force, variable), force.scale.size)


def law_of(law: EffectLaw) -> Law:
    """The law of an effect, to be drawn against what it follows."""
    sentence = (
        f"The law that was added: what d{law.force.equation}/dt lacks where "
        f"{law.effect} is left out of the present model and all other values stay"
    )
    rate = law.force.scale.size
    follows = _beside(law.dependence, proper_names(sentence), rate)
    missing = label("missing force", law.force.scale.unit)
    return Law(proper_names(law.title), missing, follows)


def _beside(found: Dependence, sentence: str, rate: float) -> Follows:
    """A force against what it follows; ``rate``: unit in which it is told."""
    w = found.w / rate
    bins = Bins.of(found.z, w)
    step = max(1, len(found.z) // MOST_DRAWN_DOTS)
    return Follows(
        found.label,
        rounded(found.z[::step]),
        rounded(w[::step]),
        rounded(bins.centre),
        rounded(bins.mean),
        rounded(bins.std),
        sentence,
    )


def _classes(diagnosis: Diagnosis) -> dict[str, list[str]]:
    """The other effects of each one's class, by its name with the equation."""
    classes: dict[str, list[str]] = {}
    for finding in diagnosis.findings:
        names = [str(effect) for effect in finding.effects]
        for name in names:
            classes[name] = [other for other in names if other != name]
    return classes


def _ranked(one: Candidate, unit: str, classes: Mapping[str, list[str]]) -> Ranked:
    share = _known(one.share)
    explains = "not re-fitted"
    if share is not None:
        explains = f"{100 * min(max(share, 0.0), 1.0):.0f} %"
    error = ""
    if np.isfinite(one.held_out_rmse):
        error = f"{number(one.held_out_rmse)} {unit}".rstrip()
    elif np.isfinite(one.train_rmse):
        error = f"{number(one.train_rmse)} {unit}".rstrip() + " on training data"
    alike = list(classes.get(one.name, []))
    for other in one.confusable_with:
        if other not in alike:
            alike.append(other)
    return Ranked(
        name=proper_names(one.name),
        size=with_error(one.coefficient, one.std_error) + spaced(one.unit),
        evidence=evidence_words(one),
        explains=explains,
        share=share,
        error=error,
        confused_with=proper_names(shortened(", ".join(alike))),
        lost=one.lost,
    )


def shortened(listed: str) -> str:
    """The first few of a list with commas, and how many more there are."""
    names = listed.split(", ")
    if len(names) <= MOST_CONFUSED + 1:
        return listed
    return f"{', '.join(names[:MOST_CONFUSED])} and {len(names) - MOST_CONFUSED} more"


def _known(value: object) -> Number:
    found = float(value)  # type: ignore[arg-type]
    return found if np.isfinite(found) else None
