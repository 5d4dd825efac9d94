"""Does the diagnosis find effects that were hidden in the data, and nothing where
nothing is hidden?

python -m problems.hidden_effects.run [--quick] [--page] [--list] [--jobs=N] [--seeds=N]
[row ...]

A row is named in full (coulomb_friction_0.03) or by its beginning (coulomb_friction,
sensor). What came out of each case is kept in results/hidden_effects/<row>.csv as it is
computed: a run that was interrupted goes on where it stopped, and --page writes the
page anew. --quick runs one seed of each row in this process and writes nothing.
"""

import os

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # before NumPy is loaded: the processes are the parallelism
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest

import phsi_opt as ph
from phsi_opt.model.model import Model
from problems.benchmarks.efficiency.run import option
from problems.hidden_effects.cases import (
    ENERGY,
    LOSS,
    NOISE_LEVELS,
    ROWS,
    Case,
    Row,
    Truth,
    draw,
)
from problems.tools.provenance import RESULTS, commit, write

FOLDER = RESULTS / "hidden_effects"
NOTHING, NAMED, UNEXPLAINED = (
    "nothing missing",
    "missing: named",
    "missing: unexplained",
)
WITHIN = 1.959964
DETECTED = (
    6.63  # fall of the misfit, in noise variances, that a test at 1 % takes for real
)
# largest held-out error over the noise floor with the right effect in the model
AT_FLOOR = 1.1
MOST_STEPS = 4
TARGETS = {0.01: 0.95, 0.03: 0.95, 0.1: 0.85}
OTHER_TARGETS = {
    "nothing": 0.95,
    "two": 0.9,
    "outside": 0.9,
    "sensor": 0.9,
    "tanks": 0.95,
}
COLUMNS = [
    "row",
    "seed",
    "noise",
    "masses",
    "measured",
    "input",
    "free",
    "known",
    "n_train",
    "truth",
    "equation",
    "value",
    "listed",
    "target",
    "base_ratio",
    "base_error",
    "verdict",
    "first",
    "first_equation",
    "confusable_with",
    "right",
    "tie",
    "misfit",
    "coefficient",
    "std_error",
    "covered",
    "after",
    "rank",
    "added",
    "seconds",
    "drawing",
    "outcome",
    "commit",
]


# --- one case


def examine(row: Row, seed: int) -> dict[str, object]:
    """The record of a case: what was hidden, what was named, with which coefficient;
    whatever fails is recorded.
    """
    began = time.perf_counter()
    record: dict[str, object] = {
        "row": row.name,
        "seed": seed,
        "right": False,
        "tie": False,
        "outcome": "examined",
    }
    record["commit"] = commit()
    try:
        case = draw(row, seed)
    except (ArithmeticError, ValueError) as error:
        return record | {"outcome": f"not drawn: {str(error)[:200]}"}
    record |= _described(case) | {"drawing": time.perf_counter() - began}
    began = time.perf_counter()
    try:
        record |= {"two": _two}.get(row.kind, _one)(case)
    # whatever goes wrong is a case that was not examined, and is counted as wrong
    except Exception as error:
        record["outcome"] = f"{type(error).__name__}: {str(error)[:200]}"
    return record | {"seconds": time.perf_counter() - began}


def _described(case: Case) -> dict[str, object]:
    listed = {(e.name, e.equation) for e in ph.catalogue(case.model)}
    return {
        "noise": case.noise,
        **case.settings,
        "target": case.target,
        "base_ratio": case.base_ratio,
        "truth": " + ".join(t.effect for t in case.truths),
        "equation": " + ".join("|".join(t.equations) for t in case.truths),
        "value": case.truths[0].coefficient if len(case.truths) == 1 else np.nan,
        "listed": all(
            any((t.effect, e) in listed for e in t.equations) for t in case.truths
        ),
    }


def is_right(truth: Truth, name: str, equation: str) -> bool:
    """Whether effect and place are those of the truth."""
    return name == truth.effect and equation in truth.equations


