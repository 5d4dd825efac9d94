"""Pages of measured sets at length: a study step by step with its pictures, beside fits
of models that were set up by hand and published values.

    python -m problems.measured.pages [NAME ...] [--data=FOLDER]

NAME is one of `PAGES`; all without one. The process ends with an error where a page
does not reach what was reached before.
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
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

SHOWN = 6  # candidates per diagnosis on a page

Errors = dict[str, list[float]]  # further errors per step, by name


@dataclass(frozen=True)
class Page:
    """A study that is told at length.

    Attributes:
        set: The set, of `SETS`.
        title: Of the page.
        text: Said of the study.
        scale: Errors are shown times this number, in ``unit``.
        before: Makes what stands before the study.
        test: The error of a fit, in place of that on the set's tests, with its name.
        max_steps: Of the study.
        reached: The error that the study must come to on the tests.
    """

    set: str
    title: str
    text: str
    scale: float = 1.0
    unit: str = ""
    before: Callable[[], str] = str
    test: tuple[str, Callable[[ph.Fit], float]] | None = None
    max_steps: int = 4
    reached: float = np.inf


# --- EMPS: the published values

WHOLE, SHORT = "whole record", "windows of 1 s"
WITHIN = 0.05  # relative difference from the published values that is asked for
EMPS_PAGE = f"""
    # EMPS linear drive

    {{{{ values }}}}

    Positions at every 10th sample; dry friction turns over at
    {1e3 * machines.EMPS_TURNOVER:g} mm/s.

    Free-run error (mm) on the record with force pulses, starting states estimated from
    what is compared:

    {{{{ runs }}}}

    At {{{{ noise }}}} mm the residuals are errors of the model: a sample lies
    {{{{ scatter }}}} mm off the line through its neighbours. The standard errors come
    from {{{{ source }}}}; the two columns of fits lie up to {{{{ distance }}}} of them
    apart. Over windows the fit to the whole record is {{{{ better }}}} than the
    published values.

    {{{{ fit }}}}
    """


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
    for name, value in published.items():
        off, off_short = (fit.values[name] / value - 1 for fit in (whole, short))
        rows.append(
            {
                "parameter": f"{name} ({machines.EMPS_UNITS[name]})",
                "fitted, whole record": f"{values[name]:.3f} "
                f"+- {whole.std_errors[name]:.3f}",
                "published": f"{value:.3f}",
                "difference": f"{off:+.1%}",
                f"within {WITHIN:.0%}": "yes" if abs(off) <= WITHIN else "no",
                SHORT: f"{short.values[name]:.3f} ({off_short:+.1%})",
            }
        )
    shifts = [
        abs(values[name] - short.values[name]) / whole.std_errors[name]
        for name in values
    ]
    (run,) = machines.emps(window=None).trajectories
    scatter = 1e3 * np.sqrt(np.mean((np.diff(run.x[:, 0], 2) / 2) ** 2))
    is_better = errors[SHORT][0] < errors[SHORT][1]
    runs = [[label, *(f"{e:.3f}" for e in pair)] for label, pair in errors.items()]
    text = markdown.page(
        EMPS_PAGE,
        values=markdown.table(rows),
        runs=markdown.lines(["free run over", "fitted", "published values"], runs),
        noise=f"{1e3 * whole.noise['q']:.1f}",
        scatter=f"{scatter:.1g}",
        source=whole.std_error_source,
        distance=markdown.number(max(shifts)),
        better="better" if is_better else "no better",
        fit="\n".join(markdown.block(str(whole))),
    )
    write("emps.md", text)
    assert errors[WHOLE][0] <= errors[WHOLE][1], f"free run over the test: {errors}"
    assert all(row[f"within {WITHIN:.0%}"] == "yes" for row in rows), rows


# --- Silverbox: three models by hand

# Plain least squares of simulations on 4096 samples, set up by hand for these data:
# errors (mV) on the arrow of the same three models.
BOX_BY_HAND = (14.85, 13.84, 1.00)
ARROW_REACHED = 1.0  # mV, what the last model must come to on the arrow


def arrow_error(fit: ph.Fit) -> float:
    """Error (mV) of one free run over the arrow."""
    return machines.box_error(fit, *machines.ARROW)


def box_models() -> str:
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
        rows.append(
            {
                "model": f"+ {effect}" if effect else "linear spring",
                "held-out multisine": f"{held_out:.2f}",
                "arrow": f"{arrow[-1]:.2f}",
                "seconds of the fit": f"{fit.seconds:.0f}",
            }
        )
        print(rows[-1], flush=True)
    assert arrow[-1] <= ARROW_REACHED, f"arrow: {arrow}, expected {ARROW_REACHED} mV"
    assert np.all(np.diff(arrow) <= 0), f"a step raised the error: {arrow}"
    n_samples = machines.BOX_FIT[1] - machines.BOX_FIT[0]
    return markdown.page(
        """
        Fitted to {{ n_samples }} samples of the multisines; errors are root mean
        squares of one free run, in mV, the starting state estimated from the first
        {{ settling }} samples.

        {{ models }}

        Reference, plain least squares on 4096 samples, arrow: {{ by_hand }} mV for the
        same three models.

        {{ fit }}
        """,
        n_samples=n_samples,
        settling=machines.SETTLING,
        models=markdown.table(rows),
        by_hand=", ".join(f"{error:.2f}" for error in BOX_BY_HAND),
        fit="\n".join(markdown.block(str(fit))),
    )


# --- cascaded tanks: the published errors

# Test errors (V, rmse) that are published for this benchmark, by kind of model; the
# figures are those that come with the data.
TANKS_PUBLISHED = {
    "linear": (0.75,),
    "Volterra": (0.54,),
    "neural": (0.33, 0.40),
    "grey box with overflow": (0.18,),
}
N_FIRST = 50  # samples from which the starting state of the test is estimated
TANKS_REACHED = 0.33  # V, what the model with overflows must come to on the test


def tanks_models() -> str:
    """Errors of the textbook's model and of the model with overflows."""
    data = storages.tanks()
    (test,) = storages.tanks("Val", is_censored=False).trajectories
    rows = []
    for name, model in (
        ("textbook", storages.textbook_tanks()),
        ("with overflows", storages.tanks_model()),
    ):
        fit = ph.identify(model, data)
        first, whole = (
            storages.tanks_error(fit, test, n) for n in (N_FIRST, test.n_samples)
        )
        rows.append(
            {
                "model": name,
                "fit": f"{fit.noise['h2']:.3f}",
                "test, start from the first samples": f"{first:.3f}",
                "test, start from the whole record": f"{whole:.3f}",
            }
        )
        print(rows[-1], fit, f"{fit.seconds:.0f} s", sep="\n", flush=True)
    assert first <= TANKS_REACHED, f"test: {first:.3f} V, expected {TANKS_REACHED} V"
    best = min(min(errors) for errors in TANKS_PUBLISHED.values())
    published = [
        f"{kind} {' to '.join(f'{error:.2f}' for error in errors)}"
        for kind, errors in TANKS_PUBLISHED.items()
    ]
    return markdown.page(
        """
        Root mean square errors in V. Fit: samples at {{ full }} V are missing. Test:
        every sample, one free run cut at {{ full }} V, its starting state estimated
        from the first {{ n_first }} samples or from the whole record.

        {{ models }}

        Published test rmse: {{ published }} V.

        The last model starts from rough values. Its structure was chosen among some
        twenty on the last {{ judging }} of the fit record; two of its parts are
        empirical, the constant loss q0 and the level h0 at which the lower outflow
        ends. The published {{ best }} V is {{ reached }}.

        {{ fit }}
        """,
        full=f"{storages.FULL:g}",
        n_first=N_FIRST,
        models=markdown.table(rows),
        published=", ".join(published),
        judging=f"{1 - storages.TANKS_SHARE:.0%}",
        best=f"{best:.2f}",
        reached="reached" if first <= best else "not reached",
        fit="\n".join(markdown.block(str(fit))),
    )


