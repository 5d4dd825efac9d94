"""How close do the estimates come to the Cramer-Rao bound, and do the intervals hold
what they promise? And along chaotic motions, where the bound is out of reach?

    python -m problems.benchmarks.efficiency.run [--quick] [--jobs=N] [experiment ...]

--quick: a seed of some experiments; nothing is written.
"""

import time
from collections.abc import Sequence

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.benchmarks import chaos
from problems.benchmarks.efficiency.cases import CASES
from problems.tools.command_line import chosen, flag
from problems.tools.intervals import HALF_WIDTH, share
from problems.tools.pages import publish, render
from problems.tools.workers import computed

LIKELIHOOD, ONE_STEP = "likelihood", "one-step"
QUICK = ("duffing_qp_0.1", "duffing_q_0.1_gaps", "lorenz_xyz")
N_CHAOTIC = 6  # seeds of a chaotic system
SEEDS_APART = 1000  # more than any experiment has

Task = tuple[str, int]  # experiment and seed


def first_seed(name: str) -> int:
    """Every experiment draws from seeds of its own, so that their errors are
    independent.
    """
    return 5000 + SEEDS_APART * [*CASES, *chaos.EXPERIMENTS].index(name)


def fits(task: Task) -> pd.DataFrame:
    """All methods on the data of one seed: a row per method and parameter."""
    name, seed = task
    if name in chaos.EXPERIMENTS:
        system = chaos.EXPERIMENTS[name]
        known = pd.DataFrame({"truth": system.truth})
        own = ph.MaximumLikelihood(steps=system.steps)
        found = _attempt(system.model(), system.data(seed), own)
        return known.join(found).assign(experiment=name, seed=seed, method=LIKELIHOOD)
    case = CASES[name]
    data, bound, efficient = case.sample(seed)
    known = pd.DataFrame({"truth": case.system().truth})
    known = known.assign(bound=bound, efficient=efficient)
    losses: dict[str, ph.MaximumLikelihood | ph.PHSILoss]
    losses = {LIKELIHOOD: ph.MaximumLikelihood()}
    if case.one_step:
        losses[ONE_STEP] = ph.PHSILoss()
    parts = []
    for method, loss in losses.items():
        found = _attempt(case.model(), data, loss)
        parts.append(known.join(found).assign(method=method))
    return pd.concat(parts).assign(experiment=name, seed=seed)


def _attempt(
    model: ph.Model, data: ph.Measurements, loss: ph.MaximumLikelihood | ph.PHSILoss
) -> pd.DataFrame:
    """Estimates and standard errors; none where the fit failed."""
    began = time.process_time()
    try:
        fit = ph.identify(model, data, loss)
        found = pd.DataFrame({"estimate": fit.values, "std_error": fit.std_errors})
    # Whatever goes wrong is a fit that failed, and is counted.
    except Exception as error:
        print(f"{type(error).__name__}: {str(error)[:200]}", flush=True)
        found = pd.DataFrame(columns=["estimate", "std_error"], dtype=float)
    return found.assign(seconds=time.process_time() - began)


def scores(rows: pd.DataFrame) -> pd.DataFrame:
    """A row per parameter of one method.

    Errors over the bound of their own seed, and over the standard error; no estimate or
    no standard error is an interval that does not contain the truth.
    """
    error = rows["estimate"] - rows["truth"]
    bound = rows.get("bound", rows["std_error"])
    efficient = rows.get("efficient", error)
    rows = rows.assign(
        square=(error / bound) ** 2,
        excess=(error**2 - efficient**2) / bound**2,
        z=error.abs() / rows["std_error"],
        covered=error.abs() <= HALF_WIDTH * rows["std_error"],
        relative=error.abs() / rows["truth"].abs(),
    )
    by = rows.groupby(rows.index, sort=False)
    return pd.DataFrame(
        {
            "ratio": np.sqrt(by["square"].mean()),
            "beside": np.sqrt(np.maximum(1 + by["excess"].mean(), 0.0)),
            "covered": by["covered"].sum(),
            "n": by["covered"].size(),
            "z": by["z"].max(),
            "relative": by["relative"].median(),
        }
    )


def line(name: str, rows: pd.DataFrame) -> dict[str, object]:
    """The line of an experiment on the page."""
    system = CASES.get(name) or chaos.EXPERIMENTS[name]
    likelihood = rows[rows["method"] == LIKELIHOOD]
    found = scores(likelihood)
    n_seeds = likelihood["seed"].nunique()
    failed = likelihood.groupby("seed")["estimate"].first().isna().sum()
    shown: dict[str, object] = {"experiment": system.title, "seeds": n_seeds}
    shown["failed"] = int(failed)
    if name in CASES:
        by_chance = 1 / np.sqrt(2 * n_seeds)
        shown["worst rmse / bound"] = f"{found['ratio'].max():.3f} +- {by_chance:.3f}"
        shown["beside the efficient estimate"] = f"{found['beside'].max():.3f}"
    else:
        shown["median relative error, worst parameter"] = _worst(found["relative"])
        shown["largest error in standard errors"] = f"{found['z'].max():.2f}"
    shown["95 % intervals that contain the truth"] = share(
        int(found["covered"].sum()), int(found["n"].sum())
    )
    if name in CASES:
        one_step = rows[rows["method"] == ONE_STEP]
        ratio = f"{scores(one_step)['ratio'].max():.3g}" if len(one_step) else "-"
        shown["one-step loss: worst rmse / bound"] = ratio
    seconds = likelihood.groupby("seed")["seconds"].first().median()
    return shown | {"CPU s per fit": f"{seconds:.2g}"}


def _worst(relative: pd.Series) -> str:
    finite = relative[np.isfinite(relative)]
    return f"{finite.max():.2g}"


def page(found: dict[str, pd.DataFrame]) -> str:
    """The page as Markdown."""
    lengths = {}
    for name, system in chaos.EXPERIMENTS.items():
        lengths[name] = system.n_steps * system.step * system.lyapunov
    of_cases = [name for name in CASES if name in found]
    return render(
        "benchmarks/pages/efficiency.md",
        bounded=[line(name, found[name]) for name in of_cases],
        chaotic=[line(n, found[n]) for n in chaos.EXPERIMENTS if n in found],
        lyapunov=(min(lengths.values()), max(lengths.values())),
        noise=chaos.NOISE,
        start=chaos.START,
    )


def main(names: Sequence[str], quick: bool) -> None:
    """Some experiments or all; the page of all is written unless ``quick``."""
    sizes = {name: case.n_seeds for name, case in CASES.items()}
    sizes |= dict.fromkeys(chaos.EXPERIMENTS, N_CHAOTIC)
    tasks: dict[str, Task] = {}
    for name in names or (QUICK if quick else sizes):
        for k in range(1 if quick else sizes[name]):
            tasks[f"{name}, seed {first_seed(name) + k}"] = (name, first_seed(name) + k)
    parts = []
    for done in computed(fits, tasks, jobs=1 if quick else None):
        parts.append(done.result)
        print(f"... {done.key}", flush=True)
    rows = pd.concat(parts)
    found = {str(n): part for n, part in rows.groupby("experiment", sort=False)}
    publish("efficiency.md", page(found), not (quick or names))


if __name__ == "__main__":
    main(chosen(), flag("quick"))
