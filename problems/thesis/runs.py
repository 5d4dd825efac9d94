"""Runs: a model from a set of data by some method, and what it is worth."""

import time
from collections.abc import Callable, Iterable
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
)
from problems.thesis.systems import System


@dataclass(frozen=True, eq=False)
class Setting:
    """What models are made from, and what they are compared with.

    Attributes:
        system: with its truth.
        data: what they are made from.
        tests: times, and states from unseen starts, which they have to predict.
    """

    system: System
    data: ph.Measurements
    tests: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Done:
    """A model of a setting, or the error that was raised.

    Attributes:
        setting: of the model.
        row: its line of the table.
        result: the model, or the error.
        curve: l2 error of its free runs over time (n_samples,).
    """

    setting: Setting
    row: dict[str, Any]
    result: Any
    curve: np.ndarray

    @property
    def is_model(self) -> bool:
        """Whether there is a result."""
        return not isinstance(self.result, ph.PhsiOptError)

    @property
    def method(self) -> str:
        """How it was made, as the table says."""
        return str(self.row["method"])


def done(setting: Setting, make: Callable[[], Any], **keys: object) -> Done:
    """Make and score one model, in processor seconds; its line begins with the keys,
    and is printed.
    """
    began = time.process_time()
    result = attempted(make)
    system, t = setting.system, setting.tests[0]
    row: dict[str, Any] = {**keys, "largest error": np.nan, "relative error": 1.0}
    row |= {"spurious": 0, "missed": len(system.truth), "covered": np.nan}
    row |= {"loss": np.nan, "l2 inside": np.inf, "l2 whole": np.inf}
    row |= {"seconds": time.process_time() - began, "remark": ""}
    curve = np.full(len(t), np.inf)
    if isinstance(result, ph.PhsiOptError):
        row["remark"] = str(result)[:100]
    else:
        found = score(system, result)
        curve = free_run(result, *setting.tests)
        is_inside = t <= system.n_steps * system.step + 1e-9  # of the training
        row |= {"largest error": found.largest, "relative error": found.relative}
        row |= {"l2 inside": curve[is_inside].mean(), "l2 whole": curve.mean()}
        row |= {"spurious": len(found.spurious), "missed": len(found.missed)}
        row |= {"loss": phsi_loss(result, setting.data)}
        errors = result.std_errors
        known = [n for n in system.truth if np.isfinite(errors.get(n, np.nan))]
        row["covered"] = coverage(system, result, known)
    print("...", *row.values(), sep=", ", flush=True)
    return Done(setting, row, result, curve)


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
