"""How often intervals contain the truth when something acts beside the model.

python -m problems.benchmarks.coverage [--quick] [--seeds=N] [--jobs=N]
"""

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

import phsi_opt as ph
from problems.benchmarks.oscillator import (
    TRUTH,
    Disturbance,
    Layout,
    cubic_coefficient,
    model,
    record,
)
from problems.tools.command_line import flag, option
from problems.tools.intervals import share
from problems.tools.pages import publish, render
from problems.tools.workers import computed

FIRST_SEED = 9000  # development used none above 320
N_SEEDS = 40
LEVEL = 0.95
SCENARIOS = {
    "none": Disturbance(),
    "OU 0.2 m/s^2, 1 s": Disturbance(force_size=0.2, force_time=1.0),
    "OU 0.05 m/s^2, 0.3 s": Disturbance(force_size=0.05, force_time=0.3),
    "OU 0.1 m/s^2, 5 s": Disturbance(force_size=0.1, force_time=5.0),
    "fixed cubic spring 1 %": Disturbance(cubic_share=0.01),
    "AR(1) noise 0.7": Disturbance(noise_correlation=0.7),
    "quantised": Disturbance(step=0.2, noise=0.02),
    "fixed cubic spring 3 %": Disturbance(cubic_share=0.03),
}
LAYOUTS = (Layout(1, 400), Layout(4, 200))
WHITE, DEFAULT = "white noise alone", "the package"

Batch = tuple[str, Layout, int]  # scenario, layout and seed


def fit_rows(batch: Batch) -> list[dict[str, object]]:
    """The intervals of one fit, a row per parameter and way; a fit that fails has
    none, and contains nothing.
    """
    scenario, layout, seed = batch
    head: dict[str, object] = {"beside the model": scenario}
    head["runs"] = f"{layout.runs} x {layout.samples}"
    rows: list[dict[str, object]] = []
    try:
        fit = ph.identify(model(), record(seed, SCENARIOS[scenario], layout))
        intervals, errors = fit.intervals(LEVEL), fit.standard_errors
    except ph.PhsiOptError:
        for way in (WHITE, DEFAULT):
            rows += [head | {"way": way, "parameter": n, "held": False} for n in TRUTH]
        return rows
    freedom = max(fit.n_values - len(fit.names), 1)
    quantile = float(student_t.isf((1 - LEVEL) / 2, freedom))
    for name, truth in TRUTH.items():
        upper, lower = intervals["ci_upper"][name], intervals["ci_lower"][name]
        halves = {WHITE: quantile * float(errors["white noise"][name])}
        halves[DEFAULT] = (upper - lower) / 2
        for way, half in halves.items():
            row = head | {"way": way, "parameter": name, "half": half}
            is_held = abs(fit.estimates[name] - truth) <= half
            rows.append(row | {"held": bool(is_held)})
    return rows


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A line per scenario and layout: shares of intervals that contain the truth, and
    how much wider those of the package are.
    """
    lines = []
    for (scenario, runs), part in rows.groupby(
        ["beside the model", "runs"], sort=False
    ):
        line: dict[str, object] = {"beside the model": scenario, "runs": runs}
        by_way = dict(iter(part.groupby("way")))
        for way in (WHITE, DEFAULT):
            held = by_way[way]["held"]
            line[way] = share(int(held.sum()), len(held))
            by = 100 * by_way[way].groupby("parameter")["held"].mean()
            line[f"{way}: k / R_v / g, %"] = " / ".join(f"{by[n]:.0f}" for n in TRUTH)
        widths = np.median(by_way[DEFAULT]["half"]) / np.median(by_way[WHITE]["half"])
        lines.append(line | {"width over white": f"{widths:.2f}"})
    return pd.DataFrame(lines)


def main(quick: bool) -> None:
    """All fits; the page is written unless ``quick``."""
    n_seeds = 2 if quick else int(option("seeds", str(N_SEEDS)))
    first = 0 if quick else FIRST_SEED
    layouts = (Layout(1, 100),) if quick else LAYOUTS
    batches = {}
    for layout in layouts:
        for scenario in SCENARIOS:
            for seed in range(first, first + n_seeds):
                batches[f"{scenario}, {layout}, {seed}"] = (scenario, layout, seed)
    rows = []
    for done in computed(fit_rows, batches, jobs=1 if quick else None):
        rows += done.result
    publish("coverage.md", page(pd.DataFrame(rows), first, n_seeds), not quick)


def page(rows: pd.DataFrame, first: int, n_seeds: int) -> str:
    """The page as Markdown."""
    return render(
        "benchmarks/pages/coverage.md",
        summary=summary(rows),
        level=LEVEL,
        first=first,
        n_seeds=n_seeds,
        cubic=cubic_coefficient(SCENARIOS["fixed cubic spring 3 %"].cubic_share),
        n_failed=int(rows["half"].isna().sum() / (2 * len(TRUTH))),
    )


if __name__ == "__main__":
    main(flag("quick"))
