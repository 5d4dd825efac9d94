"""The pages results/hidden_effects.md, with its figure, and results/field_machines.md.

Limits and sizes in their texts are the constants of the battery; results are computed
from the tables of all rows that have been run.
"""

from collections.abc import Iterable, Mapping

import pandas as pd
from scipy.stats import binomtest

from problems.battery import experiments as field
from problems.battery import store
from problems.battery.ask import DETECTED, MOST_STEPS
from problems.battery.draw import (
    FAINTEST,
    FIELD_NOISE_LEVELS,
    KINDS,
    LOUDEST,
    NOISE_LEVELS,
    PATIENCE,
    QUIETEST,
    ROWS,
)
from problems.battery.effects import EFFECTS
from problems.battery.masses import OF_SIGNAL
from problems.battery.records import FIELD, HIDDEN
from problems.battery.score import (
    TARGETS,
    Record,
    by_kind,
    by_noise,
    confusions,
    disagreements,
    preparations,
    scored,
    share_of,
    summary_row,
    target_of,
    wrong_answers,
)
from problems.tools import markdown
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

Tables = Mapping[str, pd.DataFrame]  # cases by row
FAILURES = """
    {% if failures %}

    ## Cases that failed

    {{ failures }}

    {% endif %}
    """

# --- hidden effects

# Seeds from here on were not looked at while the diagnosis became what it is.
FIRST_NEW = 1000
# Of effects from outside seeds 1000 to 1049 and 3000 to 3049 were seen.
FIRST_NEW_OUTSIDE = 3100
LOUDNESS = [0, 5, 10, 40]  # error before over noise floor, ends of the groups

HIDDEN_PAGE = f"""
    # Hidden effects

    Machines with one or two masses are simulated with an effect
    (`problems/battery/effects.py`, without phsi_opt) and given to `identify` and
    `diagnose` with a model that lacks it. Parameters, starts, input, measured channels
    and the effect's size are drawn per case; the size is such that the best re-fit of
    the model has a free-run error of {QUIETEST:g} to {LOUDEST:g} times the noise floor
    (log-uniform; at {max(NOISE_LEVELS):.0%} noise up to
    {OF_SIGNAL / max(NOISE_LEVELS):g} times: the error stays below {OF_SIGNAL:g} of the
    signal's own standard deviation; an effect that cannot physically be so large has
    the largest size allowed, and where {PATIENCE} experiments in a row did not show
    {QUIETEST:g} times the floor, {FAINTEST:g} times was enough).

    Right: the verdict is 'missing: named', and the first effect has the right name and
    acts in the right equation. A tie counts as right only if the truth is listed in
    confusable_with and the effect named fits the noise-free data to within {DETECTED}
    noise variances in total, the size that a test at 1 % would detect ('misfit').
    Intervals in brackets: 95 %, Wilson. Coefficient covered: its 95 % interval holds
    the truth, where the catalogue's coefficient counts the same thing. Held-out: error
    with the first effect over the noise that is in the held-out samples, of the cases
    that are right. Failed: an error was raised; counted as wrong. An effect from
    outside the catalogue that one of its effects imitates as closely as a true tie is
    not counted.

    {{% if by_commit is defined %}}

    {{% if by_group is defined %}}

    ## One hidden effect

    Groups of effects, by noise:

    {{{{ by_group }}}}

    {{{{ one }}}}

    ![share of cases that are right](hidden_effects.png)

    By setting:

    {{{{ by_setting }}}}

    {{% endif %}}

    {{% if others %}}

    ## Nothing, two effects, effects from outside, sensors, tanks

    {{{{ others }}}}

    By noise and by effect:

    {{{{ by_noise }}}}

    {{% endif %}}

    {{% if new %}}

    ## New seeds

    Seeds from {FIRST_NEW} on (of effects from outside {FIRST_NEW_OUTSIDE}), not
    looked at before, beside the first ones, above, which were examined while the
    diagnosis was developed. Named: the right effect
    comes first. With ties: or a declared, true tie of it.

    {{{{ new }}}}

    {{% endif %}}

    ## What came instead

    {{{{ instead }}}}

    {FAILURES}

    ## By the code

    The battery takes longer than the code stays as it is. Lines are of different
    mixtures of rows.

    {{{{ by_commit }}}}

    {{% endif %}}
    """


