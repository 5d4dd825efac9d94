"""How close do the estimates come to the Cramer-Rao bound, and do the intervals hold
what they promise?

python -m problems.benchmarks.efficiency.run [--quick] [--page] [--jobs=N] [--seeds=N] [experiment ...]

Rows per seed are kept in results/efficiency/<experiment>.csv as they are computed: a
run that was interrupted goes on where it stopped, and --page writes the page anew.
--quick runs two seeds of each experiment and writes nothing.
"""

import os

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # before NumPy is loaded: the processes are the parallelism
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.benchmarks.efficiency.cases import CASES, NOISE_LEVELS, Case, Sample
from problems.tools import markdown
from problems.tools.command_line import chosen, flag, option
from problems.tools.provenance import RESULTS, write

FOLDER = RESULTS / "efficiency"
METHODS: dict[str, ph.MaximumLikelihood | ph.PHSILoss] = {
    "likelihood": ph.MaximumLikelihood(),
    "one-step": ph.PHSILoss(),
}
COLUMNS = [
    "seed",
    "method",
    "parameter",
    "truth",
    "bound",
    "estimate",
    "std_error",
    "joint",
    "seconds",
    "outcome",
]
WITHIN, FAR = 1.959964, 10.0
COLOURS = {"likelihood": "#0072b2", "one-step": "#d55e00"}


def fits(case: Case, seed: int) -> pd.DataFrame:
    """All methods on the data of one seed: a row per method and parameter."""
    sample = case.sample(seed)
    rows = []
    for method, loss in METHODS.items():
        if method == "likelihood" or case.one_step:
            rows += _rows(case, sample, seed, method, loss)
    return pd.DataFrame(rows, columns=COLUMNS)


def _rows(
    case: Case,
    sample: Sample,
    seed: int,
    method: str,
    loss: ph.MaximumLikelihood | ph.PHSILoss,
) -> list[tuple[object, ...]]:
    began, values, errors, outcome = time.perf_counter(), {}, {}, "solved"
    try:
        fit = ph.identify(case.model(), sample.data, loss)
        values, errors = fit.values, fit.std_errors
    except (
        Exception
    ) as error:  # whatever goes wrong is a fit that failed, and is counted
        outcome = f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.perf_counter() - began
    truth = case.system().truth
    joint = sample.joint(
        np.array([values.get(name, np.nan) - value for name, value in truth.items()])
    )
    return [
        (
            seed,
            method,
            name,
            truth[name],
            bound,
            values.get(name, np.nan),
            errors.get(name, np.nan),
            joint,
            seconds,
            outcome,
        )
        for name, bound in zip(truth, sample.bound, strict=True)
    ]


def _task(job: tuple[str, int]) -> tuple[str, int, pd.DataFrame]:
    name, seed = job
    return name, seed, fits(CASES[name], seed)


