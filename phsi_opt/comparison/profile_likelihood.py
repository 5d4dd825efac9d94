"""How far an estimate may be off where the curvature at the optimum misleads.

The profile likelihood: how the best fit worsens as one parameter is held elsewhere. In
a bent valley, or near a bound, the interval in which the profile stays below the
threshold is the better one. Every point is a re-fit of all other parameters, started
from the one before (Venzon and Moolgavkar 1988).

The parametric bootstrap: the fit repeated on records that the fitted model draws. A
bent valley, a bias, or an optimum that another draw of the noise would miss shows in
how the estimates scatter (Efron and Tibshirani, An Introduction to the Bootstrap, 1993,
chapter 6).
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from scipy.optimize import brentq

from phsi_opt.arguments import require_known, require_share, typed
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError, PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit, parameters_of
from phsi_opt.estimation.fit_file import digest_of
from phsi_opt.estimation.free_runs import parameter_matrix
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.record import Record, likelihood_of, maximum_along, steps_on
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.presentation.summary import printed_table
from phsi_opt.sweeps.sweep import Progress, sweep
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.sensors import outputs_at_samples

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile of one parameter.

    Attributes:
        name: of the parameter.
        value: its estimate.
        level: of the interval, between 0 and 1.
        points: (n, 2) values of the parameter and rise of -2 log likelihood, with its
            priors, above the best fit, sorted by value.
        threshold: rise at the ends of the interval.
        ci_lower: lower end of the interval; infinite where the profile never reaches
            the threshold, the bound where a bound of the parameter comes first.
        ci_upper: the upper end.
        curvature: the interval from the standard error alone.
    """

    name: str
    value: float
    level: float
    points: np.ndarray
    threshold: float
    ci_lower: float
    ci_upper: float
    curvature: tuple[float, float]

    @property
    def is_curved(self) -> bool:
        """Whether an end of the interval differs from that of the standard error.

        By more than a tenth of the half width.
        """
        lower, upper = self.curvature
        half_width = (upper - lower) / 2
        shift = max(abs(self.ci_lower - lower), abs(self.ci_upper - upper))
        return not shift <= 0.1 * half_width

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """The profile and the parabola of the standard error, with the threshold."""
        from scipy.interpolate import PchipInterpolator

        from phsi_opt.presentation.charts import (
            FLOOR,
            MEASURED,
            MODEL,
            POINTS,
            Chart,
            Curve,
            Panel,
            drawn,
        )

        held, rise = self.points.T
        # The signed root of the rise is nearly straight, so a smooth curve goes through
        # few points.
        root = PchipInterpolator(held, np.sign(held - self.value) * np.sqrt(rise))
        inside = np.linspace(held[0], held[-1], 200)  # no corner is seen
        lower, upper = self.curvature
        wide = np.linspace(min(held[0], lower), max(held[-1], upper), 200)
        half_width = (upper - lower) / 2
        parabola = self.threshold * ((wide - self.value) / half_width) ** 2
        level = np.full(200, self.threshold)
        curves = (
            Curve("profile", inside, root(inside) ** 2, MODEL),
            Curve("re-fits", held, rise, MODEL, POINTS),
            Curve("curvature", wide, parabola, MEASURED, "dash"),
            Curve(f"{100 * self.level:.3g} %", wide, level, FLOOR, "dot"),
        )
        interval = f"{self.ci_lower:.4g} to {self.ci_upper:.4g}"
        title = f"{self.name}: the profile is below the threshold from {interval}"
        panel = Panel("rise of -2 log likelihood", curves)
        ax = drawn(Chart(self.name, (panel,)), title, ax)
        ax.set_ylim(0, 2 * self.threshold)
        return ax

    def __str__(self) -> str:
        lower, upper = self.curvature
        curvature = ", the same as from the standard error"
        if self.is_curved:
            curvature = f"; from the standard error: {lower:.6g} to {upper:.6g}"
        interval = f"{self.ci_lower:.6g} to {self.ci_upper:.6g}"
        percent = f"{100 * self.level:.3g} %"
        estimate = f"{self.name} = {self.value:.6g}"
        return f"{estimate}, {percent} interval {interval}{curvature}"

    __repr__ = __str__


