"""The corner of dry friction, rounded for a solver and made sharper step by step.

A solver needs the corner rounded at first, but beside a body that sticks the rounding
shows, and the size of the friction comes out wrong. So the width w is made smaller on a
finer grid as long as the likelihood asks for it: the deviance D is nearly linear in a
small w, so that all sharper corners together let it fall by its slope dD / dlog w,
which the multipliers of the dynamics tell.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phsi_opt.criteria import (
    CORNER_WIDTHS,
    MOST_SHARP_STATES,
    SHARPER_CORNER_DEVIANCE,
    STEPS_AT_CORNER,
)
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, StartingPoint
from phsi_opt.initialization.relative_guesses import corner_widths, values_at
from phsi_opt.model.parameters import Share
from phsi_opt.transcription.grid import steps_per_gap


def sharpened(
    problem: LikelihoodProblem, estimate: LikelihoodEstimate
) -> LikelihoodEstimate:
    """An estimate with the task's corners as sharp as the record asks for."""
    guesses = corner_widths(estimate.model)
    corners = {name: guesses[name] for name in problem.task.corners if name in guesses}
    if not corners or not estimate.is_success:
        return estimate
    found = _Sharpening(problem, corners, estimate.model.values).of(estimate)
    return replace(found, task=problem.task, notes=estimate.notes)


@dataclass(frozen=True, eq=False)
class _Sharpening:
    """Stages of sharper corners, from the rounded ones; between two stages too."""

    problem: LikelihoodProblem
    corners: Mapping[str, Share]
    blunt: Mapping[str, float]  # the widths of stage 0, and all other values

    def of(self, estimate: LikelihoodEstimate) -> LikelihoodEstimate:
        most = SHARPER_CORNER_DEVIANCE
        n_stages = max(len(one.sharper) for one in self.corners.values())
        # The slope tells little on a grid on which no corner is resolved: the first
        # stage is tried whatever it is.
        known: list[tuple[float, float]] = []
        for stage in range(1, n_stages + 1):
            sharper = self.at(stage, estimate)
            if sharper is None:
                known = known or [(0.0, self.fall(estimate))]
                break
            known.append((stage, self.fall(sharper)))
            if sharper.deviance > estimate.deviance + most:
                break
            estimate = sharper
            if known[-1][1] < most:
                break
        *before, last = known
        if last[1] > -most:
            return estimate
        low = before[-1] if before else (-1.0, -last[1])
        return self.between(low, last, estimate)

    def between(
        self,
        low: tuple[float, float],
        high: tuple[float, float],
        estimate: LikelihoodEstimate,
    ) -> LikelihoodEstimate:
        """The best estimate met by three secants between a low and a high stage.

        Corners are too blunt at the one, and too sharp at the other.

        Each stage comes with the fall of its deviance.
        """
        for _ in range(3):
            share = high[1] / (high[1] - low[1])
            stage = high[0] - share * (high[0] - low[0])
            found = self.at(stage, estimate)
            if found is None:
                break
            if found.deviance < estimate.deviance:
                estimate = found
            fall = self.fall(found)
            if abs(fall) < SHARPER_CORNER_DEVIANCE:
                break
            low, high = ((stage, fall), high) if fall > 0 else (low, (stage, fall))
        return estimate

    def fall(self, estimate: LikelihoodEstimate) -> float:
        """By how much the deviance would fall with corners sharp without end."""
        model = estimate.model
        nearby = 0.99  # of the present width, for the slope of the deviance
        widths = {name: nearby * model.values[name] for name in self.corners}
        change = estimate.deviance_change(model.with_values(widths))
        return change / float(np.log(nearby))

    def at(
        self, stage: float, estimate: LikelihoodEstimate
    ) -> LikelihoodEstimate | None:
        """The estimate with the corners of a stage; None: failed, or too large."""
        model = estimate.model.with_values(estimate.values)
        task = self.problem.task
        x = np.concatenate(estimate.states)
        steps = steps_per_gap(estimate.grid)
        n_steps = STEPS_AT_CORNER * max(math.ceil(stage), 2) // 2
        widths = {}
        for name, guess in self.corners.items():
            first = guess.sharper[0]  # a stage of -1 is as much blunter
            factors = np.cumprod([1 / first, first, *guess.sharper])
            factor = np.interp(stage, np.arange(len(factors)) - 1, factors)
            widths[name] = self.blunt[name] * float(factor)
            near = CORNER_WIDTHS * model.values[name]
            speeds = values_at(model, task.grid, x, guess.of)
            finer = partial(_finer_at_corner, near=near, n_steps=n_steps)
            steps = list(map(finer, steps, task.grid.split(speeds)))
        n_states = sum(int(n.sum()) for n in steps) * model.n_states
        if model.memory and n_states > MOST_SHARP_STATES:
            return None
        settings = replace(task.settings, thorough=False)
        problem = replace(self.problem, task=replace(task, settings=settings))
        there = StartingPoint.at(estimate, steps)
        there = replace(there, model=model.with_values(widths), is_optimum=True)
        with suppress(PhsiOptError):
            if task.settings.thorough:
                found = problem.solve_from(there)
            else:  # few full steps lead there, or hardly anything does
                found = problem.solve(there, most_steps=15)
            return found if found.is_success else None
        return None


def _finer_at_corner(
    steps: np.ndarray, v: np.ndarray, near: float, n_steps: int
) -> np.ndarray:
    """At least ``n_steps`` in the gaps that may have the corner, and beside them."""
    passes_zero = v[1:] * v[:-1] < 0
    is_within = np.minimum(np.abs(v[1:]), np.abs(v[:-1])) < near
    has_corner = np.convolve(passes_zero | is_within, np.ones(3))[1:-1] > 0
    return np.where(has_corner, np.maximum(steps, n_steps), steps)