def main(
    names: list[str] | None = None, n_seeds: int | None = None, jobs: int = 2
) -> None:
    """Run what is not yet in the tables, experiment by experiment, and write the page."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names or list(CASES):
        wanted = range(
            first_seed(name), first_seed(name) + (n_seeds or CASES[name].n_seeds)
        )
        done = set(table(name)["seed"]) if _path(name).exists() else set()
        for _, seed, rows in _computed(
            [(name, seed) for seed in wanted if seed not in done], jobs
        ):
            header = not _path(name).exists()
            rows.to_csv(
                _path(name), mode="a", header=header, index=False, float_format="%.8g"
            )
            print(f"... {name}, seed {seed}", flush=True)
        table(name).sort_values("seed", kind="stable").to_csv(
            _path(name), index=False, float_format="%.8g"
        )
        print(_verdict(table(name)), flush=True)
    page()


def quick(names: list[str] | None = None, n_seeds: int = 2) -> dict[str, pd.DataFrame]:
    """A few seeds of each experiment in this process; nothing is written."""
    return {
        name: pd.concat(
            [fits(CASES[name], first_seed(name) + k) for k in range(n_seeds)],
            ignore_index=True,
        )
        for name in names or list(CASES)
    }


def _computed(
    tasks: list[tuple[str, int]], jobs: int
) -> Iterator[tuple[str, int, pd.DataFrame]]:
    if jobs == 1:
        yield from map(_task, tasks)
    elif tasks:
        with get_context("spawn").Pool(jobs) as pool:
            yield from pool.imap_unordered(_task, tasks)


def first_seed(name: str) -> int:
    """Every experiment draws from seeds of its own, so that their errors are
    independent.
    """
    return 5000 + 1000 * list(CASES).index(name)


def _path(name: str) -> Path:
    return FOLDER / f"{name}.csv"


def table(name: str) -> pd.DataFrame:
    """The kept rows of an experiment."""
    return pd.read_csv(_path(name))


def scores(rows: pd.DataFrame) -> pd.DataFrame:
    """A row per parameter of one method: errors over the bound of their own seed,
    coverage of the 95 % intervals.
    """
    rows = rows.assign(
        z=(rows["estimate"] - rows["truth"]) / rows["bound"],
        # No estimate or no standard error is an interval that does not hold the truth.
        covered=(rows["estimate"] - rows["truth"]).abs() <= WITHIN * rows["std_error"],
        share=rows["std_error"] / rows["bound"],
    )
    by = rows.groupby("parameter", sort=False)
    return pd.DataFrame(
        {
            "truth": by["truth"].first(),
            "bound": by["bound"].mean(),
            "rmse/bound": by["z"].apply(lambda z: np.sqrt(np.mean(z**2))),
            "bias/bound": by["z"].mean(),
            "coverage": by["covered"].mean(),
            "std_error/bound": by["share"].mean(),
            "far": by["z"].apply(lambda z: int(np.sum(np.abs(z) > FAR))),
        }
    )


def joint(rows: pd.DataFrame) -> str:
    """Root mean square error over bound in all directions of the parameters together,
    with what chance makes of it.
    """
    by = rows.groupby("seed")["joint"].first().dropna()
    if by.empty:
        return "no estimate"
    chance = 1 / np.sqrt(2 * len(by) * rows["parameter"].nunique())
    return f"{np.sqrt(by.mean()):.3f} +- {chance:.3f}"


def failures(rows: pd.DataFrame) -> int:
    """Number of fits that gave no estimate."""
    return int(rows[rows["outcome"] != "solved"]["seed"].nunique())


def summary_row(case: Case, rows: pd.DataFrame) -> dict[str, object]:
    """The line of an experiment in the summary."""
    by = {str(method): part for method, part in rows.groupby("method")}
    likelihood = scores(by["likelihood"])
    n = rows["seed"].nunique()
    return {
        "experiment": case.title,
        "seeds": n,
        "failed": failures(by["likelihood"]),
        "worst rmse/bound": f"{likelihood['rmse/bound'].max():.3f} +- {1 / np.sqrt(2 * n):.3f}",
        "joint rmse/bound": joint(by["likelihood"]),
        "largest bias/bound": f"{likelihood['bias/bound'].abs().max():.3f}",
        "coverage, pooled": f"{likelihood['coverage'].mean():.1%}",
        "coverage, lowest": f"{likelihood['coverage'].min():.1%}",
        "one-step: worst rmse/bound": f"{scores(by['one-step'])['rmse/bound'].max():.3g}"
        if "one-step" in by
        else "needs all states",
        "seconds per fit": f"{by['likelihood'].groupby('seed')['seconds'].first().median():.2g}",
    }


def page() -> None:
    """The page and the figure from the tables of all experiments that have been run."""
    found = {name: table(name) for name in CASES if _path(name).exists()}
    summary = pd.DataFrame(
        [summary_row(CASES[name], rows) for name, rows in found.items()]
    )
    lines = ["# How close to the Cramer-Rao bound?", ""]
    lines += [
        "No unbiased estimate has a smaller standard deviation than the bound. It is computed without phsi_opt",
        "(`problems/benchmarks/efficiency/cramer_rao.py`), for each seed's own starts and missing samples, with the starting states unknown.",
        "All methods see the same data; the noise level is estimated, not given; no starting value is the truth.",
        "",
        "rmse/bound: root mean square over the seeds of error over bound. A fit that failed has no estimate and is not",
        "in it, but it is counted (failed), and its intervals count as not holding the truth; fits that end far away",
        f"(beyond {FAR:g} bounds: far) are in it with their full error. +-: standard deviation of such a ratio,",
        "1/sqrt(2 seeds). Coverage: share of the 95 % intervals that hold the truth; with n seeds that of one",
        "parameter has a standard deviation of 22 %/sqrt(n), so the lowest of several lies below 95 % by chance.",
        "Joint: the same in every direction of the parameters (sqrt of the mean of e' C^-1 e / number of parameters);",
        "it sees errors that hide where the estimates of two parameters are correlated.",
        "Target: rmse/bound at most 1.1, coverage 93 to 97 %.",
        "",
        markdown.table(summary),
        "",
        "![rmse over bound](efficiency.png)",
        "",
    ]
    for name, rows in found.items():
        lines += _details(CASES[name], rows)
    write("efficiency.md", "\n".join(lines))
    figure(found)


def _details(case: Case, rows: pd.DataFrame) -> list[str]:
    lines = [f"## {case.title}", ""]
    for method, part in rows.groupby("method", sort=False):
        n = part["seed"].nunique()
        shown = scores(part).to_string(
            float_format=lambda v: f"{v:.4g}", index_names=False
        )
        spread = np.sqrt(0.95 * 0.05 / n)
        lines += [
            f"{method}: {n} seeds, {failures(part)} failed; joint rmse/bound {joint(part)}; by chance "
            f"rmse/bound +- {1 / np.sqrt(2 * n):.3f}, "
            f"coverage +- {spread:.1%}",
            "",
            "```text",
            shown,
            "```",
            "",
        ]
        reasons = part[part["outcome"] != "solved"].groupby("outcome")["seed"].nunique()
        lines += [f"- {count} x {reason}" for reason, count in reasons.items()] + (
            [""] if len(reasons) else []
        )
    return lines if case.one_step else [*lines, "one-step: needs all states", ""]


def _verdict(rows: pd.DataFrame) -> str:
    parts = []
    for method, part in rows.groupby("method", sort=False):
        s = scores(part)
        parts.append(
            f"{method}: rmse/bound {s['rmse/bound'].min():.3f} to {s['rmse/bound'].max():.3f}, "
            f"joint {joint(part)}, coverage {s['coverage'].mean():.3f}, failed {failures(part)}"
        )
    return "; ".join(parts)


def figure(found: dict[str, pd.DataFrame]) -> None:
    """rmse over bound, worst parameter, over the noise level of the Duffing oscillator."""
    import matplotlib
    import matplotlib.ticker

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(8.5, 4.2), layout="constrained")
    lines = {
        ("one-step", "qp"): ("one-step loss, q and p measured", "s-"),
        ("likelihood", "qp"): ("maximum likelihood, q and p measured", "o-"),
        ("likelihood", "q"): ("maximum likelihood, q alone measured", "^--"),
    }
    for (method, channels), (label, style) in lines.items():
        names = {noise: f"duffing_{channels}_{noise:g}" for noise in NOISE_LEVELS}
        points = {noise: found[name] for noise, name in names.items() if name in found}
        if not points:
            continue
        worst = [
            scores(rows[rows["method"] == method])["rmse/bound"].max()
            for rows in points.values()
        ]
        ax.plot(
            [100 * noise for noise in points],
            worst,
            style,
            color=COLOURS[method],
            label=label,
        )
    for level, style, label in (
        (1.0, "-", "Cramer-Rao bound"),
        (1.1, ":", "target: 1.1"),
    ):
        ax.axhline(level, color="0.4", ls=style, lw=1, label=label)
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="noise (% of each channel's standard deviation)",
    )
    ax.set_ylabel("rmse / bound, worst parameter")
    ticks = (0.8, 0.9, 1.0, 1.1, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
    low, high = ax.get_ylim()
    shown = [tick for tick in ticks if low <= tick <= high]
    ax.set_yticks(shown, [f"{tick:g}" for tick in shown])
    ax.yaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    ax.set_xticks(
        [100 * noise for noise in NOISE_LEVELS],
        [f"{100 * noise:g}" for noise in NOISE_LEVELS],
        minor=False,
    )
    ax.set_title("Driven Duffing oscillator, 501 samples")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    fig.savefig(RESULTS / "efficiency.png", dpi=150)
    plt.close(fig)


if __name__ == "__main__":
    experiments = chosen() or None
    if flag("page"):
        page()
    elif flag("quick"):
        for case_name, case_rows in quick(experiments).items():
            print(f"{case_name}: {_verdict(case_rows)}")
    else:
        seeds = int(option("seeds", "0")) or None
        main(experiments, seeds, int(option("jobs", "2")))
