"""Profile likelihood: how the best fit worsens as one parameter is held away from its
estimate.

Where the curvature at the estimate misleads (a bent valley, a bound near by), the
interval in which the profile stays below the threshold is the better one. Every point
is a re-fit of all other parameters, started from the one before.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq
from scipy.stats import f as f_distribution

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError, did_you_mean
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.missing_force import force_of
from phsi_opt.estimation.record_likelihood import RecordLikelihood
from phsi_opt.estimation.smoothing import options, steps_on
from phsi_opt.model.model import Model
from phsi_opt.transcription.alignment import aligned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DIFFERS = (
    0.1  # share of the half width by which an end may differ from that of the curvature
)
CLOSE = 0.02  # accuracy of an end, in half widths
MOVED = 0.1  # standard errors by which the repeated fit may differ from the fit
FARTHEST = 8  # half widths beyond which no end is looked for


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile of one parameter.

    Attributes:
        name: of the parameter; value: its estimate; level: of the interval.
        points: (n, 2) values of the parameter and rise of -2 log likelihood above the
            best fit, sorted by value.
        threshold: rise at the ends of the interval.
        ci_lower, ci_upper: ends of the interval (limits of confidence); infinite where
            the profile never reaches the threshold, the bound where a bound of the
            parameter comes first.
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
        """Whether an end differs from that of the curvature by more than a tenth of the
        half width.
        """
        half = (self.curvature[1] - self.curvature[0]) / 2
        shift = np.abs(
            np.array([self.ci_lower, self.ci_upper]) - np.array(self.curvature)
        )
        return not np.all(shift <= DIFFERS * half)

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """The profile beside the parabola of the standard error, with the threshold."""
        from phsi_opt.presentation.pictures import plot_profile

        ax = plot_profile(
            self.points, self.value, self.curvature, self.threshold, self.level, ax
        )
        interval = f"{self.ci_lower:.4g} to {self.ci_upper:.4g}"
        title = f"{self.name}: {interval}, where the profile is below the line"
        ax.set(xlabel=self.name, title=title)
        return ax

    def __str__(self) -> str:
        text = f"{self.name} = {self.value:.6g}, {100 * self.level:.3g} % interval {self.ci_lower:.6g} to {self.ci_upper:.6g}"
        low, high = self.curvature
        return text + (
            f"; curvature alone: {low:.6g} to {high:.6g}"
            if self.is_curved
            else ", as the curvature says"
        )

    __repr__ = __str__


def profile(
    fit: Fit,
    data: Measurements,
    name: str,
    level: float = 0.95,
    *,
    progress: Callable[[str], None] | None = None,
) -> Profile:
    """Profile likelihood of one parameter of a fit to ``data`` by `MaximumLikelihood`.

    The noise stays at the fit's estimate; the threshold is that of the F distribution,
    which knows that it was estimated (for a fit with ``huber``, times the ratio by
    which its loss rises faster than the squares). Raises `ModelError` for a parameter
    that the fit does not have as a free and shared one, or that has no standard error.
    """
    _check(fit, name, level)
    line = _Line(fit, aligned(fit.model, data), name, progress or (lambda text: None))
    value, error = line.value, fit.std_errors[name]
    quantile = float(
        f_distribution.isf(1 - level, 1, max(fit.n_values - len(fit.names), 1))
    )
    half, threshold = error * np.sqrt(quantile), quantile * line.factor
    p = fit.model.entries[name].parameter
    lower, upper = (
        line.end(bound, half, threshold)
        for bound in (min(p.lower, value), max(p.upper, value))
    )
    points = np.array(sorted(line.points.items()))
    return Profile(
        name,
        value,
        level,
        points,
        threshold,
        lower,
        upper,
        (value - half, value + half),
    )


def _check(fit: Fit, name: str, level: float) -> None:
    if fit.loss != "MaximumLikelihood":
        raise ModelError(
            f"the fit is one by {fit.loss}, which has no likelihood; fit with MaximumLikelihood()."
        )
    if name not in fit.model.free or name not in fit.names:
        raise ModelError(
            f"parameter {name!r} is not a free, shared one of the fit.{did_you_mean(name, fit.names)}"
        )
    if not np.isfinite(fit.std_errors[name]):
        raise ModelError(
            f"parameter {name!r} has no standard error (see the fit's warnings), so no profile either."
        )
    if not 0 < level < 1:
        raise ModelError(f"level={level!r} must lie between 0 and 1, such as 0.95.")


class _Line:
    """The profile as a function of the parameter, with the points that were worked out."""

    def __init__(
        self, fit: Fit, data: Measurements, name: str, say: Callable[[str], None]
    ) -> None:
        self.data, self.name, self.say = data, name, say
        self.sigma = np.array([fit.noise.get(state, 1.0) for state in fit.model.states])
        self.loss, self.steps, self.way = (
            options(fit),
            steps_on(fit, data),
            fit.outcome.way,
        )
        model = fit.model
        states = fit.states
        if [len(x) for x in states] != [run.n_samples for run in data.trajectories]:
            estimate = force_of(fit, data)
            states = tuple(
                estimate.x[estimate.grid.trajectory == i]
                for i in range(data.n_trajectories)
            )
        best = self._solved(model, states)
        if (
            best is None
            or abs(best.values[name] - fit.values[name]) > MOVED * fit.std_errors[name]
        ):
            now = "no solution" if best is None else f"{best.values[name]:.6g}"
            raise SolveError(
                f"the fit could not be repeated on these measurements: {name} is {fit.values[name]:.6g} in the fit, "
                f"now {now}. Are they those of the fit?"
            )
        self.value, self.lowest = best.values[name], best.chi_square
        self.factor = 1.0 if fit.huber is None else best.huber_moments.rise_ratio
        self.points, self.states = {self.value: 0.0}, {self.value: best}

    def _solved(
        self, model: Model, x: Sequence[np.ndarray]
    ) -> LikelihoodEstimate | None:
        record = RecordLikelihood(self.data, self.sigma, self.loss)
        return record.maximum(model, x, self.steps, self.way)

    def rise(self, held: float) -> float:
        """-2 log likelihood above the best fit with the parameter held; started from
        the nearest point known.
        """
        if held in self.points:
            return self.points[held]
        nearest = self.states[min(self.states, key=lambda known: abs(known - held))]
        values = {n: v for n, v in nearest.values.items() if n != self.name}
        model = nearest.model.with_values(values).with_fixed({self.name: held})
        state = self._solved(model, nearest.states)
        if state is None:
            raise SolveError(f"no fit was found with {self.name} held at {held:g}.")
        self.states[held], self.points[held] = (
            state,
            max(state.chi_square - self.lowest, 0.0),
        )
        self.say(
            f"{self.name} = {held:.6g}: -2 log likelihood rises by {self.points[held]:.3g}"
        )
        return self.points[held]

    def end(self, bound: float, half: float, threshold: float) -> float:
        """Where the profile crosses the threshold towards the bound; the bound, or
        infinity, where it does not.
        """
        side, reach = (-1.0 if bound < self.value else 1.0), abs(bound - self.value)
        near, far = 0.0, min(half, reach)

        def above(distance: float) -> float:
            # The root of the rise is nearly straight.
            return (
                float(np.sqrt(self.rise(self.value + side * distance) / threshold) - 1)
                if distance
                else -1.0
            )

        while far > 0 and above(far) < 0:
            near, far = far, min(1.5 * far, reach)
            if near == reach or far > FARTHEST * half:
                return bound if near == reach else side * np.inf
        return (
            self.value + side * brentq(above, near, far, xtol=CLOSE * half)
            if far > 0
            else bound
        )
