"""Studies of measured sets, told step by step: what is found without hints, its size
beside the published one, what share it explains, what remains.

    python -m problems.measured.stories [NAME ...] [--data=FOLDER]

tells all ten sets in short (results/measured_stories.md); `long_stories` tells some at
length. Each study gets a base model that lacks what the set is known for, two records,
nothing else. Its loop (`Study.auto`) adds what a verdict names, wholly or partly.
"""

import os

# Before NumPy is loaded: processor seconds of one thread, not of those that wait.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

import phsi_opt as ph
from phsi_opt.diagnosis.candidate import Grade
from phsi_opt.study.answers import nearest_candidate, samples_to_average
from problems.measured.sets import SETS, Records, Set, with_effects
from problems.tools import markdown
from problems.tools.command_line import chosen
from problems.tools.data_paths import folder, is_present
from problems.tools.pages import render
from problems.tools.provenance import write

MOST_STEPS = 3  # that are added; the model after them is diagnosed too
BY_HAND = "error with what is known, by hand"
SECONDS_ASKED = 20.0  # of a processor, for one step
# How a step was chosen.
BASE, NAMED, PARTLY = "base model", "named", "partly named"
NEAREST, REMOVED = "first candidate", "superfluous since"


@dataclass(eq=False)
class Story:
    """A study with the diagnosis of each of its models, the processor seconds that each
    took, and how each step was chosen.

    Attributes:
        stopped: Why the loop of the package stopped.
        n_own: The number of steps it had taken until then.
        tests: Errors of every step on further records, by name.
        by_hand: The error, on the record that judges, of the model with what is known.
        averaged: The story of the same records with fewer samples, means of
            ``n_averaged`` each, where that is advised.
    """

    study: ph.Study
    diagnoses: list[ph.Diagnosis] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    how: list[str] = field(default_factory=lambda: [BASE])
    stopped: str = ""
    n_own: int = 0
    tests: Mapping[str, list[float]] = field(default_factory=dict)
    by_hand: float = np.nan
    n_averaged: int = 0
    averaged: "Story | None" = None

    def diagnose(self) -> ph.Diagnosis:
        """Diagnose the present model and keep what it took."""
        began = time.process_time()
        found = self.study.diagnose()
        self.diagnoses.append(found)
        self.seconds.append(time.process_time() - began)
        print(found, f"{self.seconds[-1]:.1f} s", sep="\n", flush=True)
        return found


def told(study: ph.Study, max_steps: int = MOST_STEPS, goes_on: bool = False) -> Story:
    """Diagnose and add at most ``max_steps`` effects.

    Args:
        goes_on: Whether the first candidate is added, as an engineer would who follows
            the table, where the loop of the package stops, as long as its evidence is
            strong and the error on the data held out falls.
    """
    story = Story(study)
    while True:
        diagnosis = story.diagnose()
        n_before = len(study.steps)
        if n_before > max_steps:
            break
        try:
            study.auto(max_steps=1)
            stopped = study.stopped
        except ph.PhsiOptError as error:
            stopped = f"{diagnosis.reason}; adding it failed: {error}"
        n_added = len(study.steps) - n_before
        if n_added:
            is_named = diagnosis.verdict == ph.Verdict.NAMED
            story.how += [NAMED if is_named else PARTLY, *[REMOVED] * (n_added - 1)]
            continue
        if not story.stopped:
            story.stopped = stopped
            story.n_own = n_before - 1
        if not (goes_on and _add_nearest(study, diagnosis)):
            break
        story.how.append(NEAREST)
    if not story.stopped:
        story.stopped = f"the limit of {max_steps} steps was reached"
        story.n_own = len(study.steps) - 1
    return story


def _add_nearest(study: ph.Study, diagnosis: ph.Diagnosis) -> bool:
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


# --- all sets in short


def told_in_short(chosen: Set) -> Story:
    """The study, and again from means of samples where that is advised."""
    records = chosen.records()
    story = told(ph.Study(chosen.model(), *records))
    story.by_hand = _error_by_hand(chosen, records)
    print(f"by hand: {story.by_hand:.3g}", flush=True)
    story.tests = {
        name: [ph.compare(step.fit, test).rmse for step in story.study.steps]
        for name, test in chosen.tests().items()
    }
    story.n_averaged = samples_to_average(story.diagnoses[-1])
    if story.n_averaged:
        means = [record.thinned(story.n_averaged) for record in records]
        story.averaged = told(ph.Study(chosen.model(), *means))
    return story


