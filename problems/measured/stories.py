"""Ten measured sets told in short: what is found without hints, its size beside the
published one, what share it explains, what remains, and how many processor seconds a
step takes.

Each study gets a base model that lacks what the set is known for, two records, nothing
else. It is `Study.auto`: what a verdict names, wholly or partly, is added.

    python -m problems.measured.stories [NAME ...]
"""

import os

# Before NumPy is loaded: processor seconds of one thread, not of those that wait.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import phsi_opt as ph
from phsi_opt.study.answers import samples_to_average
from problems.measured import (
    ball_and_hoop,
    battery_cell,
    cascaded_tanks,
    coupled_drives,
    emps,
    heaters,
    houses,
    quarter_drone,
    silverbox,
    torque_pendulum,
)
from problems.tools import markdown
from problems.tools.data_paths import folder, is_present
from problems.tools.provenance import write

MOST_STEPS = 3  # that are added; the model after them is diagnosed too
BY_HAND = "error with what is known, by hand"
SECONDS_ASKED = 20.0  # of a processor, for one step

Records = tuple[ph.Measurements, ph.Measurements]
Model = ph.PseudoHamiltonian | ph.FirstOrder


@dataclass(frozen=True)
class Set:
    """A measured set with its base model.

    Attributes:
        machine: What it is, and what the base model has.
        model: Makes the base model.
        records: Reads the records to fit and to judge by.
        known: What is published or known of what the base lacks.
        physics: The same as effects that are added by hand, to compare.
        tests: Reads further records, by name, that are looked at only to report.
    """

    machine: str
    model: Callable[[], Model]
    records: Callable[[], Records]
    known: str
    physics: tuple[str, ...]
    tests: Callable[[], dict[str, ph.Measurements]] = dict


@dataclass(eq=False)
class Told:
    """A study with its diagnoses, and the processor seconds that each took.

    ``by_hand`` is the error on the record that judges of the model with what is known,
    by maximum likelihood; ``tests`` that of every step on further records.
    ``averaged`` is the story of the same records with fewer samples, means of
    ``n_averaged`` each, where that is advised.
    """

    study: ph.Study
    diagnoses: list[ph.Diagnosis] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    stopped: str = ""
    by_hand: float = np.nan
    tests: dict[str, list[float]] = field(default_factory=dict)
    n_averaged: int = 0
    averaged: "Told | None" = None


