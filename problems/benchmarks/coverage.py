"""How often intervals hold the truth when something acts beside the model.

    python -m problems.benchmarks.coverage [--first=SEED] [--seeds=N] [--page]
        [--jobs=N] [--scheduler=ADDRESS]

Fits are kept in results/coverage_fits.csv batch by batch: the same command takes up a
run that was cut short. After a change of what is estimated move that file away, or fits
of two kinds are told together; the page names their commits. With --page no fit is
made: the page is written from what is kept.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binom
from scipy.stats import t as student_t

import phsi_opt as ph
from phsi_opt.model_error.disturbances import LINEAR_SHARE
from phsi_opt.sweeps.sweep import sweep
from problems.benchmarks.oscillator import (
    KINDS,
    TRUTH,
    Disturbance,
    Layout,
    cubic_coefficient,
    detectability,
    estimate_limits,
    kind_of,
    model,
    records,
)
from problems.tools import provenance
from problems.tools.command_line import flag, option
from problems.tools.intervals import wilson
from problems.tools.kept_tables import append_rows, rewrite
from problems.tools.pages import render
from problems.tools.workers import workers

FIRST_SEED = 9000  # development used none above 320; 5000 to 7000 were told before
N_SEEDS = 200
DRAWN = "nonlinearity 1 to 5 %"
UNDISTURBED = "none"
SCENARIOS = {
    UNDISTURBED: Disturbance(),
    "OU 0.2 m/s^2, 1 s": Disturbance(force_size=0.2, force_time=1.0),
    "OU 0.05 m/s^2, 0.3 s": Disturbance(force_size=0.05, force_time=0.3),
    "OU 0.1 m/s^2, 5 s": Disturbance(force_size=0.1, force_time=5.0),
    DRAWN: Disturbance(drawn_shares=(0.01, 0.05)),
    "cubic spring 1 %": Disturbance(cubic_share=0.01),
    "cubic spring 3 %": Disturbance(cubic_share=0.03),
    "cubic spring 5 %": Disturbance(cubic_share=0.05),
    "AR(1) noise 0.7": Disturbance(noise_correlation=0.7),
    "quantised": Disturbance(step=0.2, noise=0.02),
}
# Always the same nonlinearity, so always the same bias: a stress test.
FIXED = [name for name, found in SCENARIOS.items() if found.cubic_share]
ASKED_FOR = [name for name in SCENARIOS if name not in (*FIXED, UNDISTURBED)]
DEFAULT = "default"
WITH_FORCE = "model_error=True"
PLAIN = "plain likelihood"
METHODS = {PLAIN: DEFAULT, DEFAULT: DEFAULT, WITH_FORCE: WITH_FORCE}
WHITE = "white noise"  # the source of standard errors that no model error widens
SOURCES = (WHITE, "model error", "scatter between trajectories")
PHYSICAL = "physical"
LIMIT = "limit of the estimate"
BATCH = 20  # seeds that are simulated at once
LEVEL = 0.95
LOWEST, HIGHEST = 92.0, 97.0  # %, of the coverage that is asked for
SAME_WIDTH = 0.05  # share by which an interval may differ where nothing is to be lost


@dataclass(frozen=True)
class Job:
    """Fits in one way of the records of one kind."""

    scenario: str
    layout: Layout
    method: str

    @property
    def key(self) -> dict[str, object]:
        """Its cells of a row."""
        runs, samples = self.layout.runs, self.layout.samples
        names = {"scenario": self.scenario, "runs": runs, "samples": samples}
        return names | {"method": self.method}

    def of(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Its rows."""
        return rows[(rows[list(self.key)] == pd.Series(self.key)).all(axis=1)]