def write_hidden() -> None:
    """Write the page of hidden effects and its figure."""
    found = {}
    new = {}
    for name in ROWS:
        path = store.path_of(HIDDEN, name)
        if path.exists():
            rows = store.table(path, HIDDEN)
            is_new = of_new_seeds(name, rows)
            found[name], new[name] = rows[~is_new], rows[is_new]
    write("hidden_effects.md", hidden_page(found, new))
    if any(ROWS[name].kind == "one" for name in found):
        figure({name: t for name, t in found.items() if ROWS[name].kind == "one"})


def of_new_seeds(name: str, rows: pd.DataFrame) -> "pd.Series[bool]":
    """Which cases of a row have seeds that nobody looked at before."""
    return rows["seed"].ge(FIRST_NEW_OUTSIDE if name == "outside" else FIRST_NEW)


def hidden_page(found: Tables, new: Tables) -> str:
    """The page as Markdown.

    Args:
        found: Cases by row.
        new: Those of new seeds.
    """
    if not found:
        return markdown.page(HIDDEN_PAGE)
    one = {name: rows for name, rows in found.items() if ROWS[name].kind == "one"}
    others = {name: rows for name, rows in found.items() if name not in one}
    joined = pd.concat(found.values(), ignore_index=True)
    wrong = confusions(joined)
    shown = {
        "others": _by_row(others),
        "by_noise": _by_noise_and_effect(others),
        "new": _new_seeds(found, new),
        "instead": markdown.table(wrong.round(1)) if len(wrong) else "Nothing.",
        "failures": _failures(joined, "row"),
        "by_commit": _by_commit(joined, pd.concat(new.values(), ignore_index=True)),
    }
    if one:
        all_of_one = pd.concat(one.values(), ignore_index=True)
        shown["one"] = _by_row(one)
        shown["by_group"] = _by_group(all_of_one)
        shown["by_setting"] = _by_setting(all_of_one)
    return markdown.page(HIDDEN_PAGE, **shown)


def _by_row(found: Tables) -> str:
    return markdown.table(
        [
            summary_row(name.replace("_", " "), rows, target_of(ROWS[name]))
            for name, rows in found.items()
        ]
    )


def _by_group(rows: pd.DataFrame) -> str:
    titles = {"force": "outside forces", "input": "outside forces"}
    names = rows["row"].map(lambda row: EFFECTS[ROWS[row].effects[0]].group)
    groups = names.replace(titles)
    records = []
    for group in dict.fromkeys(groups):
        for noise in NOISE_LEVELS:
            part = rows[groups.eq(group) & rows["noise"].eq(noise)]
            if len(part):
                label = f"{group}, {noise:.0%}"
                records.append(summary_row(label, part, TARGETS[noise]))
    return markdown.table(records)


def _by_setting(rows: pd.DataFrame) -> str:
    kept = scored(rows)
    records = []
    for key in ("masses", "measured", "input"):
        for value, part in kept.groupby(key):
            records.append(_counted("setting", f"{key}: {value}", part))
    loudness = pd.cut(kept["base_ratio"], LOUDNESS)
    for between, part in kept.groupby(loudness, observed=True):
        records.append(_counted("setting", f"error before {between}", part))
    return markdown.table(records)


def _by_noise_and_effect(found: Tables) -> str:
    records = []
    for name, rows in found.items():
        for key in ("noise", "truth"):
            for value, part in scored(rows).groupby(key):
                label = f"{name.replace('_', ' ')}, {key} {value}"
                records.append(_counted("row", label, part))
    return markdown.table(records)


def _counted(head: str, label: str, kept: pd.DataFrame) -> Record:
    return {head: label, "cases": len(kept), "right": share_of(kept["good"])}


def _shares(kept: pd.DataFrame) -> tuple[str, str]:
    """Of the right name, and of that or a true tie."""
    return share_of(kept["right"].astype(bool)), share_of(kept["good"])


