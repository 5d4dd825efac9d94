"""Where a study's model fails, for a report: forces in pictures, ranked effects."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.force_uncertainty import deviation_of
from phsi_opt.force_analysis.localization import N_WINDOWS, THROUGHOUT
from phsi_opt.force_analysis.plot_parts import Bins
from phsi_opt.force_analysis.state_plots import (
    Dependence,
    dependence_title,
    map_title,
    map_variables,
)
from phsi_opt.force_analysis.state_plots import ForceMap as MeanForce
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.axes import label
from phsi_opt.presentation.durations import (
    date_words,
    dates_words,
    scale_of_time,
    time_words,
    times_words,
)
from phsi_opt.presentation.numbers import number, with_error
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
from phsi_opt.statistics import TINY
from phsi_opt.study.effect_law import EffectLaw
from phsi_opt.study.run_content import DIGITS_OF_TIME, FEWEST_PER_CURVE, MOST_PER_CURVE

MOST_FORCE_SAMPLES = 20_000  # of one force, in all trajectories
MOST_DRAWN_DOTS = 1_500  # of a force against what it follows
MOST_LISTED = 12  # candidates that are listed
MOST_CONFUSED = 3  # effects that are named of those that one is confused with
# Share of the strongest trajectory's force from which on another has it as well.
STRONG_RUN = 0.5
# Times that a force is stronger behind its beginning than before; where it follows a
# motion that decays or grows, tenths differ by less.
BEGINNING = 3.0
MOST_FORCES = 4  # equations whose missing force is drawn


def failure_of(diagnosis: Diagnosis, heading: str, unit: str, told: str) -> Failure:
    """A diagnosis as a report tells it.

    Args:
        diagnosis: of one step's model.
        heading: which model that is.
        unit: of the errors.
        told: the diagnosis in a paragraph.
    """
    ranking = diagnosis.candidates
    classes = _classes(diagnosis)
    listed = []
    for _, row in ranking.head(MOST_LISTED).iterrows():
        listed.append(_ranked(row, unit, classes))
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
        force = EquationForce.of(diagnosis.analysis, str(equation))
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
        force.force_label(),
        t_label,
        force.sentence,
        _force_runs(force, scale.size),
        names.index(str(force.where["trajectory"])),
        _map(force),
        _follows(force),
    )


def _force_runs(force: EquationForce, size: float) -> list[ForceRun]:
    """The force along each trajectory, times in a unit of so many of the user's."""
    record = force.record
    deviation = deviation_of(record.estimate)[:, force.number]
    share = MOST_FORCE_SAMPLES / len(record.trajectories)
    most = int(np.clip(share, FEWEST_PER_CURVE, MOST_PER_CURVE))
    runs = []
    for number_of_run, name in enumerate(record.trajectories):
        inside = np.flatnonzero(record.run == number_of_run)
        kept = inside[thinned([force.w[inside]], most)]
        t = rounded(record.t[kept] / size, DIGITS_OF_TIME)
        w = rounded(force.w[kept])
        since = date_words(0.0, record.origins[number_of_run])
        runs.append(ForceRun(name, t, w, rounded(deviation[kept]), since))
    return runs


def _map(force: EquationForce) -> ForceMap | None:
    names = map_variables(force)
    if len(names) < 2:
        return None
    found = MeanForce.of(force, names)
    rows = []
    for row in found.mean.T:
        rows.append(rounded(np.ma.filled(row, np.nan)))
    return ForceMap(
        force.variable_label(names[0]),
        force.variable_label(names[1]),
        rounded((found.edges_a[:-1] + found.edges_a[1:]) / 2),
        rounded((found.edges_b[:-1] + found.edges_b[1:]) / 2),
        rows,
        map_title(force, names),
    )


def _follows(force: EquationForce) -> Follows | None:
    if not len(force.follows):
        return None
    variable = force.single_variable(None)
    found = Dependence.of(force, variable)
    return _beside(found, dependence_title(force, variable))


def law_of(law: EffectLaw) -> Law:
    """The law of an effect, to be drawn against what it follows."""
    sentence = (
        f"The law that was added: what d{law.force.equation}/dt lacks where "
        f"{law.effect} is left out of the present model and all other values stay"
    )
    follows = _beside(law.dependence, sentence)
    return Law(law.title, law.force.force_label(), follows)


