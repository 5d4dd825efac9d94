"""The pages results/hidden_effects.md, with its figure, and results/field_machines.md,
from the tables of all rows that have been run.
"""

from collections.abc import Iterable, Mapping

import pandas as pd
from scipy.stats import binomtest

from problems.battery import ask, draw, experiments, masses, score, store
from problems.battery.effects import EFFECTS
from problems.battery.records import FIELD, HIDDEN
from problems.battery.score import Record
from problems.tools.pages import render
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

Tables = Mapping[str, pd.DataFrame]  # cases by row

# --- hidden effects

# Seeds from here on were not looked at while the diagnosis became what it is.
FIRST_NEW = 1000
# Of effects from outside seeds 1000 to 1049 and 3000 to 3049 were seen.
FIRST_NEW_OUTSIDE = 3100
LOUDNESS = [0, 5, 10, 40]  # error before over noise floor, ends of the groups


def write_hidden() -> None:
    """Write the page of hidden effects and its figure."""
    found = {}
    new = {}
    for name in draw.ROWS:
        path = store.path_of(HIDDEN, name)
        if path.exists():
            rows = store.table(path, HIDDEN)
            is_new = of_new_seeds(name, rows)
            found[name], new[name] = rows[~is_new], rows[is_new]
    write("hidden_effects.md", hidden_page(found, new))
    one = {name: rows for name, rows in found.items() if _is_one(name)}
    if one:
        figure(one)


def of_new_seeds(name: str, rows: pd.DataFrame) -> "pd.Series[bool]":
    """Which cases of a row have seeds that nobody looked at before."""
    return rows["seed"].ge(FIRST_NEW_OUTSIDE if name == "outside" else FIRST_NEW)


def _is_one(name: str) -> bool:
    return draw.ROWS[name].kind == "one"


def hidden_page(found: Tables, new: Tables) -> str:
    """The page as Markdown, from cases by row, those of new seeds apart."""
    shown: dict[str, object] = {}
    if found:
        joined = pd.concat(found.values(), ignore_index=True)
        joined_new = pd.concat(new.values(), ignore_index=True)
        others = {name: rows for name, rows in found.items() if not _is_one(name)}
        shown = {
            "others": _by_row(others),
            "by_noise": list(_by_noise_and_effect(others)),
            "new": list(_new_seeds(found, new)) if len(joined_new) else [],
            "instead": score.confusions(joined).round(1),
            "failures": _failures(joined, "row"),
            "by_commit": list(_by_commit(joined, joined_new)),
        }
        one = {name: rows for name, rows in found.items() if _is_one(name)}
        if one:
            joined_one = pd.concat(one.values(), ignore_index=True)
            shown["one"] = _by_row(one)
            shown["by_group"] = list(_by_group(joined_one))
            shown["by_setting"] = list(_by_setting(joined_one))
    return render(
        "battery/pages/hidden_effects.md",
        draw=draw,
        most_noise=max(draw.NOISE_LEVELS),
        of_signal=masses.OF_SIGNAL,
        detected=ask.DETECTED,
        first_new=FIRST_NEW,
        first_new_outside=FIRST_NEW_OUTSIDE,
        **shown,
    )


def _by_row(found: Tables) -> list[Record]:
    lines = []
    for name, rows in found.items():
        target = score.target_of(draw.ROWS[name])
        lines.append(score.summary_row(name.replace("_", " "), rows, target))
    return lines


def _by_group(rows: pd.DataFrame) -> Iterable[Record]:
    names = rows["row"].map(lambda row: EFFECTS[draw.ROWS[row].effects[0]].group)
    groups = names.replace(["force", "input"], "outside forces")
    for group in dict.fromkeys(groups):
        for noise in draw.NOISE_LEVELS:
            part = rows[groups.eq(group) & rows["noise"].eq(noise)]
            if len(part):
                target = score.TARGETS[noise]
                yield score.summary_row(f"{group}, {noise:.0%}", part, target)


def _by_setting(rows: pd.DataFrame) -> Iterable[Record]:
    kept = score.scored(rows)
    for key in ("masses", "measured", "input"):
        for value, part in kept.groupby(key):
            yield _counted("setting", f"{key}: {value}", part)
    loudness = pd.cut(kept["base_ratio"], LOUDNESS)
    for between, part in kept.groupby(loudness, observed=True):
        yield _counted("setting", f"error before {between}", part)


def _by_noise_and_effect(found: Tables) -> Iterable[Record]:
    for name, rows in found.items():
        for key in ("noise", "truth"):
            for value, part in score.scored(rows).groupby(key):
                label = f"{name.replace('_', ' ')}, {key} {value}"
                yield _counted("row", label, part)


def _counted(head: str, label: str, kept: pd.DataFrame) -> Record:
    return {head: label, "cases": len(kept), "right": score.share_of(kept["good"])}


def _shares(rows: pd.DataFrame, prefix: str = "") -> Record:
    """Of the right name, and of that or a true tie."""
    kept = score.scored(rows)
    record: Record = {f"{prefix}n": str(len(kept))} if prefix else {}
    record[f"{prefix}named"] = score.share_of(kept["right"].astype(bool))
    return record | {f"{prefix}with ties": score.share_of(kept["good"])}


