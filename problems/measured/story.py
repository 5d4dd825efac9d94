"""A study of a measured set, told step by step: what the diagnosis says of each model,
what is added, what remains.

The diagnosis gets a model and two records, nothing else. Its loop (`Study.auto`) adds
what a verdict names, wholly or partly. Where it stops with "unexplained", the story
goes on as an engineer would who follows the table: the first candidate is added, marked
as such, as long as its evidence is strong and the error on the data held out falls.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

import phsi_opt as ph
from phsi_opt.diagnosis.candidate import Grade
from phsi_opt.study.answers import evidence_words, nearest_candidate
from problems.tools import markdown
from problems.tools.pictures import plt, save

SHOWN = 6  # candidates per diagnosis on the page
# How a step was chosen.
BASE = "base model"
PARTLY = "partly named"
NEAREST = "first candidate"
REMOVED = "superfluous since"

Tests = Mapping[str, list[float]]  # further errors per step, by name


@dataclass(eq=False)
class Story:
    """A study with the diagnosis of each of its models, the seconds each took, and how
    each step was chosen.

    ``own`` is why the loop of the package stopped, and ``n_own`` the number of steps it
    had taken until then.
    """

    study: ph.Study
    diagnoses: list[ph.Diagnosis] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    how: list[str] = field(default_factory=lambda: [BASE])
    own: str = ""
    n_own: int = 0

    def diagnose(self) -> ph.Diagnosis:
        """Diagnose the present model and keep what it took."""
        began = time.perf_counter()
        found = self.study.diagnose()
        self.diagnoses.append(found)
        self.seconds.append(time.perf_counter() - began)
        print(found, f"{self.seconds[-1]:.1f} s", sep="\n", flush=True)
        return found

    def time_after(self, step: int) -> str:
        """Seconds of the diagnosis of a step's model; empty for a model that was not
        diagnosed.
        """
        fit = self.study.steps[step].fit
        for diagnosis, seconds in zip(self.diagnoses, self.seconds, strict=True):
            if diagnosis.fit is fit:
                return f"{seconds:.0f}"
        return ""


def _say(line: str) -> None:
    print(f"... {line}", flush=True)


def told(
    model: ph.PseudoHamiltonian | ph.FirstOrder,
    train: ph.Measurements,
    held_out: ph.Measurements,
    max_steps: int = 4,
    say: Callable[[str], None] = _say,
) -> Story:
    """Diagnose and add at most ``max_steps`` effects (see the module's text)."""
    study = ph.Study(model, train, held_out, progress=say)
    story = Story(study)
    while True:
        diagnosis = story.diagnose()
        n_before = len(study.steps)
        if n_before > max_steps:
            break
        stopped = _one_step(study, diagnosis)
        n_added = len(study.steps) - n_before
        if n_added:
            story.how.append(
                "named" if diagnosis.verdict == ph.Verdict.NAMED else PARTLY
            )
            story.how += [REMOVED] * (n_added - 1)
            continue
        if not story.own:
            story.own = stopped
            story.n_own = n_before - 1
        if not _go_on(study, diagnosis):
            break
        story.how.append(NEAREST)
    story.own = story.own or f"the limit of {max_steps} steps was reached"
    return story


def _one_step(study: ph.Study, diagnosis: ph.Diagnosis) -> str:
    """One step of the package's own loop; why it stopped."""
    try:
        study.auto(max_steps=1)
    except ph.PhsiOptError as error:
        return f"{diagnosis.reason}; adding it failed: {error}"
    return study.stopped


def _go_on(study: ph.Study, diagnosis: ph.Diagnosis) -> bool:
    """Add the first candidate of an unexplained misfit, if its evidence is strong and
    the held-out error falls.
    """
    first = nearest_candidate(diagnosis)
    if first is None or first.grade not in (Grade.DECISIVE, Grade.STRONG):
        return False
    try:
        study.add(first.effect)
    except ph.PhsiOptError as error:
        print(f"not added: {error}", flush=True)
        return False
    if study.steps[-1].judged.rmse < diagnosis.base.rmse:
        return True
    study.undo()
    return False


# --- the page


def page(
    story: Story,
    name: str,
    text: str,
    tests: Tests | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> str:
    """The story as Markdown; its pictures go to results/measured.

    Args:
        story: What was told.
        name: Of the pictures.
        text: Said first.
        tests: Further errors per step, by name, in ``unit`` already.
        scale: Errors are shown times this number.
        unit: In which errors are shown; that of the study by default.
    """
    unit = unit or story.study.unit
    pictures(story, name)
    parts = ["## What the diagnosis finds without hints", "", text, ""]
    parts += [_opening(story), "", _steps(story, tests or {}, scale, unit), ""]
    parts += [f"![free-run error per step](measured/{name}_history.png)", ""]
    parts += [f"![missing force of the base model](measured/{name}_missing_force.png)"]
    parts += [""]
    for step, diagnosis in enumerate(story.diagnoses):
        parts += _chapter(step, diagnosis, scale, unit)
    parts += ["### The last model", "", *markdown.block(str(story.study.fit))]
    return "\n".join(parts).rstrip()


def _steps(story: Story, tests: Tests, scale: float, unit: str) -> str:
    """The table of the steps with their errors."""
    header = [
        "step",
        "effect",
        "how chosen",
        f"training error ({unit})",
        f"held-out error ({unit})",
        f"noise floor ({unit})",
        *(f"{test} ({unit})" for test in tests),
        "seconds of the diagnosis after it",
    ]
    rows = []
    history = story.study.history.itertuples(index=False)
    for step, (_, effect, *errors, _) in enumerate(history):
        shown = [f"{scale * error:.3g}" for error in errors]
        shown += [f"{errors_of_test[step]:.3g}" for errors_of_test in tests.values()]
        rows.append([step, effect, story.how[step], *shown, story.time_after(step)])
    return markdown.lines(header, rows)


def _opening(story: Story) -> str:
    """What was added, how far the loop went alone, the last verdict."""
    added = [f"{e.name} on {e.equation}" for e in story.study.added]
    n_further = len(story.study.steps) - 1 - story.n_own
    said = [f"Added: {', '.join(added) or 'nothing'}."]
    if n_further > 0:
        plural = "" if story.n_own == 1 else "s"
        said += [
            f"On its own the loop takes {story.n_own} step{plural} and then stops: "
            f"{story.own}.",
            f"The first candidates of the table lead {n_further} further.",
        ]
    said.append(f'The last verdict is "{story.diagnoses[-1].verdict}".')
    return " ".join(said)


def _chapter(step: int, diagnosis: ph.Diagnosis, scale: float, unit: str) -> list[str]:
    """What one diagnosis says."""
    title = "The base model" if step == 0 else f"After step {step}"
    header = [
        "effect",
        "equation",
        "coefficient",
        "evidence",
        f"held-out error ({unit})",
        "confusable with",
    ]
    rows = [_candidate(c, scale) for c in diagnosis.ranking[:SHOWN]]
    where = (
        [] if diagnosis.verdict == ph.Verdict.NOTHING_MISSING else diagnosis.sentences
    )
    return [
        f"### {title}",
        "",
        *(f"{sentence} " for sentence in where),
        "",
        f"Verdict: {diagnosis.verdict}. {diagnosis.reason}.",
        "",
        markdown.lines(header, rows),
        "",
    ]


def _candidate(c: ph.Candidate, scale: float) -> list[str]:
    """The cells of a candidate; empty where it was not re-fitted."""
    size = f"{c.coefficient:.4g}"
    if not np.isnan(c.std_error):
        size += f" +- {c.std_error:.2g}"
    held_out = scale * c.held_out_rmse
    return [
        c.effect.name,
        c.effect.equation,
        size,
        evidence_words(c),
        "" if np.isnan(held_out) else f"{held_out:.4g}",
        ", ".join(c.confusable_with),
    ]


def pictures(story: Story, name: str) -> None:
    """The missing force of the base model and the error per step, as PNG."""
    where = story.diagnoses[0].figure()
    save(where, f"measured/{name}_missing_force.png", dpi=100)
    width = max(6.0, 2.2 * len(story.study.steps))
    history, ax = plt.subplots(figsize=(width, 3.8), layout="constrained")
    story.study.plot_history(ax)
    save(history, f"measured/{name}_history.png", dpi=100)