@typed
@interruptible
def profile(
    fit: Fit,
    data: Measurements,
    name: str,
    level: float = 0.95,
    *,
    progress: Progress | None = None,
) -> Profile:
    """Profile likelihood of one parameter of a fit by `MaximumLikelihood`.

    The noise is fixed at the estimate of the fit. The threshold comes from the F
    distribution with the degrees of freedom of the fit. It is divided by the share of
    independent residuals (`Fit.independent_share`), so that profile and standard error
    are consistent. For a fit with ``huber`` it is multiplied by the ratio by which the
    loss of the fit rises faster than squares.

    Args:
        fit: by maximum likelihood.
        data: the measurements of the fit.
        name: of a free parameter that all trajectories share.
        level: of the interval, between 0 and 1.
        progress: called with a line of text about the progress, such as ``print``.

    Raises:
        ModelError: the fit has no likelihood, or no such parameter with a standard
            error; or the level is not between 0 and 1.
        SolveError: the fit could not be repeated, or a re-fit failed.

    Examples:
        >>> found = ph.profile(fit, train, "k")
        >>> found.ci_lower < fit.values["k"] < found.ci_upper
        True
    """
    check_likelihood(fit, "profile")
    shared = [one for one in fit.names if one in fit.model.free]
    said = f"parameter {name!r} is not a free parameter that all trajectories share"
    require_known(name, shared, said)
    if not np.isfinite(fit.std_errors[name]):
        raise ModelError(
            f"parameter {name!r} has no standard error (see the warnings of the fit), "
            "so its profile cannot be computed."
        )
    require_share("level", level)
    line = _Line(fit, AlignedData.of(fit.model, data), name, progress)
    value = line.value
    freedom = fit.degrees_of_freedom[fit.names.index(name)]
    quantile = float(scipy.special.fdtri(1, freedom, level))
    half = fit.std_errors[name] * np.sqrt(quantile)
    threshold = quantile * line.factor / fit.independent_share([name])
    parameter = fit.model.entries[name].parameter
    bounds = (min(parameter.lower, value), max(parameter.upper, value))
    lower, upper = (line.end(bound, half, threshold) for bound in bounds)
    points = np.array([(at, line.rise(at)) for at in sorted(line.solutions)])
    curvature = (value - half, value + half)
    return Profile(name, value, level, points, threshold, lower, upper, curvature)


def check_likelihood(fit: Fit, what: str) -> None:
    """Refuse a fit without a likelihood of white noise and free parameters.

    ``what`` is wanted of it, such as a profile.

    Raises:
        ModelError: it is one.
    """
    if fit.loss != "MaximumLikelihood":
        raise ModelError(
            f"the fit was made with {fit.loss}, which has no likelihood and therefore "
            f"no {what}; fit with MaximumLikelihood()."
        )
    if fit.has_model_error:
        raise ModelError(
            f"a {what} is not available for a fit with model_error=True; use "
            f"fit.intervals(), or the {what} of a fit with MaximumLikelihood()."
        )
    if not fit.names:
        raise ModelError(f"the fit has no free parameter, so there is no {what}.")