# --- the studies

# Errors of fits by hand, to compare: on the two tests of the hoop (V), on the same
# windows of the drone's steps (degrees).
HOOP_BY_HAND = "1 and 0.96 V with linear drag; 0.283 and 0.267 V with quadratic drag"
DRONE_BY_HAND = """8.57 degrees with the base model, 2.85 degrees with a thrust offset
    or a thrust of u squared, 2.46 degrees with a lag of the motor of some 0.1 s, 1.17
    degrees with dry friction"""

PAGES = {
    "emps_story": Page(
        "EMPS",
        "EMPS linear drive, told step by step",
        """The base model is a mass with viscous friction. Fitted are windows of 1 s of
        the record without pulses, windows of 1 s of the record with pulses judge, both
        thinned to every 10th sample, 100 Hz. On these the published values (mass,
        viscous and Coulomb friction, offset) leave {{ published }} mm.""",
        scale=1e3,
        unit="mm",
    ),
    "ball_and_hoop": Page(
        "ball and hoop",
        "Ball and hoop drive",
        f"""The base model is dy/dt = -r y + b u. The first {machines.HOOP_SHARE:.0%} of
        the random steps are fitted, the last {1 - machines.HOOP_SHARE:.0%} judge, the
        two test files are only looked at. Least squares by hand, to compare, on the two
        test files: {HOOP_BY_HAND}; worse with Coulomb friction added.""",
        reached=0.30,
    ),
    "quarter_drone": Page(
        "quarter drone",
        "Quarter-drone arm",
        f"""The base model is a pendulum with damping and a thrust in proportion to the
        command. Fitted are windows of {machines.DRONE_WINDOW:g} s of the steps, those
        of the multisine judge, the swept sine is only looked at; all are thinned to
        every {machines.DRONE_THIN}th sample, 20 Hz. Simulations fitted by hand to the
        same windows of the steps: {DRONE_BY_HAND}.""",
        scale=float(np.rad2deg(1.0)),
        unit="degrees",
    ),
    "silverbox": Page(
        "Silverbox",
        "Silverbox",
        f"""The base model is a mass on a linear spring with linear loss, driven by the
        input. The study is given {machines.N_BOX_STORY} samples of a multisine, and
        {machines.N_BOX_STORY} of another one to judge by; the arrow is only looked
        at.""",
        scale=1e3,
        unit="mV",
        before=box_models,
        test=("arrow", arrow_error),
        max_steps=3,
    ),
    "cascaded_tanks": Page(
        "cascaded tanks",
        "Cascaded tanks",
        f"""The base model is the textbook's: two square-root outflows. The first
        {storages.TANKS_SHARE:.0%} of the fit record are fitted, the last
        {1 - storages.TANKS_SHARE:.0%} judge; the test is only looked at, without its
        samples at {storages.FULL:g} V and its starting state estimated from all of
        it.""",
        before=tanks_models,
    ),
}