def _beside(found: Dependence, sentence: str) -> Follows:
    bins = Bins.of(found.z, found.w)
    step = max(1, len(found.z) // MOST_DRAWN_DOTS)
    return Follows(
        found.label,
        rounded(found.z[::step]),
        rounded(found.w[::step]),
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


def _ranked(row: pd.Series, unit: str, classes: Mapping[str, list[str]]) -> Ranked:
    share = _known(row["share"])
    explains = "not re-fitted"
    if share is not None:
        explains = f"{100 * min(max(share, 0.0), 1.0):.0f} %"
    held_out = _known(row["held_out_rmse"])
    train = _known(row["train_rmse"])
    error = ""
    if held_out is not None:
        error = f"{number(held_out)} {unit}".rstrip()
    elif train is not None:
        error = f"{number(train)} {unit}".rstrip() + " expected on training data"
    names = str(row["effect"]).split(" and ")
    places = str(row["equation"]).split(" and ")
    pairs = [f"{name} on {place}" for name, place in zip(names, places, strict=False)]
    size = with_error(float(row["coefficient"]), float(row["std_error"]))
    size += spaced(str(row["unit"]))
    if len(pairs) > 1:
        size += " of the first"
    name = " and ".join(pairs)
    alike = list(classes.get(name, []))
    for other in str(row["confusable_with"]).split(", "):
        if other and other not in alike:
            alike.append(other)
    confused = shortened(", ".join(alike))
    return Ranked(name, size, explains, share, error, confused, str(row["lost"]))


def shortened(listed: str) -> str:
    """The first few of a list with commas, and how many more there are."""
    names = listed.split(", ")
    if len(names) <= MOST_CONFUSED + 1:
        return listed
    return f"{', '.join(names[:MOST_CONFUSED])} and {len(names) - MOST_CONFUSED} more"


def _known(value: object) -> Number:
    found = float(value)  # type: ignore[arg-type]
    return found if np.isfinite(found) else None


def since_when(diagnosis: Diagnosis) -> str:
    """Since when the surest missing force is there, where it is strongest, how often.

    A beginning is told where one trajectory alone has the force, which is several times
    weaker before it.
    """
    force = EquationForce.of(diagnosis.analysis, None)
    if force.is_uncertain:
        return "At no time surely."
    record = force.record
    unit = record.units.get("t", "")
    sizes = []
    for number_of_run in range(len(record.trajectories)):
        sizes.append(_rms(force.w[record.run == number_of_run]))
    n_strong = sum(size > STRONG_RUN * max(sizes) for size in sizes)
    name = str(force.where["trajectory"])
    window = str(force.where["time_window"])
    origin = record.origin_of(name)
    begin = None
    if n_strong == 1:
        inside = np.flatnonzero(record.run == record.trajectories.index(name))
        begin = _beginning(force, inside)
    since = (
        f"From the start on, as far as the data tell{_in_runs(n_strong, len(sizes))}"
    )
    if begin is not None:
        of_run = name if len(sizes) > 1 else "the training record"
        when = f"{time_words(begin, unit)}{_in_brackets(date_words(begin, origin))}"
        since = f"Far stronger from about t = {when} of {of_run} on"
    if THROUGHOUT in window:
        return f"{since}; about as strong all the time."
    dates = _in_brackets(dates_words(window, origin))
    strongest = f"strongest at t = {times_words(window, unit)}{dates}"
    of_run = ""
    if begin is None:
        of_run = f" of {name}" if len(sizes) > 1 else " of the training record"
    return f"{since}; {strongest}{of_run}."


def _in_brackets(date: str) -> str:
    return f" ({date})" if date else ""


def _in_runs(n_strong: int, n_runs: int) -> str:
    """In how many trajectories a force is strong; "" where there is only one."""
    if n_runs == 1:
        return ""
    if n_strong == n_runs:
        return f", in all {n_runs} trajectories"
    return f", in {n_strong} of {n_runs} trajectories"


def _beginning(force: EquationForce, inside: np.ndarray) -> float | None:
    """The time before which the force is far weaker; None: there is none such."""
    tenths = np.array_split(inside, min(N_WINDOWS, len(inside)))
    contrasts = []
    for k in range(1, len(tenths)):
        before = _rms(force.w[np.concatenate(tenths[:k])])
        after = _rms(force.w[np.concatenate(tenths[k:])])
        contrasts.append(after / max(before, TINY))
    if not contrasts or max(contrasts) < BEGINNING:
        return None
    first = tenths[int(np.argmax(contrasts)) + 1][0]
    return float(force.record.t[first] - force.record.h[first] / 2)


def _rms(w: np.ndarray) -> float:
    return float(np.sqrt(np.mean(w**2)))