class _Line:
    """The profile as a function of the parameter, with the points worked out so far."""

    def __init__(
        self,
        fit: Fit,
        aligned: AlignedData,
        name: str,
        say: Progress | None,
    ) -> None:
        self.name = name
        self.say = say
        sigma = np.array([fit.noise.get(state, 1.0) for state in fit.model.states])
        steps = steps_on(fit, aligned.data)
        loss = likelihood_of(fit)
        self.solved = partial(maximum_along, aligned, sigma, loss, steps=steps)
        lengths = [run.n_samples for run in aligned.data.trajectories]
        x: Sequence[np.ndarray] = fit.states
        if list(map(len, x)) != lengths:  # other data: beside a missing force
            x = Record.of_aligned(fit, aligned).start
        best = self.solved(fit.model, x)
        value = fit.values[name]
        limit = 0.1 * fit.std_errors[name]  # beyond, they are not those of the fit
        if best is None or abs(best.values[name] - value) > limit:
            now = "not solved" if best is None else f"{best.values[name]:.6g}"
            raise SolveError(
                f"the fit could not be repeated on these measurements: {name} is "
                f"{value:.6g} in the fit, now {now}. Give the measurements of the fit."
            )
        self.value = best.values[name]
        self.prior = fit.model.entries[name].parameter.prior
        self.lowest = best.deviance
        self.factor = best.score_variance
        self.solutions = {self.value: best}

    def rise(self, held: float) -> float:
        """-2 log likelihood above the best fit with the parameter held at a value."""
        # Started from the nearest point known.
        known = self.solutions
        if held in known:
            rise = known[held].deviance - self.lowest
            if self.prior and held != self.value:  # where it is held it is not free
                mean, deviation = self.prior
                rise += ((held - mean) / deviation) ** 2
            return max(rise, 0.0)
        nearest = known[min(known, key=lambda value: abs(value - held))]
        values = {n: v for n, v in nearest.values.items() if n != self.name}
        model = nearest.model.with_values(values).with_fixed({self.name: held})
        solution = self.solved(model, nearest.states)
        if solution is None:
            raise SolveError(
                f"the solver found no solution with {self.name} fixed at {held:g}."
            )
        known[held] = solution
        rise = self.rise(held)
        if self.say:
            self.say(f"{self.name} = {held:.6g}: -2 log likelihood rises by {rise:.3g}")
        return rise

    def end(self, bound: float, half: float, threshold: float) -> float:
        """Where the profile crosses the threshold towards a bound of the parameter."""
        # The bound, or infinity, where it does not within eight half widths.
        side = -1.0 if bound < self.value else 1.0
        reach = abs(bound - self.value)

        def above(distance: float) -> float:
            if not distance:
                return -1.0
            # The root of the rise is nearly straight.
            rise = self.rise(self.value + side * distance)
            return float(np.sqrt(rise / threshold) - 1)

        near = 0.0
        far = min(half, reach)
        if far <= 0:
            return bound
        while above(far) < 0:
            near = far
            far = min(1.5 * far, reach)
            if near == reach:
                return bound
            if far > 8 * half:
                return side * np.inf
        return self.value + side * brentq(above, near, far, xtol=0.02 * half)


# ---- the parametric bootstrap


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Estimates from repeated fits to records that a fitted model simulates.

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
        table = self._values()
        table["std_error"] = [self.fit.std_errors[name] for name in table.index]
        table["bootstrap_error"] = self.estimates.std(ddof=1)
        table["bias"] = self.estimates.mean() - table["value"]
        return table

    def intervals(self, level: float = 0.95) -> "pd.DataFrame":
        """Percentile intervals: the central part of the draws.

        Args:
            level: Share of the draws within, between 0 and 1. For 0.95 take some
                hundred draws or more.

        Returns:
            A row per estimate with its name as index, and the columns value, ci_lower
            and ci_upper, as `Fit.intervals`.

        Raises:
            DataError: ``level`` does not lie between 0 and 1.
        """
        require_share("level", level, DataError)
        table = self._values()
        table["ci_lower"] = self.estimates.quantile((1 - level) / 2)
        table["ci_upper"] = self.estimates.quantile((1 + level) / 2)
        return table

    def _values(self) -> "pd.DataFrame":
        """The estimates of the fit, a row each."""
        names = list(self.fit.estimates)
        return printed_table({"value": self.fit.estimates}, index=names)

    def __str__(self) -> str:
        text = f"bootstrap of {len(self.estimates)} draws\n{self.table}"
        if self.failed:
            text += f"\n{len(self.failed)} draws could not be fitted (see failed)."
        return text

    __repr__ = __str__