def _one(case: Case) -> dict[str, object]:
    """At most one effect is hidden: the first diagnosis."""
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, held_out=case.test)
    table = diagnosis.candidates
    found: dict[str, object] = {
        "base_error": diagnosis.base.rmse / floor(case),
        "verdict": diagnosis.verdict,
    }
    if case.row.kind == "nothing":
        found["right"] = diagnosis.verdict == NOTHING
    elif case.row.kind == "outside":
        found["right"] = diagnosis.verdict == UNEXPLAINED
    if table.empty:
        return found
    first, named = table.iloc[0], diagnosis.verdict == NAMED
    found |= {
        "first": first.effect,
        "first_equation": first.equation,
        "confusable_with": first.confusable_with,
        "coefficient": first.coefficient,
        "std_error": first.std_error,
        "after": first.held_out_rmse / floor(case),
    }
    if case.row.kind in ("nothing", "outside"):
        return found | (
            {
                "misfit": misfit(
                    case, fit.model.add(diagnosis.effects[0]), diagnosis.nearest
                )
            }
            if named
            else {}
        )
    (truth,) = case.truths
    hits = [
        is_right(truth, name, equation)
        for name, equation in zip(table["effect"], table["equation"], strict=True)
    ]
    found |= {
        "rank": hits.index(True) + 1 if any(hits) else np.nan,
        "right": named and hits[0],
    }
    if named and hits[0]:
        found["covered"] = covered(
            truth.coefficient, first.coefficient, first.std_error
        )
    elif named:
        texts = {f"{truth.effect} on {equation}" for equation in truth.equations}
        found["tie"] = bool(texts & set(str(first.confusable_with).split(", ")))
        found["misfit"] = misfit(
            case, fit.model.add(diagnosis.effects[0]), diagnosis.nearest
        )
    return found


def covered(truth: float, estimate: float, error: float) -> float:
    """1 or 0: whether the 95 % interval holds the truth (without a standard error it
    does not); NaN: not comparable.
    """
    if not np.isfinite(truth):
        return np.nan
    return float(abs(estimate - truth) <= WITHIN * error)


def _two(case: Case) -> dict[str, object]:
    """Two effects are hidden: the study adds by itself, a step at a time, until it
    stops.
    """
    study = ph.Study(case.model, case.train, held_out=case.test)
    found: dict[str, object] = {
        "base_error": study.history["held_out_rmse"].iloc[0] / floor(case)
    }
    alike: dict[
        str, set[str]
    ] = {}  # each effect that was added, with what it could not be told from
    for _ in range(MOST_STEPS):
        table, n_steps = study.diagnose().candidates, len(study.steps)
        study.auto(max_steps=1)
        if len(study.steps) == n_steps:
            break
        ties = dict(
            zip(
                table["effect"] + " on " + table["equation"],
                table["confusable_with"],
                strict=True,
            )
        )
        alike = {
            str(e): alike.get(str(e), {str(e), *ties.get(str(e), "").split(", ")})
            for e in study.effects
        }
    added = list(alike)
    right, with_ties = (
        matches(case.truths, [{text} for text in added]),
        matches(case.truths, list(alike.values())),
    )
    found |= {
        "verdict": study.diagnose().verdict,
        "added": "; ".join(added),
        "right": right,
        "tie": with_ties and not right,
        "after": study.history["held_out_rmse"].iloc[-1] / floor(case),
    }
    return found | (
        {} if right or not added else {"misfit": misfit(case, study.model, study.fit)}
    )


def matches(truths: tuple[Truth, ...], found: list[set[str]]) -> bool:
    """Whether each truth has an effect of its own among those found, and none is left
    over.
    """
    texts = [{f"{t.effect} on {equation}" for equation in t.equations} for t in truths]
    if len(texts) != len(found):
        return False
    if not texts:
        return True
    return any(
        texts[0] & found[k] and matches(truths[1:], found[:k] + found[k + 1 :])
        for k in range(len(found))
    )


def floor(case: Case) -> float:
    """Root mean square of the noise that is in the held-out samples, on the scale of
    `Comparison.rmse`.
    """
    y = np.concatenate([run.x for run in case.test.trajectories])
    noise = np.concatenate(list(case.test_noise))
    seen = np.flatnonzero(np.isfinite(y).any(axis=0))
    scale = y[:, seen].std(axis=0) if len(seen) > 1 else np.ones(1)
    return float(np.sqrt(np.mean((noise[:, seen] / scale) ** 2)))


def misfit(case: Case, model: Model, start: ph.Fit | None = None) -> float:
    """How far a model stays from the noise-free training data, in noise variances; the
    truth itself is at zero.

    Below `DETECTED` the data cannot tell it from the truth. Infinite where it could not
    be fitted, from ``start``.
    """
    try:
        comparison = ph.compare(ph.identify(model, case.clean, start=start), case.clean)
    except ph.PhsiOptError:
        return np.inf
    n = len(case.sigma)
    runs = zip(comparison.residuals, case.clean.trajectories, strict=True)
    return float(
        sum(
            np.nansum(
                (np.where(np.isfinite(run.x), r[:, :n], np.nan) / case.sigma) ** 2
            )
            for r, run in runs
        )
    )


# --- the battery


def _task(job: tuple[str, int]) -> dict[str, object]:
    name, seed = job
    return examine(ROWS[name], seed)


