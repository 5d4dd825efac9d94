"""The page results/hidden_effects.md, from the tables of all rows that have been run.

Limits and sizes in its text are the constants of the battery; results are computed from
the tables.
"""

from collections.abc import Mapping

import pandas as pd

from problems.hidden_effects import store
from problems.hidden_effects.examination import DETECTED
from problems.hidden_effects.figure import figure
from problems.hidden_effects.rows import (
    ENERGY,
    FAINTEST,
    LOSS,
    LOUDEST,
    NOISE_LEVELS,
    OF_SIGNAL,
    PATIENCE,
    QUIETEST,
    ROWS,
)
from problems.hidden_effects.scores import (
    TARGETS,
    confusions,
    scored,
    share_right,
    summary_row,
    target_of,
)
from problems.tools import markdown
from problems.tools.intervals import share
from problems.tools.provenance import write

Tables = Mapping[str, pd.DataFrame]  # cases by row
# Seeds from here on were not looked at while the diagnosis became what it is.
FIRST_NEW = 1000
# Of effects from outside seeds 1000 to 1049 and 3000 to 3049 were seen.
FIRST_NEW_OUTSIDE = 3100
LOUDNESS = [0, 5, 10, 40]  # error before over noise floor, ends of the groups

INTRODUCTION = markdown.paragraph(f"""
    Machines with one or two masses are simulated with an effect
    (`problems/hidden_effects/truth.py`, without phsi_opt) and given to `identify` and
    `diagnose` with a model that lacks it. Parameters, starts, input, measured channels
    and the effect's size are drawn per case; the size is such that the best re-fit of
    the model has a free-run error of {QUIETEST:g} to {LOUDEST:g} times the noise floor
    (log-uniform; at {max(NOISE_LEVELS):.0%} noise up to
    {OF_SIGNAL / max(NOISE_LEVELS):g} times: the error stays below {OF_SIGNAL:g} of the
    signal's own standard deviation; an effect that cannot physically be so large has
    the largest size allowed, and where {PATIENCE} experiments in a row did not show
    {QUIETEST:g} times the floor, {FAINTEST:g} times was enough).
    """)
TERMS = markdown.paragraph(f"""
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
    """)


def write_page() -> None:
    """Write the page and the figure from the tables of all rows that have been run."""
    kept = {name: store.table(name) for name in ROWS if store.path_of(name).exists()}
    found = {}
    new = {}
    for name, rows in kept.items():
        is_new = of_new_seeds(name, rows)
        found[name] = rows[~is_new]
        new[name] = rows[is_new]
    write("hidden_effects.md", page(found, new))
    one = _of_one_effect(found)
    if one:
        figure(one)


def of_new_seeds(name: str, rows: pd.DataFrame) -> "pd.Series[bool]":
    """Which cases of a row have seeds that nobody looked at before."""
    return rows["seed"].ge(FIRST_NEW_OUTSIDE if name == "outside" else FIRST_NEW)


def page(found: Tables, new: Tables) -> str:
    """The page as Markdown.

    Args:
        found: cases by row.
        new: those of new seeds.
    """
    lines = ["# Hidden effects", "", INTRODUCTION, "", TERMS, ""]
    one = _of_one_effect(found)
    others = {name: rows for name, rows in found.items() if name not in one}
    if one:
        lines += _one_effect(one)
    if others:
        lines += _other_kinds(others)
    if any(len(rows) for rows in new.values()):
        lines += _new_seeds(found, new)
    if found:
        everything = pd.concat(found.values(), ignore_index=True)
        lines += _instead(everything)
        lines += _failures(everything)
        lines += _by_commit(found, new)
    return "\n".join(lines)


