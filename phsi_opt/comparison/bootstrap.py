"""The parametric bootstrap: the fit repeated on records that the fitted model draws.

What the curvature at one optimum cannot say (a bent valley, a bias, an optimum that
another draw of the noise would miss) shows in how the estimates scatter (Efron and
Tibshirani, An Introduction to the Bootstrap, 1993, chapter 6).
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.comparison.profile_likelihood import check_likelihood
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import parameter_matrix, parameters_of
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.model_content import model_content
from phsi_opt.estimation.smoothing import likelihood_of
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.presentation.summary import printed_table
from phsi_opt.sweeps.sweep import sweep
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.sensors import outputs_at_samples

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """The estimates of a fit, repeated on records drawn from it.

    Attributes:
        fit: The fit.
        estimates: A row per draw that could be fitted, its number as index, and a
            column per name of `Fit.estimates`.
        failed: Why the other draws could not be fitted, by number.
    """

    fit: Fit
    estimates: "pd.DataFrame"
    failed: Mapping[int, str]

    @cached_property
    def table(self) -> "pd.DataFrame":
        """A row per estimate, with its name as index.

        Columns: value (of the fit), std_error (of the fit), bootstrap_error (standard
        deviation of the draws), bias (mean of the draws less the value).
        """
        names = list(self.fit.estimates)
        table = printed_table({"value": self.fit.estimates}, index=names)
        table["std_error"] = [self.fit.std_errors[name] for name in names]
        table["bootstrap_error"] = self.estimates.std(ddof=1)
        table["bias"] = self.estimates.mean() - table["value"]
        return table

    def intervals(self, level: float = 0.95) -> "pd.DataFrame":
        """Percentile intervals: what lies in the middle of the draws.

        Args:
            level: Share of the draws within, between 0 and 1. For 0.95 take some
                hundred draws or more.

        Returns:
            A row per estimate with its name as index, and the columns value, ci_lower
            and ci_upper, as `Fit.intervals`.

        Raises:
            DataError: ``level`` does not lie between 0 and 1.
        """
        if not 0 < level < 1:
            raise DataError(f"level={level!r} must lie between 0 and 1, such as 0.95.")
        names = list(self.fit.estimates)
        table = printed_table({"value": self.fit.estimates}, index=names)
        table["ci_lower"] = self.estimates.quantile((1 - level) / 2)
        table["ci_upper"] = self.estimates.quantile((1 + level) / 2)
        return table

    def __str__(self) -> str:
        text = f"bootstrap of {len(self.estimates)} draws\n{self.table}"
        if self.failed:
            text += f"\n{len(self.failed)} draws could not be fitted (see failed)."
        return text

    __repr__ = __str__


@interruptible
def bootstrap(
    fit: Fit,
    data: Measurements,
    n_draws: int = 200,
    *,
    seed: int = 0,
    executor: Executor | None = None,
    folder: str | Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> Bootstrap:
    """Repeat a fit by `MaximumLikelihood` on records that the fitted model draws.

    A draw is the free run of the fit at the samples plus white noise of the fit's size,
    measured where the data are; the model is identified from it as from the data. The
    noise of a draw follows from ``seed`` and its number alone, so that neither the
    executor nor the order matters. (White noise: what else acts beside the model is in
    the fit's own standard errors, not in these.)

    Args:
        fit: By maximum likelihood, with its states: not loaded from a file.
        data: The measurements of the fit.
        n_draws: Number of records that are drawn, at least 2.
        seed: Of the noise.
        executor: Where to compute (see `sweep`); None: processes on this machine.
        folder: Where the draws' estimates are kept; a call that was interrupted goes
            on from there, and so does one with more draws.
        progress: Called with a line of text whenever a draw is done.

    Raises:
        ModelError: The fit has no likelihood, or forces in it.
        DataError: The fit has no states, the measurements are not those of the fit, or
            a number cannot be used.
        SolveError: Fewer than two draws could be fitted.
    """
    check_likelihood(fit, "bootstrap")
    if not fit.states:
        raise DataError(
            "the fit has no states, as one that was loaded from a file; identify it "
            "again from its measurements."
        )
    if n_draws < 2:  # of one no scatter can be taken
        raise DataError(f"n_draws={n_draws!r} must be 2 or more.")
    aligned = AlignedData.of(fit.model, data)
    data = aligned.data
    lengths = [run.n_samples for run in data.trajectories]
    if list(map(len, fit.states)) != lengths:
        raise DataError(
            f"the measurements have trajectories of {lengths} samples, the fit "
            f"{list(map(len, fit.states))}; give the measurements of the fit."
        )
    theta = parameter_matrix(fit.model, parameters_of(fit, data))
    # What the fitted model shows at the samples, (n_samples, n_channels) each.
    shown = outputs_at_samples(fit.model, aligned.grid, fit.states, theta)
    cut = [np.array(one[:, : data.n_states]) for one in shown]
    draw = partial(_drawn_estimates, fit.model, data, cut, dict(fit.noise))
    # What the draws follow from.
    content = {
        "model": model_content(fit.model),
        "by_trajectory": {name: dict(one) for name, one in fit.by_trajectory.items()},
        "noise": dict(fit.noise),
        "huber": fit.huber,
        "data": data.digest,
        "seed": seed,
    }
    text = json.dumps(content, sort_keys=True)
    seeds = np.random.SeedSequence(seed).spawn(n_draws)
    cases = {f"draw {number}": one for number, one in enumerate(seeds)}
    found: dict[int, Mapping[str, float]] = {}
    failed: dict[int, str] = {}
    for done in sweep(
        partial(draw, likelihood_of(fit)),
        cases,
        executor=executor,
        folder=folder,
        of=f"bootstrap {hashlib.sha256(text.encode()).hexdigest()}",
        progress=progress,
    ):
        number = int(done.key.removeprefix("draw "))
        if "failed" in done.result:
            failed[number] = done.result["failed"]
        else:
            found[number] = done.result["estimates"]
    if len(found) < 2:
        reason = next(iter(failed.values()), "")
        raise SolveError(f"{len(failed)} of {n_draws} draws have no fit: {reason}")
    rows = dict(sorted(found.items()))
    table = printed_table(rows.values(), index=list(rows), columns=list(fit.estimates))
    return Bootstrap(fit, table, dict(sorted(failed.items())))


def _drawn_estimates(
    model: Model,
    data: Measurements,
    shown: Sequence[np.ndarray],
    noise: Mapping[str, float],
    loss: MaximumLikelihood,
    seed: np.random.SeedSequence,
) -> dict[str, Any]:
    """The estimates of one draw by name; or why there are none.

    A draw is what the fitted model shows plus noise, measured where the data are.
    """
    rng = np.random.default_rng(seed)
    sigma = np.array([noise.get(name, 0.0) for name in data.states])
    runs = []
    for run, exact in zip(data.trajectories, shown, strict=True):
        noisy = exact + sigma * rng.normal(size=exact.shape)
        runs.append(replace(run, x=np.where(np.isnan(run.x), np.nan, noisy)))
    drawn = replace(data, trajectories=tuple(runs))
    try:
        fit = identify(model, drawn, loss)
    except PhsiOptError as error:
        return {"failed": f"{type(error).__name__}: {error}"}
    return {"estimates": dict(fit.estimates)}