KEY = [*Job("", Layout(0, 0), "").key]
COLUMNS = [*KEY, "seed", "parameter", "estimate", "std_error"]
COLUMNS += ["half", "white", "white_half", "source", "commit"]
ONE, SEVERAL, MANY = Layout(1, 400), Layout(4, 200), Layout(16, 100)
WAYS = (
    (ONE, DEFAULT),
    (SEVERAL, DEFAULT),
    (ONE, WITH_FORCE),
    (MANY, DEFAULT),
    (SEVERAL, WITH_FORCE),
)
N_FIRST = 2  # of these ways, those that come first
JOBS = [Job(scenario, *way) for way, scenario in product(WAYS, SCENARIOS)]


# --- the fits


def make_all(seeds: Sequence[int], path: Path) -> None:
    """All fits that are missing; a run that is cut short has its scenarios alike.

    The default comes first, in one run and several, springs of fixed size after all
    that is drawn.
    """
    drawn = [name for name in SCENARIOS if name not in FIXED]
    wanted: list[tuple[Job, Sequence[int]]] = []
    for ways, scenarios in product((WAYS[:N_FIRST], WAYS[N_FIRST:]), (drawn, FIXED)):
        for first in range(0, len(seeds), BATCH):
            batch = seeds[first : first + BATCH]
            jobs = (Job(name, *way) for way, name in product(ways, scenarios))
            wanted += [(job, batch) for job in jobs]
    make(wanted, path)


def make(wanted: Sequence[tuple[Job, Sequence[int]]], path: Path) -> None:
    """Make the fits that are missing, side by side, and keep each batch when made."""
    rows = kept(path)
    missing = {}
    for job, seeds in wanted:
        counts = job.of(rows)["seed"].value_counts()
        absent = tuple(s for s in seeds if counts.get(s, 0) < len(TRUTH))
        if absent:
            head = ", ".join(map(str, job.key.values()))
            missing[f"{head}, seeds {absent[0]} to {absent[-1]}"] = (job, absent)
    jobs = 1 if len(missing) == 1 else None
    with workers(jobs) as executor:
        for done in sweep(_made, missing, executor=executor, progress=_say):
            append_rows(path, pd.DataFrame(done.result, columns=COLUMNS), "%.6g")


def _say(line: str) -> None:
    print(line, flush=True)


def _made(batch: tuple[Job, tuple[int, ...]]) -> list[dict[str, object]]:
    job, seeds = batch
    data = records(list(seeds), SCENARIOS[job.scenario], job.layout)
    rows = []
    for seed, record in zip(seeds, data, strict=True):
        rows += fit_rows(job, seed, record)
    return rows


def fit_rows(job: Job, seed: int, data: ph.Measurements) -> list[dict[str, object]]:
    """The parameters of one fit; without numbers where it failed."""
    loss = ph.MaximumLikelihood(model_error=job.method == WITH_FORCE)
    head = {**job.key, "seed": seed, "commit": provenance.commit()}
    try:
        fit = ph.identify(model(), data, loss)
    except ph.PhsiOptError as error:
        reason = type(error).__name__
        return [{**head, "parameter": name, "source": reason} for name in TRUTH]
    intervals, errors = fit.intervals(LEVEL), fit.standard_errors
    white_freedom = max(fit.n_values - len(fit.names), 1)
    quantile = float(student_t.isf((1 - LEVEL) / 2, white_freedom))
    rows = []
    for name in TRUTH:
        width = intervals["ci_upper"][name] - intervals["ci_lower"][name]
        white = float(errors[WHITE][name])
        row = {**head, "parameter": name, "estimate": float(fit.estimates[name])}
        row |= {"std_error": float(errors["std_error"][name]), "half": width / 2}
        row |= {"white": white, "white_half": quantile * white}
        rows.append(row | {"source": str(fit.std_error_source)})
    return rows


def kept(path: Path) -> pd.DataFrame:
    """The rows of all fits that were made, each once."""
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    rows = pd.read_csv(path, keep_default_na=False, na_values=[""])
    return rows.drop_duplicates([*KEY, "seed", "parameter"])


# --- what they say


