"""The page results/hidden_effects.md."""

import pandas as pd

from problems.hidden_effects.examination import DETECTED
from problems.hidden_effects.figure import figure
from problems.hidden_effects.rows import ENERGY, LOSS, NOISE_LEVELS, ROWS
from problems.hidden_effects.scores import (
    TARGETS,
    confusions,
    scored,
    share,
    summary_row,
    target_of,
)
from problems.hidden_effects.store import path_of, table
from problems.tools import markdown
from problems.tools.provenance import write


def page() -> None:
    """The page and the figure from the tables of all rows that have been run."""
    found = {name: table(name) for name in ROWS if path_of(name).exists()}
    lines = [*_INTRODUCTION, ""]
    one = {name: rows for name, rows in found.items() if ROWS[name].kind == "one"}
    if one:
        everyone = pd.concat(one.values(), ignore_index=True)
        lines += [
            "## One hidden effect",
            "",
            "Groups of effects, by noise:",
            "",
            _groups(everyone),
            "",
        ]
        lines += [
            markdown.table(
                [
                    summary_row(n.replace("_", " "), r, target_of(ROWS[n]))
                    for n, r in one.items()
                ]
            ),
            "",
        ]
        lines += [
            "![share of cases that are right](hidden_effects.png)",
            "",
            "By setting:",
            "",
            _by_setting(everyone),
            "",
        ]
        figure(one)
    others = {name: rows for name, rows in found.items() if name not in one}
    if others:
        lines += ["## Nothing, two effects, effects from outside, sensors, tanks", ""]
        lines += [
            markdown.table(
                [
                    summary_row(n.replace("_", " "), r, target_of(ROWS[n]))
                    for n, r in others.items()
                ]
            ),
            "",
        ]
        lines += ["By noise and by effect:", "", _by_noise_and_effect(others), ""]
    if found:
        wrong = confusions(pd.concat(found.values(), ignore_index=True))
        lines += [
            "## What came instead",
            "",
            markdown.table(wrong.round(1)) if len(wrong) else "Nothing.",
            "",
        ]
        lines += [*_failures(found), *_commits(found)]
    write("hidden_effects.md", "\n".join(lines))


_INTRODUCTION = [
    "# Hidden effects",
    "",
    "Machines with one or two masses are simulated with an effect (`problems/hidden_effects/truth.py`, without phsi_opt) and",
    "given to `identify` and `diagnose` with a model that lacks it. Parameters, starts, input, measured channels and",
    "the effect's size are drawn per case; the size is such that the best re-fit of the model has a free-run error of",
    "3 to 30 times the noise floor (log-uniform; at 10 % noise up to 7 times: the error stays below 0.7 of the",
    "signal's own standard deviation; an effect that cannot physically be so large has the largest size allowed, and",
    "where eight experiments in a row did not show three times the floor, 1.5 times was enough).",
    "",
    "Right: the verdict is 'missing: named', and the first effect has the right name and acts in the right equation. A",
    "tie counts as right only if the truth is listed in confusable_with and the effect named fits the noise-free data",
    f"to within {DETECTED} noise variances in total, the size that a test at 1 % would detect ('misfit').",
    "Intervals in brackets: 95 %, Wilson. Coefficient covered: its 95 % interval holds the truth, where the",
    "catalogue's coefficient counts the same thing. Held-out: error with the first effect over the noise that is in",
    "the held-out samples, of the cases that are right. Failed: an error was raised; counted as wrong. An effect from",
    "outside the catalogue that one of its effects imitates as closely as a true tie is not counted.",
]


def _group(effect: str) -> str:
    if effect in LOSS:
        return "loss"
    if effect in ENERGY:
        return "energy"
    return "memory" if effect == "hysteresis" else "outside forces"


def _groups(rows: pd.DataFrame) -> str:
    groups = rows["row"].map(lambda name: _group(ROWS[name].effects[0]))
    records = [
        summary_row(f"{group}, {noise:.0%}", rows[chosen], TARGETS[noise])
        for group in dict.fromkeys(groups)
        for noise in NOISE_LEVELS
        if (chosen := groups.eq(group) & rows["noise"].eq(noise)).any()
    ]
    return markdown.table(records)


def _by_setting(rows: pd.DataFrame) -> str:
    kept = scored(rows)
    records = [
        {
            "setting": f"{key}: {value}",
            "cases": len(part),
            "right": share(int(part["good"].sum()), len(part)),
        }
        for key in ("masses", "measured", "input")
        for value, part in kept.groupby(key)
    ]
    loud = pd.cut(kept["base_ratio"], [0, 5, 10, 40])
    records += [
        {
            "setting": f"error before {b}",
            "cases": len(p),
            "right": share(int(p["good"].sum()), len(p)),
        }
        for b, p in kept.groupby(loud, observed=True)
    ]
    return markdown.table(records)


def _by_noise_and_effect(found: dict[str, pd.DataFrame]) -> str:
    records = []
    for name, rows in found.items():
        for key in ("noise", "truth"):
            for value, part in scored(rows).groupby(key):
                label = f"{name.replace('_', ' ')}, {key} {value}"
                records.append(
                    {
                        "row": label,
                        "cases": len(part),
                        "right": share(int(part["good"].sum()), len(part)),
                    }
                )
    return markdown.table(records) if records else ""


def _failures(found: dict[str, pd.DataFrame]) -> list[str]:
    rows = pd.concat(found.values(), ignore_index=True)
    failed = rows[rows["outcome"] != "examined"]
    counts = (failed["row"] + ": " + failed["outcome"]).value_counts()
    lines = [f"- {count} x {what}" for what, count in counts.items()]
    return ["## Cases that failed", "", *lines, ""] if lines else []


def _commits(found: dict[str, pd.DataFrame]) -> list[str]:
    counts = pd.concat(found.values(), ignore_index=True)["commit"].value_counts()
    return [
        "## Examined on",
        "",
        *[f"- commit {which}: {count} cases" for which, count in counts.items()],
        "",
    ]