@typed
@interruptible
def bootstrap(
    fit: Fit,
    data: Measurements,
    n_draws: int = 200,
    *,
    seed: int = 0,
    executor: Executor | None = None,
    folder: str | Path | None = None,
    progress: Progress | None = None,
) -> Bootstrap:
    """Repeat a fit by `MaximumLikelihood` on records that the fitted model simulates.

    A draw is the free run of the fit at the samples plus white noise of the estimated
    size, with the same missing values as the data; the model is identified from it as
    from the data. A prior of a parameter that all trajectories share is one more
    measurement: its mean is drawn about the estimate. The noise of a draw depends only
    on ``seed`` and its number, and not on the executor or the order. (Only white noise
    is simulated: other disturbances are included in the standard errors of the fit, not
    in these.)

    Args:
        fit: By maximum likelihood, with its states: not loaded from a file.
        data: The measurements of the fit.
        n_draws: Number of records that are drawn, at least 2.
        seed: Of the noise.
        executor: Where to compute (see `sweep`); None: processes on this machine.
        folder: Folder for the estimates of the draws; an interrupted call, or a call
            with more draws, continues from it.
        progress: Called with a line of text after each draw.

    Raises:
        ModelError: The fit has no likelihood, or includes a model error.
        DataError: The fit has no states, the measurements are not those of the fit, or
            a number cannot be used.
        SolveError: Fewer than two draws could be fitted.

    Examples:
        >>> draws = ph.bootstrap(fit, train, n_draws=2)
        >>> list(draws.estimates.columns)
        ['k', 'R_p', 'coulomb_friction_p']
    """
    check_likelihood(fit, "bootstrap")
    if not fit.states:
        raise DataError(
            "the fit has no estimated states, for example because it was loaded from "
            "a file; call identify again with its measurements."
        )
    if not 2 <= n_draws <= 10**6 or seed < 0:  # of one no scatter can be taken
        raise DataError(f"n_draws={n_draws} must be 2 to 10**6, seed={seed} 0 or more.")
    aligned = AlignedData.of(fit.model, data)
    data = aligned.data
    lengths = [run.n_samples for run in data.trajectories]
    fitted = list(map(len, fit.states))
    if fitted != lengths:
        raise DataError(
            f"the measurements have trajectories of {lengths} samples, the fit "
            f"{fitted}; give the measurements of the fit."
        )
    theta = parameter_matrix(fit.model, parameters_of(fit, data))
    shown = outputs_at_samples(fit.model, aligned.grid, fit.states, theta)
    noise = dict(fit.noise)
    drawn = partial(_drawn_estimates, fit.model, data, shown, noise, likelihood_of(fit))
    source = (fit.model, fit.by_trajectory, noise, fit.huber, data.digest, int(seed))
    seeds = np.random.SeedSequence(seed).spawn(n_draws)
    swept = sweep(
        drawn,
        {f"draw {number}": one for number, one in enumerate(seeds)},
        executor=executor,
        folder=folder,
        of=f"bootstrap {digest_of(source)}",
        progress=progress,
    )
    found = {int(done.key.removeprefix("draw ")): done.result for done in swept}
    results = sorted(found.items())
    failed = {number: one["failed"] for number, one in results if "failed" in one}
    rows = {number: one["estimates"] for number, one in results if "failed" not in one}
    if len(rows) < 2:
        reason = next(iter(failed.values()), "")
        raise SolveError(
            f"{len(failed)} of {n_draws} draws could not be fitted: {reason}"
        )
    table = printed_table(rows.values(), index=list(rows), columns=list(fit.estimates))
    return Bootstrap(fit, table, failed)


def _drawn_estimates(
    model: Model,
    data: Measurements,
    shown: Sequence[np.ndarray],
    noise: Mapping[str, float],
    loss: MaximumLikelihood,
    seed: np.random.SeedSequence,
) -> dict[str, Any]:
    """The estimates of one draw by name; or why there are none."""
    # A draw is what the fitted model shows plus noise, measured where the data are.
    rng = np.random.default_rng(seed)
    sigma = np.array([noise.get(name, 0.0) for name in data.states])
    runs = []
    for run, exact in zip(data.trajectories, shown, strict=True):
        noisy = exact + sigma * rng.normal(size=exact.shape)
        runs.append(replace(run, x=np.where(np.isnan(run.x), np.nan, noisy)))
    priors = {}
    for name in model.free:
        one = model.entries[name].parameter
        if one.prior is not None and not one.per_trajectory:
            mean = rng.normal(model.values[name], one.prior[1])
            priors[name] = float(np.clip(mean, one.lower, one.upper)), one.prior[1]
    drawn = model.with_parameters(lambda n, one: replace(one, prior=priors[n]), priors)
    try:
        fit = identify(drawn, replace(data, trajectories=tuple(runs)), loss)
    except PhsiOptError as error:
        return {"failed": f"{type(error).__name__}: {error}"}
    return {"estimates": dict(fit.estimates)}