def _new_seeds(found: Tables, new: Tables) -> str:
    """Rates on new seeds beside those on the first ones, names alone and with ties."""
    if not any(len(rows) for rows in new.values()):
        return ""
    groups: dict[str, list[str]] = {}
    for name in found:
        row = ROWS[name]
        of_one = f"one effect, noise {100 * row.noise[0]:g} %"
        label = of_one if row.kind == "one" else name.replace("_", " ")
        groups.setdefault(label, []).append(name)
    records = []
    for label, names in groups.items():
        record: Record = {"rows": label}
        for when, tables in (("first seeds", found), ("new seeds", new)):
            rows = [tables[name] for name in names if len(tables[name])]
            if rows:
                kept = scored(pd.concat(rows, ignore_index=True))
                named, with_ties = _shares(kept)
                record[f"{when}: n"] = str(len(kept))
                record[f"{when}: named"] = named
                record[f"{when}: with ties"] = with_ties
        records.append(record)
    return markdown.table(records)


def _by_commit(found: pd.DataFrame, new: pd.DataFrame) -> str:
    """Rates by the code that the cases were examined on."""
    everything = pd.concat([found, new], ignore_index=True)
    n_new = new["commit"].value_counts()
    records = []
    for commit, count in everything["commit"].value_counts().items():
        kept = scored(everything[everything["commit"].eq(str(commit))])
        counts = {"cases": count, "of new seeds": n_new.get(commit, 0)}
        named, with_ties = _shares(kept)
        shares = {"named": named, "with ties": with_ties}
        records.append({"commit": commit, **counts, **shares})
    return markdown.table(records)


def _failures(rows: pd.DataFrame, row: str) -> str:
    failed = rows[rows["outcome"].ne("examined")]
    counts = (failed[row] + ": " + failed["outcome"]).value_counts()
    return "\n".join(f"- {count} x {what}" for what, count in counts.items())


COLOURS = dict(zip(NOISE_LEVELS, ("#0072b2", "#009e73", "#d55e00"), strict=True))
HIGHEST_LEFT_END = 80.0  # %, of the axis