STORY = """
    # {{ title }}

    {{ before }}

    ## What the diagnosis finds without hints

    {{ text }}

    Added: {{ added }}.
    {%- if n_further > 0 %} On its own the loop takes {{ n_own }}
    step{{ "" if n_own == 1 else "s" }} and then stops: {{ stopped }}. The first
    candidates of the table lead {{ n_further }} further.{% endif %} The last verdict is
    "{{ verdict }}".

    {{ steps }}

    ![free-run error per step](measured/{{ name }}_history.png)

    ![missing force of the base model](measured/{{ name }}_missing_force.png)

    {% for chapter in chapters %}

    ### {{ chapter.title }}

    {{ chapter.where }}

    Verdict: {{ chapter.verdict }}. {{ chapter.reason }}.

    {{ chapter.candidates }}

    {% endfor %}

    ### The last model

    {{ fit }}
    """


def story_page(name: str, page: Page, story: Story, **numbers: object) -> str:
    """The story as Markdown; its pictures go to results/measured."""
    picture = name.removesuffix("_story")
    save_pictures(story, picture)
    unit = page.unit or story.study.unit
    study = story.study
    return markdown.page(
        STORY,
        title=page.title,
        before=page.before(),
        text=markdown.page(page.text, **numbers),
        added=", ".join(str(effect) for effect in study.added) or "nothing",
        n_own=story.n_own,
        n_further=len(study.steps) - 1 - story.n_own,
        stopped=story.stopped,
        verdict=story.diagnoses[-1].verdict,
        steps=_steps(story, page.scale, unit),
        name=picture,
        chapters=[
            _chapter(step, diagnosis, page.scale, unit)
            for step, diagnosis in enumerate(story.diagnoses)
        ],
        fit="\n".join(markdown.block(str(study.fit))),
    )