def main(names: list[str], n_seeds: int, jobs: int = 2) -> None:
    """Examine what is not yet in the tables, the first seeds of all rows first, and
    write the page.
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    done = {
        name: set(table(name)["seed"]) if _path(name).exists() else set()
        for name in names
    }
    tasks = [
        (name, seed)
        for seed in range(n_seeds)
        for name in names
        if seed not in done[name]
    ]
    for record in _computed(tasks, jobs):
        name = str(record["row"])
        line = pd.DataFrame([record], columns=COLUMNS)
        line.to_csv(
            _path(name),
            mode="a",
            header=not _path(name).exists(),
            index=False,
            float_format="%.6g",
        )
    for name in names:
        rows = table(name).sort_values("seed", kind="stable")
        rows.to_csv(_path(name), index=False, float_format="%.6g")
        print(_line(name, rows), flush=True)
    page()


def _computed(tasks: list[tuple[str, int]], jobs: int) -> Iterator[dict[str, object]]:
    if jobs == 1:
        yield from map(_task, tasks)
    elif tasks:
        with get_context("spawn").Pool(jobs) as pool:
            yield from pool.imap_unordered(_task, tasks)


def quick(names: list[str], n_seeds: int = 1) -> pd.DataFrame:
    """A few seeds of each row in this process; nothing is written."""
    records = [examine(ROWS[name], seed) for name in names for seed in range(n_seeds)]
    return pd.DataFrame(records, columns=COLUMNS)


def chosen_rows(given: list[str]) -> list[str]:
    """The rows that are named in full or by their beginning; all where none is given."""
    for text in given:
        if not any(name.startswith(text) for name in ROWS):
            raise SystemExit(f"no row begins with {text!r}; --list prints them.")
    return [
        name
        for name in ROWS
        if name in given or any(name.startswith(text) for text in given) or not given
    ]


def _path(name: str) -> Path:
    return FOLDER / f"{name}.csv"


def table(name: str) -> pd.DataFrame:
    """The kept cases of a row."""
    return pd.read_csv(_path(name))


# --- scores


def scored(rows: pd.DataFrame) -> pd.DataFrame:
    """The cases with ``good``: right, or a tie that is declared and true; without those
    that are imitated or not drawn.

    A tie is true where the effect named explains the noise-free data to below what a
    test would detect. An effect from outside that a catalogue's effect imitates as
    closely is no effect from outside, and leaves the count.
    """
    rows = rows.assign(tie_true=rows["tie"].astype(bool) & (rows["misfit"] < DETECTED))
    imitated = rows["row"].eq("outside") & (rows["misfit"] < DETECTED)
    drawn = ~rows["outcome"].astype(str).str.startswith("not drawn")
    rows = rows.assign(good=rows["right"].astype(bool) | rows["tie_true"])
    return rows[~imitated & drawn]


def share(count: int, n: int) -> str:
    """A share with its 95 % interval (Wilson)."""
    if n == 0:
        return "-"
    low, high = binomtest(count, n).proportion_ci(method="wilson")
    return f"{count / n:.0%} ({low:.0%} to {high:.0%})"


def _share_of(values: pd.Series) -> str:
    known = values.dropna().astype(float)
    return share(int(known.sum()), len(known))


def summary_row(label: str, rows: pd.DataFrame, target: float) -> dict[str, object]:
    """A line of the page."""
    kept = scored(rows)
    good, n = int(kept["good"].sum()), len(kept)
    is_named = kept["right"].astype(bool) & ~kept["row"].isin(
        ["nothing", "outside"]
    )  # where there is one to add
    after = kept.loc[is_named, "after"].dropna()
    return {
        "row": label,
        "cases": n,
        "right": share(good, n),
        "target": f"{target:.0%}",
        "met": "yes" if n and good / n >= target else "no",
        "of these true ties": int(
            (kept["tie_true"] & ~kept["right"].astype(bool)).sum()
        ),
        "coefficient covered": _share_of(kept["covered"]),
        f"held-out at most {AT_FLOOR:g} x floor": _share_of(after <= AT_FLOOR)
        if len(after)
        else "-",
        "error before / floor": f"{kept['base_error'].median():.1f}",
        "failed": int((kept["outcome"] != "examined").sum()),
        "seconds": f"{kept['seconds'].median():.1f}",
    }


def _line(name: str, rows: pd.DataFrame) -> str:
    return ", ".join(
        f"{key} {value}"
        for key, value in summary_row(name, rows, _target(ROWS[name])).items()
    )


def _target(row: Row) -> float:
    return TARGETS[row.noise[0]] if row.kind == "one" else OTHER_TARGETS[row.kind]


_TEXTS = ("first", "first_equation", "verdict", "added", "truth", "equation")


def confusions(rows: pd.DataFrame) -> pd.DataFrame:
    """What came instead of the truth: truth, verdict and name, number of cases,
    declared ties, true ties, misfit.
    """
    wrong = scored(rows)
    wrong = wrong[~wrong["right"].astype(bool)]
    wrong = wrong.assign(
        **{
            name: wrong[name].astype(object).where(wrong[name].notna(), "")
            for name in _TEXTS
        }
    )
    first = wrong["first"] + " on " + wrong["first_equation"]
    two = wrong["row"].eq("two_effects")
    came = first.where(
        wrong["verdict"].eq(NAMED), wrong["verdict"].replace("", "failed")
    )
    came = came.where(~two, "added: " + wrong["added"])
    truth = (wrong["truth"] + " on " + wrong["equation"]).where(
        wrong["truth"].ne(""), "nothing"
    )
    by = wrong.assign(truth=truth, came=came).groupby(["truth", "came"])
    counted = by.agg(
        cases=("seed", "size"),
        declared_ties=("tie", "sum"),
        true_ties=("tie_true", "sum"),
        median_misfit=("misfit", "median"),
    )
    return counted.reset_index().sort_values(
        ["cases", "truth"], ascending=[False, True], ignore_index=True
    )


# --- the page


def page() -> None:
    """The page and the figure from the tables of all rows that have been run."""
    found = {name: table(name) for name in ROWS if _path(name).exists()}
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
            _markdown(
                [
                    summary_row(n.replace("_", " "), r, _target(ROWS[n]))
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
            _markdown(
                [
                    summary_row(n.replace("_", " "), r, _target(ROWS[n]))
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
            _markdown(wrong.round(1)) if len(wrong) else "Nothing.",
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


def _markdown(records: list[dict[str, object]] | pd.DataFrame) -> str:
    frame = pd.DataFrame(records)
    rows = [
        list(frame.columns),
        ["---"] * len(frame.columns),
        *frame.astype(str).to_numpy().tolist(),
    ]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", " or ") for cell in row) + " |"
        for row in rows
    )


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
    return _markdown(records)


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
    return _markdown(records)


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
    return _markdown(records) if records else ""


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


def figure(found: dict[str, pd.DataFrame]) -> None:
    """Share of cases that are right, per effect and noise, with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    effects = list(dict.fromkeys(ROWS[name].effects[0] for name in found))
    colours = dict(zip(NOISE_LEVELS, ("#0072b2", "#009e73", "#d55e00"), strict=True))
    fig, ax = plt.subplots(figsize=(8, 1.2 + 0.34 * len(effects)), layout="constrained")
    lowest = 80.0
    for k, noise in enumerate(NOISE_LEVELS):
        shown = {
            e: scored(r)
            for n, r in found.items()
            for e in ROWS[n].effects
            if ROWS[n].noise[0] == noise and len(r)
        }
        tests = {
            e: binomtest(int(r["good"].sum()), len(r))
            for e, r in shown.items()
            if len(r)
        }
        heights = [effects.index(e) + 0.22 * (k - 1) for e in tests]
        middles = [100 * test.statistic for test in tests.values()]
        spans = [test.proportion_ci(method="wilson") for test in tests.values()]
        ends = [
            [m - 100 * s.low, 100 * s.high - m]
            for m, s in zip(middles, spans, strict=True)
        ]
        lowest = min([lowest, *(100 * s.low for s in spans)])
        errors = np.maximum(np.array(ends).reshape(-1, 2).T, 0.0)
        ax.errorbar(
            middles,
            heights,
            xerr=errors,
            fmt="o",
            ms=4,
            lw=1,
            color=colours[noise],
            label=f"{noise:.0%} noise",
        )
    for target, style in ((95, "-"), (85, ":")):
        ax.axvline(target, color="0.5", lw=1, ls=style, label=f"target {target} %")
    ax.set(
        yticks=range(len(effects)),
        yticklabels=effects,
        xlim=(10 * (lowest // 10), 101),
        ylim=(-0.7, len(effects) - 0.3),
    )
    ax.set_xlabel(
        "cases with the right effect in the right equation (%), 95 % intervals"
    )
    ax.invert_yaxis()
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    fig.savefig(RESULTS / "hidden_effects.png", dpi=150)
    plt.close(fig)


if __name__ == "__main__":
    selected = chosen_rows([name for name in sys.argv[1:] if not name.startswith("-")])
    if "--list" in sys.argv:
        print("\n".join(selected))
    elif "--page" in sys.argv:
        page()
    elif "--quick" in sys.argv:
        print(
            quick(selected, option("seeds", 1) or 1)
            .dropna(axis=1, how="all")
            .to_string(index=False)
        )
    else:
        main(selected, option("seeds", 50) or 50, option("jobs", 2) or 2)
