"""Pages of measured sets at length: a study step by step with its pictures, beside fits
of models that were set up by hand and published values.

    python -m problems.measured.long_stories [NAME ...] [--data=FOLDER]

NAME is "emps" or one of `PAGES`; all without one. The process ends with an error where
a page does not reach what was reached before.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from phsi_opt.study.answers import evidence_words
from problems.measured import machines, storages
from problems.measured.sets import SETS, with_effects
from problems.measured.stories import Story, told
from problems.tools import markdown
from problems.tools.command_line import chosen
from problems.tools.data_paths import folder, is_present
from problems.tools.pages import render
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

SHOWN = 6  # candidates per diagnosis on a page

Values = dict[str, object]  # of a template

# --- EMPS: the published values

WHOLE, SHORT = "whole record", "windows of 1 s"
WITHIN = 0.05  # relative difference from the published values that is asked for


def write_emps() -> None:
    """Values and free-run errors of fits to the whole record and to its windows, beside
    the published ones.
    """
    published = machines.EMPS_PUBLISHED
    lengths = {WHOLE: None, SHORT: machines.EMPS_WINDOW}
    fits = {}
    for label, window in lengths.items():
        fits[label] = ph.identify(machines.emps_model(), machines.emps(window=window))
        print(label, fits[label], f"{fits[label].seconds:.0f} s", sep="\n", flush=True)
    whole, short = fits[WHOLE], fits[SHORT]
    values = {name: whole.values[name] for name in published}
    errors = {}
    for label in (SHORT, WHOLE):
        test = machines.emps("test", lengths[label])
        errors[label] = [machines.emps_error(v, test) for v in (values, published)]
    rows = []
    distances = []
    for name, value in published.items():
        std_error = whole.std_errors[name]
        distances.append(abs(values[name] - short.values[name]) / std_error)
        off, off_short = (fit.values[name] / value - 1 for fit in (whole, short))
        rows.append(
            {
                "parameter": f"{name} ({machines.EMPS_UNITS[name]})",
                f"fitted, {WHOLE}": f"{values[name]:.3f} +- {std_error:.3f}",
                "published": f"{value:.3f}",
                "difference": f"{off:+.1%}",
                f"within {WITHIN:.0%}": "yes" if abs(off) <= WITHIN else "no",
                SHORT: f"{short.values[name]:.3f} ({off_short:+.1%})",
            }
        )
    runs = []
    for label, (fitted, of_published) in errors.items():
        shown = {"fitted": f"{fitted:.3f}", "published values": f"{of_published:.3f}"}
        runs.append({"free run over": label, **shown})
    (run,) = machines.emps(window=None).trajectories
    text = render(
        "measured/pages/emps.md",
        values=rows,
        turnover=machines.EMPS_TURNOVER,
        runs=runs,
        noise=1e3 * whole.noise["q"],
        scatter=1e3 * np.sqrt(np.mean((np.diff(run.x[:, 0], 2) / 2) ** 2)),
        distance=max(distances),
        is_better=errors[SHORT][0] < errors[SHORT][1],
        fit=whole,
    )
    write("emps.md", text)
    assert errors[WHOLE][0] <= errors[WHOLE][1], f"free run over the test: {errors}"
    assert all(row[f"within {WITHIN:.0%}"] == "yes" for row in rows), rows


# --- what stands before a study

ARROW_REACHED = 1.0  # mV, what the last model must come to on the arrow
N_FIRST = 50  # samples from which the starting state of the tanks' test is estimated
TANKS_REACHED = 0.33  # V, what the model with overflows must come to on the test
TANKS_PUBLISHED = 0.18  # V, the least


def arrow_error(fit: ph.Fit) -> float:
    """Error (mV) of one free run of the Silverbox over the arrow."""
    return machines.box_error(fit, *machines.ARROW)


def box_models() -> Values:
    """Errors of the linear spring, with a constant force, with a cubic spring too."""
    train = machines.box(*machines.BOX_FIT)
    model: ph.Model = machines.box_model()
    rows = []
    arrow: list[float] = []
    for effect in ("", "constant force", "cubic stiffness"):
        model = with_effects(model, (f"{effect} on p",) if effect else ())
        fit = ph.identify(model, train)
        model = model.with_values(fit.values)
        held_out = machines.box_error(fit, *machines.BOX_HELD_OUT)
        arrow.append(arrow_error(fit))
        row = {"model": f"+ {effect}" if effect else "linear spring"}
        row |= {"held-out multisine": f"{held_out:.2f}", "arrow": f"{arrow[-1]:.2f}"}
        rows.append({**row, "seconds of the fit": f"{fit.seconds:.0f}"})
        print(rows[-1], flush=True)
    assert arrow[-1] <= ARROW_REACHED, f"arrow: {arrow}, expected {ARROW_REACHED} mV"
    assert np.all(np.diff(arrow) <= 0), f"a step raised the error: {arrow}"
    n_samples = machines.BOX_FIT[1] - machines.BOX_FIT[0]
    return {"n_samples": n_samples, "models": rows, "fit": fit}


def tanks_models() -> Values:
    """Errors of the textbook's model and of the model with overflows."""
    data = storages.tanks()
    (test,) = storages.tanks("Val", is_censored=False).trajectories
    rows = []
    for name, model in (
        ("textbook", storages.textbook_tanks()),
        ("with overflows", storages.tanks_model()),
    ):
        fit = ph.identify(model, data)
        first = storages.tanks_error(fit, test, N_FIRST)
        whole = storages.tanks_error(fit, test, test.n_samples)
        row = {"model": name, "fit": f"{fit.noise['h2']:.3f}"}
        row["test, start from the first samples"] = f"{first:.3f}"
        row["test, start from the whole record"] = f"{whole:.3f}"
        rows.append(row)
        print(row, fit, f"{fit.seconds:.0f} s", sep="\n", flush=True)
    assert first <= TANKS_REACHED, f"test: {first:.3f} V, expected {TANKS_REACHED} V"
    shown: Values = {"models": rows, "n_first": N_FIRST, "fit": fit}
    return shown | {"error": first, "published": TANKS_PUBLISHED}