def _steps(story: Story, scale: float, unit: str) -> str:
    """The table of the steps with their errors."""
    errors = ("training error", "held-out error", "noise floor", *story.tests)
    after = "seconds of the diagnosis after it"
    header = ["step", "effect", "how chosen", *(f"{e} ({unit})" for e in errors), after]
    seconds = {
        id(diagnosis.fit): f"{taken:.0f}"
        for diagnosis, taken in zip(story.diagnoses, story.seconds, strict=True)
    }
    rows = []
    history = story.study.history.itertuples(index=False)
    for step, (_, effect, *errors_of_step, _) in enumerate(history):
        shown = [f"{scale * error:.3g}" for error in errors_of_step]
        shown += [f"{of_test[step]:.3g}" for of_test in story.tests.values()]
        taken = seconds.get(id(story.study.steps[step].fit), "")
        rows.append([step, effect, story.how[step], *shown, taken])
    return markdown.lines(header, rows)


def _chapter(
    step: int, diagnosis: ph.Diagnosis, scale: float, unit: str
) -> dict[str, str]:
    """What one diagnosis says."""
    is_missing = diagnosis.verdict != ph.Verdict.NOTHING_MISSING
    rows = []
    for c in diagnosis.ranking[:SHOWN]:
        # Empty where it was not re-fitted.
        error = "" if np.isnan(c.std_error) else f" +- {c.std_error:.2g}"
        held_out = scale * c.held_out_rmse
        rows.append(
            {
                "effect": c.effect.name,
                "equation": c.effect.equation,
                "coefficient": f"{c.coefficient:.4g}{error}",
                "evidence": evidence_words(c),
                f"held-out error ({unit})": ""
                if np.isnan(held_out)
                else f"{held_out:.4g}",
                "confusable with": ", ".join(c.confusable_with),
            }
        )
    return {
        "title": f"After step {step}" if step else "The base model",
        "where": " ".join(diagnosis.sentences) if is_missing else "",
        "verdict": diagnosis.verdict,
        "reason": diagnosis.reason,
        "candidates": markdown.table(rows),
    }


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
    chosen = SETS[page.set]
    records = chosen.records()
    study = ph.Study(chosen.model(), *records, progress=_say)
    story = told(study, page.max_steps, goes_on=True)
    steps = story.study.steps
    tests: Errors = {
        test: [page.scale * ph.compare(step.fit, data).rmse for step in steps]
        for test, data in chosen.tests().items()
    }
    if page.test is not None:
        test, error_of = page.test
        tests[test] = [error_of(step.fit) for step in steps]
    story.tests = tests
    print(study.history.to_string(index=False), tests, sep="\n", flush=True)
    numbers = {}
    if name == "emps_story":
        error = machines.emps_error(machines.EMPS_PUBLISHED, records[1])
        numbers["published"] = f"{error:.3f}"
    write(f"{name}.md", story_page(name, page, story, **numbers))
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