def _new_seeds(found: Tables, new: Tables) -> Iterable[Record]:
    """Rates on new seeds beside those on the first ones, names alone and with ties."""
    groups: dict[str, list[str]] = {}
    for name in found:
        of_one = f"one effect, noise {100 * draw.ROWS[name].noise[0]:g} %"
        label = of_one if _is_one(name) else name.replace("_", " ")
        groups.setdefault(label, []).append(name)
    for label, names in groups.items():
        record: Record = {"rows": label}
        for when, tables in (("first seeds: ", found), ("new seeds: ", new)):
            rows = [tables[name] for name in names if len(tables[name])]
            if rows:
                record |= _shares(pd.concat(rows, ignore_index=True), when)
        yield record


def _by_commit(found: pd.DataFrame, new: pd.DataFrame) -> Iterable[Record]:
    """Rates by the code that the cases were examined on."""
    joined = pd.concat([found, new], ignore_index=True)
    n_new = new["commit"].value_counts()
    for commit, count in joined["commit"].value_counts().items():
        counts = {"cases": count, "of new seeds": n_new.get(commit, 0)}
        own = joined[joined["commit"].eq(str(commit))]
        yield {"commit": commit, **counts, **_shares(own)}


def _failures(rows: pd.DataFrame, row: str) -> str:
    failed = rows[rows["outcome"].ne("examined")]
    counts = (failed[row] + ": " + failed["outcome"]).value_counts()
    return "\n".join(f"- {count} x {what}" for what, count in counts.items())


COLOURS = dict(zip(draw.NOISE_LEVELS, ("#0072b2", "#009e73", "#d55e00"), strict=True))
HIGHEST_LEFT_END = 80.0  # %, of the axis


def figure(found: Tables) -> None:
    """Share of cases that are right, per effect and noise, with 95 % intervals
    (Wilson).

    ``found``: the cases of the rows with one hidden effect.
    """
    effects = list(dict.fromkeys(draw.ROWS[name].effects[0] for name in found))
    size = (8, 1.2 + 0.34 * len(effects))
    fig, ax = plt.subplots(figsize=size, layout="constrained")
    lowest = HIGHEST_LEFT_END
    for name, cases in found.items():
        noise = draw.ROWS[name].noise[0]
        kept = score.scored(cases)
        if len(kept):
            test = binomtest(int(kept["good"].sum()), len(kept))
            ends = test.proportion_ci(method="wilson")
            share = test.statistic
            low, high = max(share - ends.low, 0.0), max(ends.high - share, 0.0)
            shift = 0.22 * (draw.NOISE_LEVELS.index(noise) - 1)
            place = effects.index(draw.ROWS[name].effects[0]) + shift
            bars = [[100 * low], [100 * high]]
            colour = COLOURS[noise]
            middle = 100 * share
            ax.errorbar(middle, place, xerr=bars, fmt="o", ms=4, lw=1, color=colour)
            lowest = min(lowest, 100 * ends.low)
    for noise, colour in COLOURS.items():
        ax.plot([], [], "o", ms=4, color=colour, label=f"{noise:.0%} noise")
    targets = sorted(set(score.TARGETS.values()), reverse=True)
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


def write_field() -> None:
    """Write the page of machines of the field."""
    write("field_machines.md", field_page())


def field_page() -> str:
    """The page as Markdown; where seeds that are reported were run, those of developing
    are left out.
    """
    found = dict(_tables_of_kinds(is_prepared=False))
    shown: dict[str, object] = {}
    if found:
        joined = pd.concat(found.values(), ignore_index=True)
        counts = joined["commit"].value_counts()
        shown = {
            "first": joined["seed"].min(),
            "by_kind": score.by_kind(found),
            "by_noise": score.by_noise(joined),
            "instead": score.wrong_answers(joined),
            "failures": _failures(joined, "kind"),
            "commits": [f"- commit {c}: {count} cases" for c, count in counts.items()],
            **_preparations(),
        }
    return render(
        "battery/pages/field_machines.md",
        field=experiments,
        levels=[f"{100 * noise:g}" for noise in draw.FIELD_NOISE_LEVELS],
        most_steps=ask.MOST_STEPS[FIELD],
        **shown,
    )


def _tables_of_kinds(is_prepared: bool) -> Iterable[tuple[str, pd.DataFrame]]:
    for name in draw.KINDS:
        path = store.path_of(FIELD, name, is_prepared)
        rows = store.table(path, FIELD, is_prepared)
        is_reported = rows["seed"].ge(FIRST_OF_PAGE)
        if len(rows):
            yield name, rows[is_reported] if is_reported.any() else rows


def _preparations() -> Record:
    records = []
    solved = []
    n_failed = 0
    for name, rows in _tables_of_kinds(is_prepared=True):
        examined = rows[rows["outcome"].eq("examined")]
        n_failed += len(rows) - len(examined)
        if len(examined):
            solved.append(examined)
            records.append(score.preparations(draw.KINDS[name].title, examined))
    if not records:
        return {}
    joined = pd.concat(solved, ignore_index=True)
    records.append(score.preparations("all", joined))
    counts = score.disagreements(joined)
    return {"prepared": records, "n_failed": n_failed, **counts}