def summary(fits: pd.DataFrame) -> pd.DataFrame:
    """A row per scenario, runs, method, truth and parameter, of all fits."""
    found = fits[KEY].drop_duplicates().to_dict("records")
    jobs: list[Job] = []
    for key in found:
        layout = Layout(int(key["runs"]), int(key["samples"]))
        jobs.append(Job(str(key["scenario"]), layout, str(key["method"])))
    places = {job: k for k, job in enumerate(JOBS)}
    jobs.sort(key=lambda job: places.get(job, len(JOBS)))
    rows = []
    for job in jobs:
        of_job = job.of(fits)
        for method in (m for m, made_by in METHODS.items() if made_by == job.method):
            for kind, truth in truths(job).items():
                for name, value in truth.items():
                    row = {**job.key, "truth": kind, "parameter": name}
                    del row["method"]
                    row |= {"method": method, "value": value}
                    own = of_job[of_job["parameter"] == name]
                    rows.append(row | measures(own, value, method == PLAIN))
    return pd.DataFrame(rows)


def truths(job: Job) -> dict[str, dict[str, float]]:
    """What an interval may be asked to hold: two truths where the model is wrong."""
    disturbance = SCENARIOS[job.scenario]
    if not disturbance.cubic_share:
        return {PHYSICAL: TRUTH}
    limit = estimate_limits(disturbance, job.layout.samples)
    return {PHYSICAL: TRUTH, LIMIT: limit}


def measures(fits: pd.DataFrame, truth: float, is_plain: bool) -> dict[str, object]:
    """Coverage, distances and widths of one parameter.

    A fit that failed holds no truth; distances and widths are those of the others.

    Args:
        fits: a row per fit.
        truth: what the intervals should hold.
        is_plain: whether intervals and standard errors count residuals as white noise.
    """
    half = fits["white_half" if is_plain else "half"]
    std_error = fits["white" if is_plain else "std_error"]
    distance = fits["estimate"] - truth
    is_held = distance.abs() <= half
    n, n_held = len(fits), int(is_held.sum())
    lower, upper = wilson(n_held, n)
    ratio = half / fits["white_half"]
    is_white = fits["source"] == WHITE
    return {
        "n": n,
        "n_failed": int(fits["estimate"].isna().sum()),
        "coverage": 100 * n_held / n,
        "coverage_lower": 100 * lower,
        "coverage_upper": 100 * upper,
        "rms_z": _root_mean_square(distance / std_error),
        "bias": float(distance.mean()),
        "rms_error": _root_mean_square(distance),
        "median_half_width": float(half.median()),
        "median_width_ratio": float(ratio.median()),
        "mean_width_ratio": float(half.mean() / fits["white_half"].mean()),
        "same_width": 100 * float((abs(ratio - 1) <= SAME_WIDTH).mean()),
        **{
            source: np.nan
            if is_plain
            else 100 * float((fits["source"] == source).mean())
            for source in SOURCES
        },
        "coverage_if_white": 100 * float(is_held[is_white].mean()),
        "coverage_if_more": 100 * float(is_held[~is_white].mean()),
    }


