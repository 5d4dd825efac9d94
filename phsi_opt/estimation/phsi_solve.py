"""How `PHSILoss` is solved: the states are the data, every start of a scan is tried."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import TypeVar

import numpy as np

from phsi_opt.errors import DataError
from phsi_opt.estimation.estimate import Estimate, Task, pruned
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.uncertainty import Uncertainty, of_defects
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.initialization.scaling import first_point
from phsi_opt.initialization.starting_values import (
    frequency_scans,
    imitators,
    starting_values,
)
from phsi_opt.later import Remade
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import Solver
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import (
    MOST_PROGRAMS,
    SAME_DELAY,
    PHSILoss,
    complete_intervals,
    mean_square_rate,
)
from phsi_opt.transcription.parameter_vector import Theta

E = TypeVar("E", bound=Estimate)


@dataclass(frozen=True, eq=False, kw_only=True)
class PHSIEstimate(Estimate):
    """The minimum of the PHSI loss."""

    loss: PHSILoss
    variance: float  # of a defect, beside which priors counted

    @property
    def n_values(self) -> int:
        """Number of defects."""
        return self._used.n_intervals * self.model.n_states

    @property
    def misfit(self) -> float:
        scaled = float(np.sum(self.solution.residual**2) / 2)
        return scaled * mean_square_rate(self._used)

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Sandwich covariance: neighbouring defects share a noisy sample."""
        return of_defects(
            self.model,
            self._used,
            self.loss.integrator,
            self.theta,
            self.point.theta_scale,
            self.solution.outcome.at_bounds,
        )

    def fit(self) -> Fit:
        of_start = (self.model, self.grid, self.point, self.l1, self.variance)
        return replace(
            super().fit(), remade_program=Remade(partial(self.loss.program, *of_start))
        )

    @property
    def _used(self) -> Grid:
        """The grid with the intervals whose two ends are measured."""
        return complete_intervals(self.model, self.grid)


@dataclass(frozen=True, eq=False)
class PHSISolver:
    """Solves the PHSI loss of a task on one grid."""

    task: Task
    loss: PHSILoss
    grid: Grid

    def solve(
        self,
        model: Model,
        theta: np.ndarray,
        l1: dict[str, float],
        known: PHSIEstimate | None = None,
    ) -> PHSIEstimate:
        """One solve from ``theta`` (n_free,).

        ``known``: an estimate of a larger model, whose sizes are taken.
        """
        if known is None:
            point = first_point(model, complete_intervals(model, self.grid), theta)
        else:
            kept = list(map(known.model.free.index, model.free))
            sizes = known.point.theta_scale[kept]
            point = replace(known.point, theta=theta, theta_scale=sizes)
        unknown = Theta.of(model, ("",))
        has_priors = bool(np.any(unknown.priors))
        variance = following = 0.0  # a solve without priors is the first to tell it
        for _ in range(MOST_PROGRAMS if model.delays or has_priors else 1):
            variance = following
            program = self.loss.program(model, self.grid, point, l1, variance)
            solution = Solver(program, self.task.settings).solve()
            theta = solution.values["theta"]
            is_whole = variance > 0 or not has_priors
            if is_whole and np.allclose(theta, point.theta, rtol=SAME_DELAY):
                break
            used = complete_intervals(model, self.grid)
            mean_square = np.sum(solution.residual**2) / 2 * mean_square_rate(used)
            following = float(mean_square) / model.n_states
            point = replace(point, theta=theta)
        n_free = len(model.free)
        self.task.say(f"PHSI loss, {n_free} parameters: {solution.outcome}")
        return PHSIEstimate(
            task=self.task,
            loss=self.loss,
            variance=variance,
            model=model,
            grid=self.grid,
            unknown=unknown,
            point=point,
            solution=solution,
            l1=l1,
        )

    def pruned_from(
        self,
        model: Model,
        starts: Sequence[np.ndarray],
        removed: tuple[str, ...] = (),
    ) -> list[PHSIEstimate]:
        """A pruned estimate from each start (n_free,), besides what is ``removed``."""
        found = []
        for theta in starts:
            first = self.solve(model, theta, self.task.l1)
            found.append(pruned(replace(first, removed=removed), self.solve))
        return found


def by_defects(task: Task, loss: PHSILoss, start: Fit | None) -> PHSIEstimate:
    """The best of the solutions from several starts, each pruned.

    Where terms that imitate a wave were kept, the wave alone is tried as well.

    Raises:
        DataError: every state is zero at every sample.
    """
    used = complete_intervals(task.model, task.grid)
    if not np.any(used.y):
        raise DataError(
            "every state is zero at every sample, so no parameter can be estimated; "
            "check that the columns are those of the measurements."
        )
    model = resolve_guesses(task.model, used, np.nan_to_num(used.y))
    if start is None:
        starts = starting_values(model, used, task.l1)
    else:
        known = model.values | start.values
        starts = [np.array(list(map(known.__getitem__, model.free)))]
    solver = PHSISolver(task, loss, task.grid)
    estimates = solver.pruned_from(model, starts)
    if start is None:
        best = min(estimates, key=_bic_like)
        estimates += _without_imitators(solver, model, used, best)
    return best_of_starts(estimates, _bic_like)


def _without_imitators(
    solver: PHSISolver, model: Model, used: Grid, best: PHSIEstimate
) -> list[PHSIEstimate]:
    """Estimates pruned from the dictionary without what imitates its waves."""
    # Over a short record polynomials in the time imitate a slow wave. L1 prefers them,
    # because their coefficients are the smaller ones: a cubic of 0.01 is worth 10 at t
    # = 10. The wave is then pruned before L1 goes, and no re-solve brings it back. So
    # the rule that compares starts decides. Nothing is tried where pruning kept waves
    # alone.
    pruning = solver.task.pruning
    if pruning is None:
        return []
    removable = imitators(model) & set(pruning.candidates(model))
    kept = set(best.model.free)
    waves = set(chain.from_iterable(s.amplitudes for s in frequency_scans(model)))
    has_waves_alone = bool(kept & waves) and not kept & removable
    if not removable or has_waves_alone:
        return []
    smaller = model.without(removable)
    starts = starting_values(smaller, used, solver.task.l1)
    return solver.pruned_from(smaller, starts, tuple(sorted(removable)))


def best_of_starts(
    estimates: list[E], preference: Callable[[E], tuple[bool, float]]
) -> E:
    """The estimate with the smallest preference.

    With a note on how many of several starts agree with it.
    """
    best = min(estimates, key=preference)
    if len(estimates) == 1:
        return best
    objectives = [e.solution.outcome.objective for e in estimates]
    # The solver's tolerance is 1e-8.
    limit = min(objectives) * (1 + 1e-6) + 1e-12
    n_agreeing = sum(objective <= limit for objective in objectives)
    note = f"{n_agreeing} of {len(estimates)} starting values led to the best solution"
    return replace(best, notes=(note,))


def _bic_like(estimate: PHSIEstimate) -> tuple[bool, float]:
    """Success first; then n log(loss) + n_free log(n)."""
    # The smaller loss, a term more only where it pays: BIC, as a rule of thumb, since
    # the defects are not independent.
    loss = max(estimate.solution.outcome.objective, TINY)
    n = estimate.n_values
    cost = n * np.log(loss) + len(estimate.model.free) * np.log(n)
    return not estimate.is_success, cost
