"""The corner of dry friction, made sharper step by step.

A solver needs the corner rounded at first. Beside a body that sticks the rounding
shows: it creeps where it should rest, and the size of the friction comes out wrong. So
the width w is made smaller on a finer grid as long as the likelihood asks for it: the
deviance D is nearly linear in a small w, so that all sharper corners together let it
fall by its slope dD / dlog w, which the multipliers of the dynamics tell.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import prod

import numpy as np

from phsi_opt.comparison.compare import deviance
from phsi_opt.criteria import (
    CORNER_WIDTHS,
    MOST_SHARP_STATES,
    SHARPER_CORNER_DEVIANCE,
    STEPS_AT_CORNER,
)
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.refit_effort import BRIEF
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import estimate_by
from phsi_opt.estimation.likelihood_estimate import (
    DisturbedEstimate,
    LikelihoodEstimate,
)
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import l1_weights

# Share of the present width over which the slope of the deviance is taken.
NEARBY_WIDTH = 0.99


class CornerSharpening:
    """Sharpens the corners that a larger model has and the diagnosed one has not."""

    def __init__(self, base: DiagnosedModel, aligned: AlignedData) -> None:
        """Sharpen corners on measurements in the larger model's order."""
        self.base = base
        self.aligned = aligned

    def corners(self, model: Model) -> dict[str, Share]:
        """Widths of the corners that the base has not, with their guesses."""
        known = self.base.fit.model.entries
        found = {}
        for name, guess in corner_widths(model).items():
            if name not in known:
                found[name] = guess
        return found

    def sharpened(self, fit: Fit) -> Fit:
        """The fit with its corners as sharp as the record asks for.

        Args:
            fit: with rounded corners.
        """
        blunt = fit.model
        guesses = self.corners(blunt)
        n_stages = max((len(guess.sharper) for guess in guesses.values()), default=0)
        estimate = None
        for stage in range(1, n_stages + 1):
            # The slope tells little on a grid on which no corner is resolved.
            if estimate and self._fall(estimate) < SHARPER_CORNER_DEVIANCE:
                break
            widths = {}
            for name, guess in guesses.items():
                widths[name] = blunt.values[name] * prod(guess.sharper[:stage])
            n_steps = STEPS_AT_CORNER * max(stage, 2) // 2
            estimate = self.at_widths(fit, widths, n_steps)
            if estimate is None:
                break
            sharper = estimate.fit()
            if deviance(sharper) > deviance(fit) + SHARPER_CORNER_DEVIANCE:
                break
            fit = sharper
        return fit

    def _fall(self, estimate: LikelihoodEstimate | DisturbedEstimate) -> float:
        """By how much the deviance would fall with corners sharp without end."""
        model = estimate.model
        widths = {}
        for name in self.corners(model):
            widths[name] = NEARBY_WIDTH * model.values[name]
        change = estimate.deviance_change(model.with_values(widths))
        return change / float(np.log(NEARBY_WIDTH))

    def at_widths(
        self, fit: Fit, widths: dict[str, float], n_steps: int
    ) -> LikelihoodEstimate | DisturbedEstimate | None:
        """The estimate with other widths of its corners; None where it fails.

        Or where a model with a memory would have too many states.

        Args:
            fit: where to begin.
            widths: by the names of their parameters.
            n_steps: in gaps between samples beside a corner, at least.
        """
        steps = fit.steps
        for name, guess in self.corners(fit.model).items():
            width = fit.model.values[name]
            steps = finer_at_corner(
                fit, self.aligned.data, guess.of, width, steps, n_steps
            )
        n_intervals = sum(int(of_run.sum()) for of_run in steps)
        if fit.model.memory and n_intervals * fit.model.n_states > MOST_SHARP_STATES:
            return None
        model = fit.model.with_values(widths)
        task = Task(model, self.aligned, l1_weights(None), None, BRIEF)
        with suppress(PhsiOptError):
            found = estimate_by(self.base.loss, task, replace(fit, steps=steps))
            assert isinstance(found, LikelihoodEstimate | DisturbedEstimate)
            return found if found.is_success else None
        return None


def finer_at_corner(
    fit: Fit,
    data: Measurements,
    of: str,
    width: float,
    steps: Sequence[np.ndarray],
    n_steps: int = STEPS_AT_CORNER,
) -> tuple[np.ndarray, ...]:
    """More steps in gaps between samples in which a formula passes its corner.

    Args:
        fit: with states at the samples.
        data: the measurements of the fit.
        of: formula that is zero at the corner, such as a velocity.
        width: of the corner, in the unit of the formula.
        steps: at present, one (n_samples - 1,) per trajectory.
        n_steps: in gaps beside a corner, at least.
    """
    formula = fit.model.function(of)
    theta = fit.model.theta
    refined = []
    for run, x, n in zip(data.trajectories, fit.states, steps, strict=True):
        at_samples = formula.map("v", "serial", len(x), [3], [])
        v = np.array(at_samples(x.T, run.u.T, run.t[None, :], theta)).ravel()
        passes_zero = v[1:] * v[:-1] < 0
        is_within = np.minimum(np.abs(v[1:]), np.abs(v[:-1])) < CORNER_WIDTHS * width
        is_near = passes_zero | is_within
        # The corner may move to the gap beside.
        is_near = np.convolve(is_near, np.ones(3))[1:-1] > 0
        refined.append(np.where(is_near, np.maximum(n, n_steps), n))
    return tuple(refined)