def _root_mean_square(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- the page


def page(rows: pd.DataFrame, fits: pd.DataFrame) -> str:
    """The page in Markdown, of `summary` and of the fits."""
    asked = rows[rows["scenario"].isin([*ASKED_FOR, UNDISTURBED])]
    fixed = rows[rows["scenario"].isin(FIXED)]
    once = rows[rows["truth"] == PHYSICAL]  # what does not depend on the truth
    groups = verdict_rows(rows, ASKED_FOR)
    undisturbed = once[once["scenario"] == UNDISTURBED]
    own = undisturbed[undisturbed["method"] == DEFAULT]
    of_k = once[(once["scenario"] == DRAWN) & (once["parameter"] == "k")]
    seen, smallest = detectability_rows(fits)
    return render(
        "benchmarks/pages/coverage.md",
        limits=(LOWEST, HIGHEST),
        level=LEVEL,
        same_width=SAME_WIDTH,
        within=_within(rows),
        same=own.groupby("runs")["same_width"].min(),
        name_of=_name_of,
        groups=groups,
        seeds=(fits["seed"].min(), fits["seed"].max()),
        commits=sorted(set(fits["commit"].astype(str))),
        missing=_missing(rows),
        chances={n: chance_within(n) for n in sorted(set(rows["n"]), reverse=True)},
        coverages=table(asked, _coverage),
        has_drawn=DRAWN in set(rows["scenario"]),
        linear_share=LINEAR_SHARE,
        widths={
            runs: part.set_index("method")
            for runs, part in of_k.groupby("runs")
            if DEFAULT in set(part["method"])
        },
        by_kind=by_kind(fits),
        fixed_groups=verdict_rows(rows, FIXED, (PHYSICAL, LIMIT)),
        fixed=table(fixed, _coverage),
        first_fixed=FIXED[0],
        coefficients={s: cubic_coefficient(SCENARIOS[s].cubic_share) for s in FIXED},
        seen=seen,
        smallest=smallest,
        table_of=lambda column, form: table(rows, _numbers(column, form)),
        width_table=table(once, _numbers("median_width_ratio", ".2f")),
        sources=_sources(once),
        undisturbed=_undisturbed(undisturbed[undisturbed["method"] != PLAIN]),
    )


def _within(rows: pd.DataFrame) -> dict[str, tuple[int, int]]:
    """How many coverages lie within the limits, and of how many, by method."""
    found: dict[str, tuple[int, int]] = {}
    for _, group in _groups(rows, ASKED_FOR, (PHYSICAL,)):
        method = group["method"].iloc[0]
        n_within, n = found.get(method, (0, 0))
        is_within = group["coverage"].between(LOWEST, HIGHEST)
        found[method] = (n_within + int(is_within.sum()), n + len(group))
    return {method: found[method] for method in METHODS if method in found}


def _name_of(runs: int) -> str:
    return "one run" if runs == 1 else f"{runs} runs"


def table(
    rows: pd.DataFrame, cell: Callable[[pd.DataFrame], str]
) -> list[dict[str, object]]:
    """Scenarios, runs and, where there are two, truths in rows; methods in columns."""
    has_truth = rows["truth"].nunique() > 1
    places = {name: k for k, name in enumerate(SCENARIOS)}
    ordered = rows.assign(place=rows["scenario"].map(places))
    ordered["limit"] = ordered["truth"] == LIMIT
    ordered = ordered.sort_values(["place", "limit", "runs"], kind="stable")
    keys = ["scenario", "truth", "runs", "samples"]
    lines = []
    for (scenario, truth, runs, samples), part in ordered.groupby(keys, sort=False):
        line = {"beside the model": scenario, "runs": f"{runs} x {samples}"}
        line |= {"truth": truth} if has_truth else {}
        for method in METHODS:
            own = part[part["method"] == method]
            line[method] = "-" if own.empty else cell(own)
        lines.append(line)
    return lines


def _numbers(column: str, form: str) -> Callable[[pd.DataFrame], str]:
    """A column's numbers of all parameters."""

    def cell(found: pd.DataFrame) -> str:
        by_parameter = found.set_index("parameter")[column]
        if by_parameter.isna().all():
            return "-"
        return " / ".join(format(by_parameter[name], form) for name in TRUTH)

    return cell


def _coverage(found: pd.DataFrame) -> str:
    return f"{_numbers('coverage', '.1f')(found)} (n {found['n'].iloc[0]})"


def verdict_rows(
    rows: pd.DataFrame, scenarios: Sequence[str], truths: Sequence[str] = (PHYSICAL,)
) -> list[dict[str, Any]]:
    """How many coverages lie within, by truth, runs and method, and which do not;
    scenarios that were cut short are left out.
    """
    lines = []
    for truth, group in _groups(rows, scenarios, truths):
        coverage, n = group["coverage"], int(group["n"].max())
        n_within = int(coverage.between(LOWEST, HIGHEST).sum())
        ends = [wilson(round(c / 100 * n), n) for c in coverage]
        meeting = sum(100 * low <= HIGHEST and 100 * up >= LOWEST for low, up in ends)
        below = group[coverage < LOWEST]["scenario"].unique()
        above = group[coverage > HIGHEST]["scenario"].unique()
        first = group.iloc[0]
        line = {
            "method": first["method"],
            "runs": f"{first['runs']} x {first['samples']}",
            "n": n,
            "within": f"{n_within} of {len(group)}",
            "of exact intervals": f"{len(group) * chance_within(n):.0f}",
            "interval meets": f"{meeting} of {len(group)}",
            "lowest, %": f"{coverage.min():.1f}",
            "highest, %": f"{coverage.max():.1f}",
            "too low in": "; ".join(below) or "-",
            "too high in": "; ".join(above) or "-",
        }
        lines.append(line | ({"truth": truth} if len(truths) > 1 else {}))
    return lines


def _groups(
    rows: pd.DataFrame, scenarios: Sequence[str], truths: Sequence[str]
) -> Iterator[tuple[str, pd.DataFrame]]:
    """Coverages of one method over records of one layout, as many seeds in each."""
    for truth in truths:
        chosen = rows[rows["scenario"].isin(list(scenarios)) & (rows["truth"] == truth)]
        for runs, method in product(sorted(set(chosen["runs"])), METHODS):
            found = chosen[(chosen["runs"] == runs) & (chosen["method"] == method)]
            if len(found):
                yield truth, found[found["n"] == found["n"].max()]


def chance_within(n: int) -> float:
    """Chance that intervals of 95 % are counted within the limits on n records."""
    lowest = int(np.ceil(LOWEST / 100 * n))
    highest = int(np.floor(HIGHEST / 100 * n))
    return float(binom.cdf(highest, n, LEVEL) - binom.cdf(lowest - 1, n, LEVEL))


def _missing(rows: pd.DataFrame) -> dict[str, Any]:
    """Jobs without fits, those with fewer than others, and how many fits failed."""
    ways: dict[str, dict[str, list[str]]] = {"absent": {}, "fewer": {}}
    for job in JOBS:
        found = job.of(rows)
        way = f"{job.method}, {job.layout.runs} x {job.layout.samples}"
        if found.empty:
            ways["absent"].setdefault(way, []).append(job.scenario)
        elif found["n"].iloc[0] < rows["n"].max():
            way += f", n {found['n'].iloc[0]}"
            ways["fewer"].setdefault(way, []).append(job.scenario)
    said: dict[str, Any] = {}
    for kind, found_ways in ways.items():
        # Scenarios go without saying where they are all.
        said[kind] = ". ".join(
            way if len(names) == len(SCENARIOS) else f"{way} ({'; '.join(names)})"
            for way, names in found_ways.items()
        )
    by_fit = rows.drop_duplicates(["scenario", "runs", "method"])
    return said | {"failed": int(by_fit["n_failed"].sum())}


def _by_layout(fits: pd.DataFrame) -> Any:
    return fits.groupby(["runs", "samples"])


def by_kind(fits: pd.DataFrame) -> list[dict[str, object]]:
    """Coverage of the default in %, by the kind that a seed drew."""
    lines = []
    drawn = fits[(fits["scenario"] == DRAWN) & (fits["method"] == DEFAULT)]
    for (runs, samples), part in _by_layout(drawn):
        layout = Layout(runs, samples)
        distance = (part["estimate"] - part["parameter"].map(TRUTH)).abs()
        part = part.assign(
            kind=[kind_of(seed, layout) for seed in part["seed"]],
            held=distance <= part["half"],
        )
        for kind in KINDS:
            own = part[part["kind"] == kind]
            if len(own):
                shares = 100 * own.groupby("parameter")["held"].mean()
                more = 100 * (own["source"] != WHITE).mean()
                lines.append(
                    {
                        "runs": f"{runs} x {samples}",
                        "kind": kind,
                        "n": own["seed"].nunique(),
                        "k / R_v / g": " / ".join(f"{shares[n]:.0f}" for n in TRUTH),
                        "more than white noise found, %": f"{more:.0f}",
                    }
                )
    return lines


def detectability_rows(
    fits: pd.DataFrame,
) -> tuple[list[dict[str, object]], dict[str, float] | None]:
    """How well any test could see the springs, and how many were found; and of the
    smallest spring in one run what follows for intervals.
    """
    lines = []
    smallest = None
    of_default = fits[fits["method"] == DEFAULT].drop_duplicates([*KEY, "seed"])
    for scenario in FIXED:
        disturbance = SCENARIOS[scenario]
        chosen = of_default[of_default["scenario"] == scenario]
        for (runs, samples), part in _by_layout(chosen):
            layout = Layout(runs, samples)
            seen = detectability(part["seed"].tolist(), disturbance, layout)
            bias = seen.bias / seen.std_error
            limit = estimate_limits(disturbance, layout.samples)["k"]
            from_limit = abs(seen.bias - (limit - TRUTH["k"])) / seen.std_error
            power, found = seen.power.mean(), float((part["source"] != WHITE).mean())
            lines.append(
                {
                    "beside the model": scenario,
                    "runs": f"{runs} x {samples}",
                    "n": len(part),
                    "square root of noncentrality": _spread(seen.noncentrality**0.5),
                    "power, %": f"{100 * power:.0f}",
                    "found by the default, %": f"{100 * found:.0f}",
                    "bias of k, standard errors": _spread(bias),
                    "the same, from the limit": _spread(from_limit),
                }
            )
            if scenario == FIXED[0] and runs == 1:
                smallest = {"power": 100 * power, "found": 100 * found}
                smallest |= {"bias": float(np.median(bias)), "least": bias.min()}
    return lines, smallest


def _spread(values: np.ndarray) -> str:
    lower, median, upper = np.quantile(values, [0.1, 0.5, 0.9])
    return f"{median:.1f} ({lower:.1f} to {upper:.1f})"


def _sources(rows: pd.DataFrame) -> list[dict[str, object]]:
    """Shares of the seeds in percent."""
    chosen = rows[rows["method"] != PLAIN]
    return [
        {
            "beside the model": row["scenario"],
            "runs": f"{row['runs']} x {row['samples']}",
            "method": row["method"],
            "n": row["n"],
            **{f"{source}, %": f"{row[source]:.1f}" for source in SOURCES},
        }
        for _, row in chosen.drop_duplicates(["scenario", "runs", "method"]).iterrows()
    ]


def _undisturbed(rows: pd.DataFrame) -> list[dict[str, object]]:
    """Widths of the intervals where nothing is to be lost."""
    return [
        {
            "runs": f"{row['runs']} x {row['samples']}",
            **row[["method", "parameter", "n"]],
            "median": f"{row['median_width_ratio']:.3f}",
            "mean": f"{row['mean_width_ratio']:.3f}",
            "within 5 %, %": f"{row['same_width']:.1f}",
        }
        for _, row in rows.iterrows()
    ]


def main() -> None:
    """The fits, the table and the page."""
    path = provenance.RESULTS / "coverage_fits.csv"
    if not flag("page"):
        first = int(option("first", str(FIRST_SEED)))
        make_all(range(first, first + int(option("seeds", str(N_SEEDS)))), path)
    fits = kept(path)
    rows = summary(fits)
    rewrite(provenance.RESULTS / "coverage.csv", rows, "%.6g")
    provenance.write("coverage.md", page(rows, fits))


if __name__ == "__main__":
    main()