def _new_seeds(found: Tables, new: Tables) -> list[str]:
    """Rates on new seeds beside those on the first ones, names alone and with ties."""
    text = markdown.paragraph(f"""
        Seeds from {FIRST_NEW} on (of effects from outside {FIRST_NEW_OUTSIDE}), not
        looked at before, beside the first ones, above, which were examined while the
        diagnosis was developed. Named: the right effect
        comes first. With ties: or a declared, true tie of it.
        """)
    records = []
    for label, names in _groups_of_rows(found).items():
        record: dict[str, object] = {"rows": label}
        for when, tables in (("first seeds", found), ("new seeds", new)):
            rows = [tables[name] for name in names if len(tables.get(name, []))]
            if rows:
                kept = scored(pd.concat(rows, ignore_index=True))
                named = share(int(kept["right"].astype(bool).sum()), len(kept))
                record[f"{when}: n"] = str(len(kept))
                record[f"{when}: named"] = named
                record[f"{when}: with ties"] = share_right(kept)
        records.append(record)
    return ["## New seeds", "", text, "", markdown.table(records), ""]


def _groups_of_rows(found: Tables) -> dict[str, list[str]]:
    """Rows of one effect by noise, and the other kinds by themselves."""
    groups: dict[str, list[str]] = {}
    for name in found:
        row = ROWS[name]
        label = name.replace("_", " ")
        if row.kind == "one":
            label = f"one effect, noise {100 * row.noise[0]:g} %"
        groups.setdefault(label, []).append(name)
    return groups


def _of_one_effect(found: Tables) -> dict[str, pd.DataFrame]:
    return {name: rows for name, rows in found.items() if ROWS[name].kind == "one"}


def _one_effect(one: Tables) -> list[str]:
    everyone = pd.concat(one.values(), ignore_index=True)
    return [
        "## One hidden effect",
        "",
        "Groups of effects, by noise:",
        "",
        _by_group(everyone),
        "",
        _by_row(one),
        "",
        "![share of cases that are right](hidden_effects.png)",
        "",
        "By setting:",
        "",
        _by_setting(everyone),
        "",
    ]


def _other_kinds(others: Tables) -> list[str]:
    return [
        "## Nothing, two effects, effects from outside, sensors, tanks",
        "",
        _by_row(others),
        "",
        "By noise and by effect:",
        "",
        _by_noise_and_effect(others),
        "",
    ]


def _by_row(found: Tables) -> str:
    return markdown.table(
        [
            summary_row(name.replace("_", " "), rows, target_of(ROWS[name]))
            for name, rows in found.items()
        ]
    )


def _group(row: str) -> str:
    effect = ROWS[row].effects[0]
    if effect in LOSS:
        return "loss"
    if effect in ENERGY:
        return "energy"
    return "memory" if effect == "hysteresis" else "outside forces"


def _by_group(rows: pd.DataFrame) -> str:
    groups = rows["row"].map(_group)
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
    return markdown.table(records) if records else ""


def _counted(head: str, label: str, kept: pd.DataFrame) -> dict[str, object]:
    return {head: label, "cases": len(kept), "right": share_right(kept)}


def _instead(rows: pd.DataFrame) -> list[str]:
    wrong = confusions(rows)
    shown = markdown.table(wrong.round(1)) if len(wrong) else "Nothing."
    return ["## What came instead", "", shown, ""]


def _failures(rows: pd.DataFrame) -> list[str]:
    failed = rows[rows["outcome"] != "examined"]
    counts = (failed["row"] + ": " + failed["outcome"]).value_counts()
    if counts.empty:
        return []
    lines = [f"- {count} x {what}" for what, count in counts.items()]
    return ["## Cases that failed", "", *lines, ""]


def _by_commit(found: Tables, new: Tables) -> list[str]:
    """Rates by the code that the cases were examined on."""
    text = markdown.paragraph("""
        The battery takes longer than the code stays as it is. Lines are of different
        mixtures of rows.
        """)
    records = []
    everything = pd.concat([*found.values(), *new.values()], ignore_index=True)
    n_new = pd.concat([rows["commit"] for rows in new.values()]).value_counts()
    for commit, count in everything["commit"].value_counts().items():
        kept = scored(everything[everything["commit"].eq(str(commit))])
        records.append(
            {
                "commit": commit,
                "cases": count,
                "of new seeds": n_new.get(commit, 0),
                "named": share(int(kept["right"].astype(bool).sum()), len(kept)),
                "with ties": share_right(kept),
            }
        )
    return ["## By the code", "", text, "", markdown.table(records), ""]
