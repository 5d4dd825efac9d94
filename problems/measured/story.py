"""A study of a measured set, told step by step: what the diagnosis says of each model,
what is added, what remains.

The diagnosis gets a model and two records, nothing else. Its loop (`Study.auto`) adds
what a verdict names, or proposes although more than noise would be left. Where it stops
with "unexplained", the story goes on as an engineer would who follows the table: the
first re-fitted candidate is added, marked as such, as long as its p-value is small and
the error on the data held out falls.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import phsi_opt as ph
from problems.tools.provenance import RESULTS

# p-value, adjusted for all candidates, up to which the first candidate is added where
# none is named
RATE = 0.01
SHOWN = 6  # candidates per diagnosis on the page
BASE, PROPOSED, NEAREST, REMOVED = (
    "base model",
    "proposed",
    "first candidate",
    "superfluous since",
)


@dataclass(frozen=True, eq=False)
class Story:
    """A study with the diagnosis of each of its models, the seconds each took, and how
    each step was chosen.

    ``own`` is why the loop of the package stopped, and ``n_own`` the number of steps it
    had taken until then.
    """

    study: ph.Study
    diagnoses: list[ph.Diagnosis]
    seconds: list[float]
    how: list[str]
    own: str
    n_own: int

    def time_after(self, step: int) -> str:
        """Seconds of the diagnosis of a step's model; empty for a model that was not
        diagnosed.
        """
        at = {id(d.fit): s for d, s in zip(self.diagnoses, self.seconds, strict=True)}
        found = at.get(id(self.study.steps[step].fit))
        return "" if found is None else f"{found:.0f}"


def told(
    model: ph.PseudoHamiltonian | ph.FirstOrder,
    train: ph.Measurements,
    held_out: ph.Measurements,
    max_steps: int = 4,
    say: Callable[[str], None] = lambda line: print(f"... {line}", flush=True),
) -> Story:
    """Diagnose and add at most ``max_steps`` effects (see the module's text)."""
    study = ph.Study(model, train, held_out, progress=say)
    diagnoses: list[ph.Diagnosis] = []
    seconds: list[float] = []
    how, own, n_own = [BASE], "", 0
    while True:
        began = time.perf_counter()
        diagnoses.append(study.diagnose())
        seconds.append(time.perf_counter() - began)
        print(diagnoses[-1], f"{seconds[-1]:.1f} s", sep="\n", flush=True)
        n_before = len(study.steps)
        if n_before > max_steps:
            break
        try:
            study.auto(max_steps=1)
            stopped = study.stopped
        except ph.PhsiOptError as error:
            stopped = f"{diagnoses[-1].reason}; adding it failed: {error}"
        if len(study.steps) > n_before:
            how.append(
                "named" if diagnoses[-1].verdict == ph.Verdict.NAMED else PROPOSED
            )
            how += [REMOVED] * (len(study.steps) - n_before - 1)
            continue
        if not own:
            own, n_own = stopped, n_before - 1
        if not _go_on(study, diagnoses[-1]):
            break
        how.append(NEAREST)
    return Story(
        study,
        diagnoses,
        seconds,
        how,
        own or f"the limit of {max_steps} steps was reached",
        n_own,
    )


def _go_on(study: ph.Study, diagnosis: ph.Diagnosis) -> bool:
    """Add the first re-fitted candidate of an unexplained misfit, if significant and
    the held-out error falls.
    """
    first = next((c for c in diagnosis.ranking if c.fit is not None), None)
    if diagnosis.verdict != ph.Verdict.UNEXPLAINED or first is None:
        return False
    if not (first.p_value < RATE and first.held_out_rmse < diagnosis.base.rmse):
        return False
    try:
        study.add(first.effect)
    except ph.PhsiOptError as error:
        print(f"not added: {error}", flush=True)
        return False
    return True


def page(
    story: Story,
    name: str,
    text: str,
    tests: dict[str, list[float]] | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> str:
    """The story as Markdown: ``text`` first, errors times ``scale`` in ``unit``; its
    pictures go to results/measured.

    ``tests``: further errors per step, by name, in ``unit`` already.
    """
    study = story.study
    unit = unit or study.unit
    head = [
        "step",
        "effect",
        "how chosen",
        f"training error ({unit})",
        f"held-out error ({unit})",
        f"noise floor ({unit})",
        *(f"{test} ({unit})" for test in tests or {}),
        "seconds of the diagnosis after it",
    ]
    rows = [
        (
            k,
            effect,
            story.how[k],
            *(f"{scale * e:.3g}" for e in errors),
            *(f"{test[k]:.3g}" for test in (tests or {}).values()),
            story.time_after(k),
        )
        for k, (_, effect, *errors, _) in enumerate(
            study.history.itertuples(index=False)
        )
    ]
    chapters = [
        line
        for k, d in enumerate(story.diagnoses)
        for line in _chapter(k, d, scale, unit)
    ]
    pictures(story, name)
    return "\n".join(
        [
            "## What the diagnosis finds without hints",
            "",
            text,
            "",
            _opening(story),
            "",
            _table(head, rows),
            "",
            f"![free-run error per step](measured/{name}_history.png)",
            "",
            f"![missing force of the base model](measured/{name}_missing_force.png)",
            "",
            *chapters,
            "### The last model",
            "",
            "```text",
            str(study.fit),
            "```",
        ]
    )


def _opening(story: Story) -> str:
    n = len(story.study.steps) - 1
    added = [f"{e.name} on {e.equation}" for e in story.study.added]
    listed = ", ".join(added) if added else "nothing"
    count = f"{story.n_own} step{'' if story.n_own == 1 else 's'}"
    alone = (
        f"On its own the loop takes {count} and then stops: {story.own}."
        if n > story.n_own
        else ""
    )
    end = story.diagnoses[-1]
    close = f'The last verdict is "{end.verdict}".'
    beyond = (
        f"The first candidates of the table lead {n - story.n_own} further."
        if n > story.n_own
        else ""
    )
    return " ".join(
        part for part in (f"Added: {listed}.", alone, beyond, close) if part
    )


def _chapter(k: int, diagnosis: ph.Diagnosis, scale: float, unit: str) -> list[str]:
    head = "The base model" if k == 0 else f"After step {k}"
    columns = [
        "effect",
        "equation",
        "coefficient",
        "p-value",
        "change of BIC",
        f"held-out error ({unit})",
        "confusable with",
    ]
    rows = [
        (
            c.effect.name,
            c.effect.equation,
            _sized(c),
            f"{c.p_value:.1g}",
            *(
                "" if np.isnan(v) else f"{v:.4g}"
                for v in (c.delta_bic, scale * c.held_out_rmse)
            ),
            ", ".join(c.confusable_with),
        )
        for c in diagnosis.ranking[:SHOWN]
    ]
    where = (
        [] if diagnosis.verdict == ph.Verdict.NOTHING_MISSING else diagnosis.sentences
    )
    return [
        f"### {head}",
        "",
        *(f"{s} " for s in where),
        "",
        f"Verdict: {diagnosis.verdict}. {diagnosis.reason}.",
        "",
        _table(columns, rows),
        "",
    ]


def _sized(c: ph.Candidate) -> str:
    return f"{c.coefficient:.4g}" + (
        "" if np.isnan(c.std_error) else f" +- {c.std_error:.2g}"
    )


def _table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def pictures(story: Story, name: str) -> list[Path]:
    """The missing force of the base model and the error per step, as PNG."""
    folder = RESULTS / "measured"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}_missing_force.png", folder / f"{name}_history.png"]
    where = story.diagnoses[0].figure()
    width = max(6.0, 2.2 * len(story.study.steps))
    history, ax = plt.subplots(figsize=(width, 3.8), layout="constrained")
    story.study.plot_history(ax)
    for figure, path in zip((where, history), paths, strict=True):
        figure.savefig(path, dpi=100)
        plt.close(figure)
    return paths