def emps_published() -> Values:
    """The error that the published values leave on the record that judges."""
    test = machines.emps("test")
    return {"published": machines.emps_error(machines.EMPS_PUBLISHED, test)}


# --- the studies


@dataclass(frozen=True)
class Page:
    """A study that is told at length; its words are in the template of its name.

    Attributes:
        set: The set, of `SETS`.
        scale: Errors are shown times this number, in ``unit``.
        values: Makes further values of the template.
        test: The error of a fit beside those on the set's tests, with its name.
        max_steps: Of the study.
        reached: The error that the study must come to on the tests.
    """

    set: str
    scale: float = 1.0
    unit: str = ""
    values: Callable[[], Values] = dict
    test: tuple[str, Callable[[ph.Fit], float]] | None = None
    max_steps: int = 4
    reached: float = np.inf


ON_ARROW = ("arrow", arrow_error)
PAGES = {
    "emps_story": Page("EMPS", 1e3, "mm", emps_published),
    "ball_and_hoop": Page("ball and hoop", reached=0.30),
    "quarter_drone": Page("quarter drone", float(np.rad2deg(1.0)), "degrees"),
    "silverbox": Page("Silverbox", 1e3, "mV", box_models, ON_ARROW, max_steps=3),
    "cascaded_tanks": Page("cascaded tanks", values=tanks_models),
}


def story_page(name: str, page: Page, story: Story) -> str:
    """The story as Markdown; its pictures go to results/measured."""
    study = story.study
    unit = page.unit or study.unit
    picture = name.removesuffix("_story")
    save_pictures(story, picture)
    chapters = []
    for diagnosis in story.diagnoses:
        is_missing = diagnosis.verdict != ph.Verdict.NOTHING_MISSING
        where = " ".join(diagnosis.sentences) if is_missing else ""
        chapters.append((diagnosis, where, _candidates(diagnosis, page.scale, unit)))
    return render(
        f"measured/pages/{name}.md",
        machines=machines,
        storages=storages,
        story=story,
        added=list(map(str, study.added)),
        n_further=len(study.steps) - 1 - story.n_own,
        steps=_steps(story, page.scale, unit),
        name=picture,
        chapters=chapters,
        **page.values(),
    )