def pendulum_base() -> ph.PseudoHamiltonian:
    """The motor pendulum with viscous friction alone."""
    inertia = ph.Parameter(0.2, lower=1e-3, unit="kg m^2")
    gravity = ph.Parameter(3.0, lower=0, unit="N m")
    viscous = ph.Parameter(0.05, lower=0, unit="N m s/rad")
    return ph.PseudoHamiltonian(
        states=["q", "v"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("v**2/2 - G/J*cos(q)", G=gravity, J=inertia),
        R={"v": ph.formula("viscous/J", viscous=viscous, J=inertia)},
        F={"v": ph.formula("u/J", J=inertia)},
    )


def _emps() -> Records:
    path = folder("emps")
    return (
        emps.load(path / emps.FIT_FILE, emps.WINDOW),
        emps.load(path / emps.TEST_FILE, emps.WINDOW),
    )


def _drone() -> Records:
    path = folder("quarter_drone")
    return quarter_drone.load(path, "steps"), quarter_drone.load(path, "multisine")


def _box() -> Records:
    path = folder("silverbox") / "SNLS80mV.csv"
    first = silverbox.FIT[0]
    second = silverbox.HELD_OUT[0]
    return (
        silverbox.load(path, first, first + silverbox.N_STORY),
        silverbox.load(path, second, second + silverbox.N_STORY),
    )


def _hoop() -> Records:
    data = ball_and_hoop.load(folder("ball_and_hoop") / "randomStepSequence.mat")
    return data.split(ball_and_hoop.FITTED_SHARE)


def _hoop_tests() -> dict[str, ph.Measurements]:
    path = folder("ball_and_hoop")
    return {n: ball_and_hoop.load(path / f"{n}.mat") for n in ball_and_hoop.TESTS}


def _tanks() -> Records:
    path = folder("cascaded_tanks") / "dataBenchmark.csv"
    data = cascaded_tanks.load(path, "Est")
    return data.split(cascaded_tanks.FITTED_SHARE)


def _pendulum() -> Records:
    data = torque_pendulum.load(torque_pendulum.FILE, has_velocity=False)
    return data.split(0.5)


SETS = {
    "EMPS": Set(
        "a linear drive; mass and viscous friction",
        emps.base_model,
        _emps,
        "dry friction 20.4 N, offset 3.2 N (to the other side)",
        ("coulomb friction on p", "constant force on p"),
    ),
    "cascaded tanks": Set(
        "two tanks, the lower level measured; outflows by Torricelli",
        cascaded_tanks.textbook,
        _tanks,
        "both tanks overflow in the record",
        ("overflow from h1 on h2",),
    ),
    "ball and hoop": Set(
        "a hoop's speed; one linear lag",
        ball_and_hoop.model,
        _hoop,
        "not published; the response falls at large speeds",
        ("quadratic drag on y",),
        _hoop_tests,
    ),
    "quarter drone": Set(
        "an arm with a propeller; gravity, viscous damping, linear thrust",
        quarter_drone.model,
        _drone,
        "not published; the arm is not balanced, its bearing is dry",
        ("constant force on p", "coulomb friction on p"),
    ),
    "Silverbox": Set(
        "an electronic oscillator; linear spring and damper",
        silverbox.model,
        _box,
        "a cubic spring, and an offset",
        ("cubic stiffness on p", "constant force on p"),
    ),
    "motor pendulum": Set(
        "a pendulum with a motor, its angle measured; viscous friction",
        pendulum_base,
        _pendulum,
        "dry friction 0.29 N m, offset 0.076 N m, over the inertia 0.15 kg m^2; the "
        "velocity in the file is worked out from the angle and left out",
        ("coulomb friction on v", "constant force on v"),
    ),
    "house 1": Set(
        "a heated house; one heat capacity",
        houses.one_storage,
        lambda: houses.load(folder("building"), 1, 1).split(0.5),
        "a second storage (the envelope)",
        ("second heat storage on Ti",),
    ),
    "two heaters": Set(
        "two heaters on a board with lagging sensors",
        heaters.model,
        lambda: heaters.load(heaters.FILE).split(0.5),
        "radiation is some percent of the loss; little else",
        ("radiation on T1", "radiation on T2"),
    ),
    "battery cell": Set(
        "a cell with one resistor and capacitor",
        lambda: battery_cell.model(1),
        lambda: battery_cell.load(battery_cell.FILE, 1).split(0.5),
        "a second pair",
        ("second charge storage on v",),
    ),
    "coupled drives": Set(
        "two drums and a belt; viscous friction",
        coupled_drives.model,
        lambda: coupled_drives.load(coupled_drives.FILE).split(0.67),
        "not published; the drums have dry friction",
        ("coulomb friction on w",),
    ),
}


def told(chosen: Set) -> Told:
    """Diagnose and add, and again from means of samples where that is advised."""
    records = chosen.records()
    story = _told(ph.Study(chosen.model(), *records))
    story.by_hand = _error_by_hand(chosen, *records)
    print(f"by hand: {story.by_hand:.3g}", flush=True)
    for name, test in chosen.tests().items():
        errors = [ph.compare(step.fit, test).rmse for step in story.study.steps]
        story.tests[name] = errors
    story.n_averaged = samples_to_average(story.diagnoses[-1])
    if story.n_averaged:
        means = [record.thinned(story.n_averaged) for record in records]
        story.averaged = _told(ph.Study(chosen.model(), *means))
    return story


def _error_by_hand(
    chosen: Set, train: ph.Measurements, judged: ph.Measurements
) -> float:
    """Of the model with what is known, fitted; NaN where that fails."""
    model = chosen.model()
    try:
        for effect in chosen.physics:
            name, _, equation = effect.rpartition(" on ")
            model = model.add(name, equation)
        return ph.compare(ph.identify(model, train), judged).rmse
    except ph.PhsiOptError as error:
        print(f"by hand: {error}", flush=True)
        return np.nan


def _told(study: ph.Study) -> Told:
    """Diagnose and add, at most `MOST_STEPS` times."""
    story = Told(study)
    for _ in range(MOST_STEPS + 1):
        began = time.process_time()
        diagnosis = study.diagnose()
        story.diagnoses.append(diagnosis)
        story.seconds.append(time.process_time() - began)
        print(f"{story.seconds[-1]:.1f} s", diagnosis, sep="\n", flush=True)
        if not diagnosis.proposed or len(story.diagnoses) > MOST_STEPS:
            break
        try:
            study.auto(max_steps=1)
        except ph.PhsiOptError as error:
            story.stopped = f"adding it failed: {error}"
            break
        if study.stopped and "limit" not in study.stopped:
            break
    return story


def chapter(name: str, chosen: Set, story: Told) -> list[str]:
    """What the page says of a set."""
    lines = [f"## {name}", "", f"Base model: {chosen.machine}. Known: {chosen.known}."]
    lines += ["", *_steps(story)]
    last = story.diagnoses[-1]
    remains = [text for text in last.sentences if "no missing force" not in text]
    is_missing = last.verdict != ph.Verdict.NOTHING_MISSING
    if remains and is_missing:
        lines += ["", f"What remains: {remains[0]}"]
    if last.next_step and is_missing:
        lines += ["", f"What to do next: {last.next_step}"]
    lines += ["", *_errors(story)]
    if story.averaged is not None:
        lines += [f"As advised, from means of {story.n_averaged} samples:", ""]
        lines += [*_steps(story.averaged), "", *_errors(story.averaged)]
    return lines


def _steps(story: Told) -> list[str]:
    """A line for each diagnosis."""
    lines = []
    pairs = zip(story.diagnoses, story.seconds, strict=True)
    for number, (diagnosis, seconds) in enumerate(pairs, start=1):
        verdict, reason = diagnosis.verdict, diagnosis.reason
        lines.append(f"{number}. **{verdict}** ({seconds:.0f} s): {reason}.")
    if story.stopped:
        lines.append(f"   {story.stopped}")
    return lines


def _errors(story: Told) -> list[str]:
    """The errors of all models, as a table."""
    unit = f" ({story.study.unit})" if story.study.unit else ""
    shown = ["step", "effect", "train_rmse", "held_out_rmse", "noise_floor"]
    rows: list[list[str]] = []
    for row in story.study.history[shown].itertuples(index=False):
        further = [errors[len(rows)] for errors in story.tests.values()]
        numbers = [f"{value:.4g}" for value in (*row[2:], *further)]
        rows.append([row[0], row[1], *numbers])
    header = ["step", "model", "training", "held out", "noise floor", *story.tests]
    table = markdown.lines(header, rows)
    return [f"Errors of the free run{unit}:", "", table, ""]


def summary(stories: dict[str, Told]) -> str:
    """A line per set: verdicts, findings, error, seconds."""
    rows = []
    for name, story in stories.items():
        found = []
        for diagnosis in story.diagnoses:
            found += [str(finding) for finding in diagnosis.findings]
        steps = story.study.steps
        before = steps[0].judged.rmse
        after = steps[-1].judged.rmse
        verdict = story.diagnoses[0].verdict
        rows.append(
            [
                name,
                verdict,
                "; ".join(found) or "-",
                f"{before:.3g} to {after:.3g}",
                f"{story.by_hand:.3g}" if np.isfinite(story.by_hand) else "-",
                f"{max(story.seconds):.0f}",
            ]
        )
    header = [
        "set",
        "first verdict",
        "found",
        "held-out error",
        BY_HAND,
        "slowest step (s)",
    ]
    return markdown.lines(header, rows)


def page(stories: dict[str, Told]) -> str:
    """The page of all sets that were told."""
    seconds = [max(story.seconds) for story in stories.values()]
    n_quick = int(np.sum(np.array(seconds) < SECONDS_ASKED))
    introduction = (
        f"{len(stories)} sets, a study each with a base model that lacks what the set "
        f"is known for. A step was asked for in {SECONDS_ASKED:.0f} s: {n_quick} of "
        f"{len(stories)} sets keep to it in every step (processor seconds). By hand: "
        "what is known is added to the base model, which is fitted to the same data by "
        "maximum likelihood."
    )
    parts = ["# Measured machines, told in short", "", introduction, ""]
    parts += [summary(stories), ""]
    for name, story in stories.items():
        parts += chapter(name, SETS[name], story)
    return "\n".join(parts)


def main(names: list[str]) -> None:
    """Tell the sets of these names, all where none is given, and write the page."""
    stories = {}
    for name in names or SETS:
        print(f"=== {name}", flush=True)
        if not is_present(folder("emps")):
            return
        stories[name] = told(SETS[name])
        # A run that is interrupted leaves what was told.
        write("measured_stories.md", page(stories))


if __name__ == "__main__":
    main(sys.argv[1:])