def _error_by_hand(chosen: Set, records: Records) -> float:
    """Of the model with what is known, fitted; NaN where that fails."""
    train, judged = records
    try:
        model = with_effects(chosen.model(), chosen.physics)
        return ph.compare(ph.identify(model, train), judged).rmse
    except ph.PhsiOptError as error:
        print(f"by hand: {error}", flush=True)
        return np.nan


def page(stories: Mapping[str, Story]) -> str:
    """The page of all sets that were told."""
    quick = [max(story.seconds) < SECONDS_ASKED for story in stories.values()]
    return render(
        "measured/pages/stories.md",
        n=len(stories),
        asked=SECONDS_ASKED,
        n_quick=sum(quick),
        summary=summary(stories),
        chapters=[(name, _chapter(SETS[name], s)) for name, s in stories.items()],
    )


def _chapter(chosen: Set, story: Story) -> dict[str, object]:
    """What the page says of a set."""
    last = story.diagnoses[-1]
    remains = [text for text in last.sentences if "no missing force" not in text]
    is_missing = last.verdict != ph.Verdict.NOTHING_MISSING
    averaged = story.averaged
    return {
        "machine": chosen.machine,
        "known": chosen.known,
        "steps": _steps(story),
        "remains": remains[0] if remains and is_missing else "",
        "next_step": last.next_step if is_missing else "",
        "unit": f" ({story.study.unit})" if story.study.unit else "",
        "errors": _errors(story),
        "n_averaged": story.n_averaged if averaged else 0,
        "averaged_steps": _steps(averaged) if averaged else "",
        "averaged_errors": _errors(averaged) if averaged else "",
    }


def _steps(story: Story) -> str:
    """A line for each diagnosis."""
    lines = []
    pairs = zip(story.diagnoses, story.seconds, strict=True)
    for number, (diagnosis, seconds) in enumerate(pairs, start=1):
        verdict, reason = diagnosis.verdict, diagnosis.reason
        lines.append(f"{number}. **{verdict}** ({seconds:.0f} s): {reason}.")
    if "failed" in story.stopped:
        lines.append(f"   {story.stopped}")
    return "\n\n".join(lines)


def _errors(story: Story) -> str:
    """The errors of all models, as a table."""
    shown = ["step", "effect", "train_rmse", "held_out_rmse", "noise_floor"]
    rows: list[list[str]] = []
    for row in story.study.history[shown].itertuples(index=False):
        further = [errors[len(rows)] for errors in story.tests.values()]
        numbers = [f"{value:.4g}" for value in (*row[2:], *further)]
        rows.append([row[0], row[1], *numbers])
    header = ["step", "model", "training", "held out", "noise floor", *story.tests]
    return markdown.lines(header, rows)


def summary(stories: Mapping[str, Story]) -> list[dict[str, object]]:
    """A line per set: verdicts, findings, error, seconds."""
    rows: list[dict[str, object]] = []
    for name, story in stories.items():
        findings = [str(f) for d in story.diagnoses for f in d.findings]
        steps = story.study.steps
        before, after = steps[0].judged.rmse, steps[-1].judged.rmse
        by_hand = f"{story.by_hand:.3g}" if np.isfinite(story.by_hand) else "-"
        rows.append(
            {
                "set": name,
                "first verdict": story.diagnoses[0].verdict,
                "found": "; ".join(findings) or "-",
                "held-out error": f"{before:.3g} to {after:.3g}",
                BY_HAND: by_hand,
                "slowest step (s)": f"{max(story.seconds):.0f}",
            }
        )
    return rows


def main(names: list[str]) -> None:
    """Tell the sets of these names, all where none is given, and write the page."""
    stories = {}
    for name in names or SETS:
        print(f"=== {name}", flush=True)
        if is_present(folder(SETS[name].folder)):
            stories[name] = told_in_short(SETS[name])
            # A run that is interrupted leaves what was told.
            write("measured_stories.md", page(stories))


if __name__ == "__main__":
    main(chosen())
