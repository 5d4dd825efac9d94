"""Where a study's model fails, for a report: forces in pictures, ranked effects."""

import numpy as np
import pandas as pd

from phsi_opt.criteria import SURE_DEVIATIONS
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.force_uncertainty import deviation_of
from phsi_opt.force_analysis.plot_parts import Bins
from phsi_opt.force_analysis.state_plots import (
    Dependence,
    dependence_title,
    map_title,
    map_variables,
)
from phsi_opt.force_analysis.state_plots import ForceMap as MeanForce
from phsi_opt.presentation.axes import label
from phsi_opt.presentation.numbers import number, with_error
from phsi_opt.presentation.report_content import (
    Failure,
    Follows,
    Force,
    ForceMap,
    ForceRun,
    Number,
    Ranked,
)
from phsi_opt.presentation.thinning import rounded, thinned
from phsi_opt.study.run_content import DIGITS_OF_TIME, FEWEST_PER_CURVE, MOST_PER_CURVE

MOST_FORCE_SAMPLES = 20_000  # of one force, in all trajectories
MOST_DOTS = 1_500  # of a force against what it follows
MOST_RANKED = 12  # candidates that are listed
MOST_FORCES = 4  # equations whose missing force is drawn


def failure_of(diagnosis: Diagnosis, heading: str, unit: str) -> Failure:
    """A diagnosis as a report tells it; ``unit`` is that of the errors."""
    ranking = diagnosis.candidates
    listed = []
    for _, row in ranking.head(MOST_RANKED).iterrows():
        listed.append(_ranked(row, unit))
    return Failure(
        heading,
        str(diagnosis.verdict),
        diagnosis.reason,
        tuple(diagnosis.sentences),
        tuple(_sure_forces(diagnosis)),
        tuple(listed),
        max(len(ranking) - MOST_RANKED, 0),
    )


def _sure_forces(diagnosis: Diagnosis) -> list[Force]:
    forces = []
    for equation in diagnosis.where["equation"]:
        force = EquationForce.of(diagnosis.analysis, str(equation))
        if not force.is_uncertain and len(forces) < MOST_FORCES:
            forces.append(_force(force))
    return forces


def _force(force: EquationForce) -> Force:
    record = force.record
    names = record.trajectories
    t_label = label("t", record.units.get("t", ""))
    return Force(
        f"d{force.equation}/dt",
        force.force_label(),
        t_label,
        force.sentence,
        _force_runs(force),
        names.index(str(force.where["trajectory"])),
        _map(force),
        _follows(force),
    )


def _force_runs(force: EquationForce) -> list[ForceRun]:
    record = force.record
    deviation = deviation_of(record.estimate)[:, force.number]
    share = MOST_FORCE_SAMPLES / len(record.trajectories)
    most = int(np.clip(share, FEWEST_PER_CURVE, MOST_PER_CURVE))
    runs = []
    for number_of_run, name in enumerate(record.trajectories):
        inside = np.flatnonzero(record.run == number_of_run)
        kept = inside[thinned([force.w[inside]], most)]
        t = rounded(record.t[kept], DIGITS_OF_TIME)
        w = rounded(force.w[kept])
        runs.append(ForceRun(name, t, w, rounded(deviation[kept])))
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
    bins = Bins.of(found.z, found.w)
    step = max(1, len(found.z) // MOST_DOTS)
    return Follows(
        found.label,
        rounded(found.z[::step]),
        rounded(found.w[::step]),
        rounded(bins.centre),
        rounded(bins.mean),
        rounded(bins.std),
        dependence_title(force, variable),
    )


def _ranked(row: pd.Series, unit: str) -> Ranked:
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
    confused = str(row["confusable_with"])
    lost = str(row["lost"])
    return Ranked(" and ".join(pairs), size, explains, share, error, confused, lost)


def _known(value: object) -> Number:
    found = float(value)  # type: ignore[arg-type]
    return found if np.isfinite(found) else None


def since_when(diagnosis: Diagnosis) -> str:
    """From when on the surest missing force is sure, in the trajectory it is strongest.

    A tenth of a trajectory counts where the force is beyond its uncertainty in most of
    that tenth.
    """
    force = EquationForce.of(diagnosis.analysis, None)
    record = force.record
    unit = record.units.get("t", "")
    deviation = deviation_of(record.estimate)[:, force.number]
    is_sure = np.abs(force.w) > SURE_DEVIATIONS * deviation
    name = str(force.where["trajectory"])
    inside = np.flatnonzero(record.run == record.trajectories.index(name))
    tenths = np.array_split(inside, min(10, len(inside)))
    strong = [k for k, tenth in enumerate(tenths) if np.mean(is_sure[tenth]) > 0.5]
    strongest = f"strongest at t = {force.where['time_window']} {unit}".rstrip()
    strongest = f"{strongest} of {name}"
    if not strong:
        percent = f"{100 * np.mean(is_sure):.0f} %"
        return f"now and then, surely during {percent} of the time; {strongest}"
    if strong[0] == 0:
        return f"from the start of the record on; {strongest}"
    first = tenths[strong[0]][0]
    begin = record.t[first] - record.h[first] / 2
    return f"from t = {begin:.3g} {unit}".rstrip() + f" on; {strongest}"
