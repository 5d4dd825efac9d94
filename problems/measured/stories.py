"""Studies of measured sets, told step by step: what is found without hints, its size
beside the published one, what remains.

    python -m problems.measured.stories [NAME ...] [--data=FOLDER]

Each study gets a base model that lacks what the set is known for, two records, nothing
else. Its loop (`Study.auto`) adds what a verdict names, wholly or partly. All sets are
told in short in results/measured_stories.md, some at length on pages of their own.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

import phsi_opt as ph
from phsi_opt.diagnosis.candidate import Grade
from phsi_opt.study.answers import evidence_words, nearest_candidate
from problems.measured.sets import SETS, Set, with_effects
from problems.tools.command_line import chosen
from problems.tools.data_paths import folder, is_present
from problems.tools.pages import lines, render
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

MOST_STEPS = 3  # that are added; the model after them is diagnosed too
SHOWN = 6  # candidates per diagnosis on a page
COMMAND = "python -m problems.measured.stories"
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
    """

    study: ph.Study
    diagnoses: list[ph.Diagnosis] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    how: list[str] = field(default_factory=lambda: [BASE])
    stopped: str = ""
    n_own: int = 0
    tests: Mapping[str, list[float]] = field(default_factory=dict)
    by_hand: float = np.nan

    def diagnose(self) -> ph.Diagnosis:
        """Diagnose the present model and keep what it took."""
        began = time.process_time()
        found = self.study.diagnose()
        self.diagnoses.append(found)
        self.seconds.append(time.process_time() - began)
        print(found, f"{self.seconds[-1]:.1f} s", sep="\n", flush=True)
        return found


def told(study: ph.Study, max_steps: int = MOST_STEPS) -> Story:
    """Diagnose and add at most ``max_steps`` effects.

    Where the loop of the package stops, the first candidate is added, as an engineer
    would who follows the table, as long as its evidence is strong and the error on the
    data held out falls.
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
        if new := study.steps[n_before:]:
            how = NAMED if diagnosis.verdict == ph.Verdict.NAMED else PARTLY
            for step in new:  # of one finding each, or of one that is removed again
                story.how.append(REMOVED if step.label.startswith("without ") else how)
            continue
        if not story.stopped:
            story.stopped = stopped
            story.n_own = n_before - 1
        if not _add_nearest(study, diagnosis):
            break
        story.how.append(NEAREST)
    if not story.stopped:
        story.stopped = f"the limit of {max_steps} steps was reached"
        story.n_own = len(study.steps) - 1
    return story


def _add_nearest(study: ph.Study, diagnosis: ph.Diagnosis) -> bool:
    """Add the first candidate of an unexplained misfit, where that is right."""
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


def told_of(chosen_set: Set) -> Story:
    """The story of a set, with its errors on the tests and that of what is known."""
    train, judged = chosen_set.records()
    story = told(ph.Study(chosen_set.model(), train, judged))
    try:
        model = with_effects(chosen_set.model(), chosen_set.physics)
        story.by_hand = ph.compare(ph.identify(model, train), judged).rmse
    except ph.PhsiOptError as error:
        print(f"by hand: {error}", flush=True)
    story.tests = {
        name: [ph.compare(step.fit, test).rmse for step in story.study.steps]
        for name, test in chosen_set.tests().items()
    }
    return story


# --- the pages


def errors(story: Story) -> str:
    """The steps with their errors, as a table."""
    shown = ["step", "effect", "train_rmse", "held_out_rmse", "noise_floor"]
    rows: list[list[str]] = []
    for row in story.study.history[shown].itertuples(index=False):
        further = [of_test[len(rows)] for of_test in story.tests.values()]
        numbers = [f"{value:.4g}" for value in (*row[2:], *further)]
        rows.append([row[0], row[1], story.how[len(rows)], *numbers])
    header = ["step", "model", "how chosen", "training", "held out", "noise floor"]
    return lines([*header, *story.tests], rows)


def page(stories: Mapping[str, Story]) -> str:
    """The page of all sets that were told."""
    rows = []
    for name, story in stories.items():
        steps = story.study.steps
        findings = [str(f) for d in story.diagnoses for f in d.findings]
        first, last = steps[0].judged.rmse, steps[-1].judged.rmse
        by_hand = f"{story.by_hand:.3g}" if np.isfinite(story.by_hand) else "-"
        row = {"set": name, "first verdict": story.diagnoses[0].verdict}
        row |= {"found": "; ".join(findings) or "-"}
        row |= {"held-out error": f"{first:.3g} to {last:.3g}", "by hand": by_hand}
        rows.append(row | {"slowest step (s)": f"{max(story.seconds):.0f}"})
    told_sets = [(name, SETS[name], story) for name, story in stories.items()]
    return render(
        "measured/pages/stories.md", summary=rows, told=told_sets, errors=errors
    )


def long_page(chosen_set: Set, story: Story) -> str:
    """A story at length; its pictures go to results/measured."""
    name = chosen_set.page.removesuffix("_story")
    save(story.diagnoses[0].figure(), f"measured/{name}_missing_force.png", dpi=100)
    size = (max(9.0, 2.2 * len(story.study.steps)), 3.8)  # the legend needs 8
    history, ax = plt.subplots(figsize=size, layout="constrained")
    story.study.plot_history(ax)
    save(history, f"measured/{name}_history.png", dpi=100)
    return render(
        "measured/pages/story.md",
        set=chosen_set,
        story=story,
        added=list(map(str, story.study.added)),
        n_further=len(story.study.steps) - 1 - story.n_own,
        errors=errors(story),
        picture=name,
        chapters=[(diagnosis, candidates(diagnosis)) for diagnosis in story.diagnoses],
    )


def candidates(diagnosis: ph.Diagnosis) -> list[dict[str, str]]:
    """The first candidates; numbers are empty where they were not re-fitted."""
    rows = []
    for c in diagnosis.ranking[:SHOWN]:
        error = "" if np.isnan(c.std_error) else f" +- {c.std_error:.2g}"
        row = {"effect": str(c.effect), "coefficient": f"{c.coefficient:.4g}{error}"}
        row |= {"evidence": evidence_words(c)}
        row |= {"held-out error": f"{c.held_out_rmse:.4g}".replace("nan", "")}
        rows.append(row | {"confusable with": ", ".join(c.confusable_with)})
    return rows


def main(names: list[str]) -> None:
    """Tell the sets of these names, all where none is given, and write their pages."""
    stories = {}
    for name in names or SETS:
        print(f"=== {name}", flush=True)
        if is_present(folder(SETS[name].folder)):
            stories[name] = told_of(SETS[name])
            if SETS[name].page:
                text = long_page(SETS[name], stories[name])
                write(f"{SETS[name].page}.md", text, f'{COMMAND} "{name}"')
    if stories and not names:
        write("measured_stories.md", page(stories))


if __name__ == "__main__":
    main(chosen())
