"""Runs: a model from a set of data by some method, and what it is worth."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.scores import (
    attempted,
    coverage,
    free_run,
    phsi_loss,
    score,
    trained,
)
from problems.thesis.systems import System

Tests = tuple[np.ndarray, np.ndarray]  # times, and states from unseen starts


@dataclass(frozen=True, eq=False)
class Run:
    """One model.

    Attributes:
        keys: Its cells of the table, such as system, data, method.
        system: With the truth that it is compared with.
        data: What it is made from.
        tests: Free runs that it has to predict.
        make: Makes the result.
    """

    keys: Mapping[str, object]
    system: System
    data: ph.Measurements
    tests: Tests
    make: Callable[[], Any]


@dataclass(frozen=True, eq=False)
class Done:
    """A run with its line of the table, its result (or the error that it raised), and
    the l2 error of its free runs over time (n_samples,).
    """

    run: Run
    row: dict[str, Any]
    result: Any
    curve: np.ndarray

    @property
    def is_model(self) -> bool:
        """Whether there is a result."""
        return not isinstance(self.result, ph.PhsiOptError)


def done(run: Run) -> Done:
    """Make and score one model, in processor seconds; beside its line it is said."""
    began = time.process_time()
    result = attempted(run.make)
    row: dict[str, Any] = {**run.keys, "largest error": np.nan, "relative error": 1.0}
    row |= {"spurious": 0, "missed": len(run.system.truth), "covered": np.nan}
    row |= {"loss": np.nan, "l2 inside": np.inf, "l2 whole": np.inf}
    row |= {"seconds": time.process_time() - began, "remark": ""}
    curve = np.full(len(run.tests[0]), np.inf)
    if isinstance(result, ph.PhsiOptError):
        row["remark"] = str(result)[:100]
    else:
        found = score(run.system, result)
        curve = free_run(result, *run.tests)
        is_inside = trained(run.system, run.tests[0])
        row |= {"largest error": found.largest, "relative error": found.relative}
        row |= {"l2 inside": curve[is_inside].mean(), "l2 whole": curve.mean()}
        if hasattr(result, "model"):
            row |= {**found.counts, "loss": phsi_loss(result, run.data)}
            errors = getattr(result, "std_errors", {})
            known = [n for n in run.system.truth if np.isfinite(errors.get(n, np.nan))]
            row["covered"] = coverage(run.system, result, known)
        else:  # a network has no terms
            row |= {"spurious": np.nan, "missed": np.nan, "loss": result.loss_value}
    print("...", *row.values(), sep=", ", flush=True)
    return Done(run, row, result, curve)


def table(found: Iterable[Done]) -> pd.DataFrame:
    """The lines of some runs."""
    return pd.DataFrame([one.row for one in found])


def medians(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Medians over what is not in ``by``, and how often the terms are the true ones."""
    is_exact = (rows["spurious"] == 0) & (rows["missed"] == 0)
    groups = rows.assign(exact=is_exact).groupby(by, sort=False)
    found = groups[["relative error", "l2 inside", "l2 whole", "seconds"]].median()
    found["spurious, mean"] = groups["spurious"].mean()
    found["missed, mean"] = groups["missed"].mean()
    found["exact terms"] = [
        f"{int(part.sum())} of {len(part)}" for _, part in groups["exact"]
    ]
    found["intervals that hold"] = groups["covered"].mean()
    return shown(found.reset_index())


def shown(rows: pd.DataFrame) -> pd.DataFrame:
    """Numbers with three digits, "-" where there is none; no empty column."""
    found = rows.dropna(axis="columns", how="all").copy()
    for name in found.columns:
        if found[name].dtype == float:
            found[name] = found[name].map(lambda v: "-" if np.isnan(v) else f"{v:.3g}")
    return found.loc[:, [(found[name] != "").any() for name in found.columns]]