def _steps(story: Story, scale: float, unit: str) -> str:
    """The table of the steps with their errors."""
    errors = ("training error", "held-out error", "noise floor", *story.tests)
    after = "seconds of the diagnosis after it"
    header = ["step", "effect", "how chosen", *(f"{e} ({unit})" for e in errors), after]
    seconds = dict(zip(map(_fit_of, story.diagnoses), story.seconds, strict=True))
    rows = []
    history = story.study.history.itertuples(index=False)
    for step, (_, effect, *errors_of_step, _) in enumerate(history):
        shown = [f"{scale * error:.3g}" for error in errors_of_step]
        shown += [f"{of_test[step]:.3g}" for of_test in story.tests.values()]
        taken = seconds.get(id(story.study.steps[step].fit))
        last = "" if taken is None else f"{taken:.0f}"
        rows.append([step, effect, story.how[step], *shown, last])
    return markdown.lines(header, rows)


def _fit_of(diagnosis: ph.Diagnosis) -> int:
    return id(diagnosis.fit)


def _candidates(
    diagnosis: ph.Diagnosis, scale: float, unit: str
) -> list[dict[str, str]]:
    """The first candidates; numbers are empty where they were not re-fitted."""
    rows = []
    for c in diagnosis.ranking[:SHOWN]:
        error = "" if np.isnan(c.std_error) else f" +- {c.std_error:.2g}"
        held_out = f"{scale * c.held_out_rmse:.4g}"
        rows.append(
            {
                "effect": c.effect.name,
                "equation": c.effect.equation,
                "coefficient": f"{c.coefficient:.4g}{error}",
                "evidence": evidence_words(c),
                f"held-out error ({unit})": held_out.replace("nan", ""),
                "confusable with": ", ".join(c.confusable_with),
            }
        )
    return rows


def save_pictures(story: Story, name: str) -> None:
    """The missing force of the base model and the error per step, as PNG."""
    where = story.diagnoses[0].figure()
    save(where, f"measured/{name}_missing_force.png", dpi=100)
    width = max(6.0, 2.2 * len(story.study.steps))
    history, ax = plt.subplots(figsize=(width, 3.8), layout="constrained")
    story.study.plot_history(ax)
    save(history, f"measured/{name}_history.png", dpi=100)


def tell(name: str) -> None:
    """Tell a set at length, and write its page."""
    page = PAGES[name]
    chosen_set = SETS[page.set]
    study = ph.Study(chosen_set.model(), *chosen_set.records(), progress=_say)
    story = told(study, page.max_steps, goes_on=True)
    tests = {}
    for test, data in chosen_set.tests().items():
        errors = [ph.compare(step.fit, data).rmse for step in study.steps]
        tests[test] = [page.scale * error for error in errors]
    if page.test is not None:
        test, error_of = page.test
        tests[test] = [error_of(step.fit) for step in study.steps]
    story.tests = tests
    print(study.history.to_string(index=False), tests, sep="\n", flush=True)
    write(f"{name}.md", story_page(name, page, story))
    for test, errors in tests.items():
        is_reached = errors[-1] <= min(errors[0], page.reached)
        assert is_reached, f"{test}: {errors}, expected at most {page.reached}"


def _say(line: str) -> None:
    print(f"... {line}", flush=True)


def main(names: list[str]) -> None:
    """Write the pages of these names; all where none is given."""
    for name in names or ["emps", *PAGES]:
        set_name = "EMPS" if name == "emps" else PAGES[name].set
        if not is_present(folder(SETS[set_name].folder)):
            continue
        if name == "emps":
            write_emps()
        else:
            tell(name)


if __name__ == "__main__":
    main(chosen())