def figure(found: Tables) -> None:
    """Share of cases that are right, per effect and noise, with 95 % intervals
    (Wilson).

    ``found``: the cases of the rows with one hidden effect.
    """
    effects = list(dict.fromkeys(ROWS[name].effects[0] for name in found))
    size = (8, 1.2 + 0.34 * len(effects))
    fig, ax = plt.subplots(figsize=size, layout="constrained")
    lowest = HIGHEST_LEFT_END
    for name, cases in found.items():
        noise = ROWS[name].noise[0]
        kept = scored(cases)
        if len(kept):
            test = binomtest(int(kept["good"].sum()), len(kept))
            ends = test.proportion_ci(method="wilson")
            share = test.statistic
            low, high = max(share - ends.low, 0.0), max(ends.high - share, 0.0)
            shift = 0.22 * (NOISE_LEVELS.index(noise) - 1)
            place = effects.index(ROWS[name].effects[0]) + shift
            bars = [[100 * low], [100 * high]]
            colour = COLOURS[noise]
            middle = 100 * share
            ax.errorbar(middle, place, xerr=bars, fmt="o", ms=4, lw=1, color=colour)
            lowest = min(lowest, 100 * ends.low)
    for noise, colour in COLOURS.items():
        ax.plot([], [], "o", ms=4, color=colour, label=f"{noise:.0%} noise")
    targets = sorted(set(TARGETS.values()), reverse=True)
    for target, line in zip(targets, ("-", ":"), strict=True):
        label = f"target {100 * target:g} %"
        ax.axvline(100 * target, color="0.5", lw=1, ls=line, label=label)
    ax.set(
        yticks=range(len(effects)),
        yticklabels=effects,
        xlim=(10 * (lowest // 10), 101),
        ylim=(-0.7, len(effects) - 0.3),
        xlabel="cases with the right effect in the right equation (%), 95 % intervals",
    )
    ax.invert_yaxis()
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    save(fig, "hidden_effects.png", dpi=150)


# --- machines of the field

FIRST_OF_PAGE = 34_000  # seed; those below were seen while developing
LEVELS = markdown.enumerated(f"{100 * noise:g}" for noise in FIELD_NOISE_LEVELS)

FIELD_PAGE = f"""
    # Machines of the field

    Machines that an engineer meets are simulated by SciPy
    (`problems/battery/field_machines.py`, without phsi_opt), an effect hidden, and
    given to a study with a model that lacks it. Every case has
    {field.MODEL_ERROR:.0%} of model error, or what its kind says: a
    random force, or a smooth random function of the states, whose root mean square is
    that share of the motion's own force (of those where nothing is missing, a third
    have noise that lasts instead). Noise is {LEVELS} % of a channel's root mean square.
    The effect's size is such that the best re-fit of the model has a free-run error of
    {field.QUIETEST:g} to {field.LOUDEST:g} times the noise, and
    {field.ABOVE_MODEL_ERROR:g} times what the model error does to the runs, which at
    little noise asks for more; under control and over the top it is drawn. Models of
    circuits, heated bodies and chambers say what kind of thing they are
    (`kind="electrical"`), as a user would.

    A study goes on by itself for up to {MOST_STEPS[FIELD]} steps; all that its
    diagnoses find is counted. Right name: every finding is one effect, and a true one.
    Class: every finding holds a true effect, and one of them several effects. False
    name: a finding without a true effect. Silent: nothing is found; where nothing is to
    be named, that is right. Intervals in brackets: 95 %, Wilson.

    {{% if by_kind is defined %}}

    Seeds from {{{{ first }}}} on, of each kind as many as n says; developed on seeds
    below 21000; those up to 33999 were seen.

    ## What was said

    {{{{ by_kind }}}}

    By noise, where something is to be named:

    {{{{ by_noise }}}}

    ## What came instead

    {{{{ instead }}}}

    {{% if prepared is defined %}}

    ## Ways to prepare a record

    Whether the findings are the same to the letter, names and classes, where clocks
    begin at other times (shifted), with every other sample (thinned), and with
    another run held out (exchanged); and whether they agree: each finding shares an
    effect with one of the other preparation, or both are silent. A name and a class
    that holds it agree.

    {{{{ prepared }}}}

    All three ways together: {{{{ agreeing }}}} of {{{{ n }}}} agree. Of the others
    {{{{ silent }}}} are silent where the record as drawn is not, {{{{ named }}}} find
    something where it is silent, and {{{{ others }}}} say something else. Records of
    which one could not be solved, and that do not count: {{{{ n_failed }}}}.

    {{% endif %}}

    {FAILURES}

    ## Examined on

    {{{{ commits }}}}

    {{% endif %}}
    """


def write_field() -> None:
    """Write the page of machines of the field."""
    write("field_machines.md", field_page())


def field_page() -> str:
    """The page as Markdown; where seeds that are reported were run, those of developing
    are left out.
    """
    found = dict(_tables_of_kinds(is_prepared=False))
    if not found:
        return markdown.page(FIELD_PAGE)
    joined = pd.concat(found.values(), ignore_index=True)
    wrong = wrong_answers(joined)
    counts = joined["commit"].value_counts()
    commits = [f"- commit {commit}: {count} cases" for commit, count in counts.items()]
    return markdown.page(
        FIELD_PAGE,
        first=joined["seed"].min(),
        by_kind=markdown.table(by_kind(found)),
        by_noise=markdown.table(by_noise(joined)),
        instead=markdown.table(wrong) if len(wrong) else "Nothing.",
        failures=_failures(joined, "kind"),
        commits="\n".join(commits),
        **_preparations(),
    )


def _tables_of_kinds(is_prepared: bool) -> Iterable[tuple[str, pd.DataFrame]]:
    for name in KINDS:
        path = store.path_of(FIELD, name, is_prepared)
        rows = store.table(path, FIELD, is_prepared)
        is_reported = rows["seed"].ge(FIRST_OF_PAGE)
        if len(rows):
            yield name, rows[is_reported] if is_reported.any() else rows


def _preparations() -> dict[str, object]:
    records = []
    everything = []
    n_failed = 0
    for name, rows in _tables_of_kinds(is_prepared=True):
        is_examined = rows["outcome"].eq("examined")
        n_failed += int((~is_examined).sum())
        if is_examined.any():
            everything.append(rows[is_examined])
            records.append(preparations(KINDS[name].title, rows[is_examined]))
    if not records:
        return {}
    joined = pd.concat(everything, ignore_index=True)
    records.append(preparations("all", joined))
    shown = {"prepared": markdown.table(records), "n_failed": n_failed}
    return shown | disagreements(joined)
