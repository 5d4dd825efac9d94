"""How `MaximumLikelihood` is solved.

1. Start: parameters by the PHSI loss; states from the data, or, where some are missing,
    from the missing-force program.
2. Windows, where the whole record cannot be solved (or where they are asked for):
    pieces with free starting states.
3. The whole record, with the noise re-estimated until it stays. Each solve by
   Gauss-Newton steps, where that fails with the exact Hessian, at last along solutions
   of the model.
4. More intervals between samples, where the integration error is visible in the
    estimates.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from phsi_opt.data.noise import LEAST_NOISE_SHARE, difference_noise, initial_noise
from phsi_opt.errors import DataError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_solve import Beginning, LikelihoodSolve, after
from phsi_opt.estimation.likelihood_start import beginning, given_noise, moved_starts
from phsi_opt.estimation.phsi import Pruner
from phsi_opt.estimation.problem import State, Task
from phsi_opt.estimation.step_refinement import finer_steps
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

REFINEMENTS = 5
# residuals over the scatter of neighbouring samples, beyond which a second start is
# tried
SUSPICIOUS = 2.0


def by_likelihood(
    task: Task, loss: MaximumLikelihood, start: Fit | None, prune: Pruner
) -> State:
    """The maximum of the likelihood from the best of the starting points, refined where
    needed, and pruned.
    """
    _check(task)
    given = given_noise(loss, task)
    known = np.isfinite(given)
    begin = beginning(
        task, loss, initial_noise(task.data, given), known, start, _solved_whole
    )
    solve = LikelihoodSolve(task, loss, ~known)
    states = [solve.staged(moved) for moved in moved_starts(begin, task, loss, known)]
    if begin.other is not None and not _is_plausible(_best(states, begin)):
        task.say(
            "the residuals are far above what neighbouring samples scatter: another start"
        )
        with suppress(SolveError):  # it is only a second chance
            states.append(solve.staged(begin.other()))
    state = _best(states, begin)
    for _ in range(REFINEMENTS if loss.steps is None and task.settings.thorough else 0):
        finer = finer_steps(state) if state.solution.outcome.success else None
        if finer is None:
            break
        task.say(
            f"integration error is visible in the estimates: {max(map(np.max, finer))} steps per sample at most"
        )
        state = replace(
            solve(
                state.model,
                finer,
                state.theta,
                state.states,
                state.sigma,
                task.l1,
                after(state.way),
            ),
            notes=state.notes,
        )
    steps = steps_per_gap(state.grid)
    state = prune(
        state,
        lambda s, m, theta, l1: solve(
            m, steps, theta, s.states, s.sigma, l1, after(s.way)
        ),
    )
    return replace(state, notes=state.notes + _noise_note(state, known))


def _solved_whole(task: Task, loss: MaximumLikelihood) -> State:
    return by_likelihood(task, loss, None, lambda state, _: state)


def _check(task: Task) -> None:
    for name in task.model.sensor:
        if name not in task.data.measured:
            raise DataError(
                f"the model has a sensor of {name!r}, but {name!r} was never measured; leave one of them out."
            )
    n_values = sum(int(np.isfinite(run.x).sum()) for run in task.data.trajectories)
    n_theta = len(Theta.of(task.model, task.runs))
    n_unknown = n_theta + task.data.n_trajectories * task.model.n_states
    if n_values <= n_unknown:
        raise DataError(
            f"{n_values} measured values are too few for {n_unknown} unknowns ({n_theta} parameters and "
            f"the starting states of {task.data.n_trajectories} trajectories); measure more, or fix parameters."
        )


def _best(states: list[State], begin: Beginning) -> State:
    best = min(states, key=lambda s: (not s.solution.outcome.success, s.deviance))
    notes = begin.notes
    if len(states) > 1:
        agree = sum(
            s.solution.outcome.success and s.deviance < best.deviance + 0.1
            for s in states
        )
        notes = (
            *notes,
            f"{agree} of {len(states)} starting points led to the best solution",
        )
    return replace(best, notes=notes)


def _is_plausible(state: State) -> bool:
    return state.solution.outcome.success and _scatter(state)[0] < SUSPICIOUS


def _scatter(state: State) -> tuple[float, str]:
    """The largest residual of a channel beside what its neighbouring samples scatter,
    and the channel.
    """
    between_samples, y = difference_noise(state.task.data), state.grid.y
    seen = np.asarray(state.grid.measured.any(axis=0))
    # Data without noise say nothing about it.
    floor = np.array(
        [
            10 * LEAST_NOISE_SHARE * np.nanstd(y[:, k]) if seen[k] else 0.0
            for k in range(y.shape[1])
        ]
    )
    residual = state.residual * np.sqrt(state.n_values / 2)
    channel = np.nonzero(state.grid.measured)[1]
    rms = np.array(
        [
            np.sqrt(np.mean(residual[channel == k] ** 2)) if seen[k] else 0.0
            for k in range(len(between_samples))
        ]
    )
    ratio = np.where(
        seen,
        state.sigma * rms / np.maximum(np.nan_to_num(between_samples), floor + TINY),
        0.0,
    )
    worst = int(np.argmax(ratio))
    return float(ratio[worst]), state.model.states[worst]


def _noise_note(state: State, known: np.ndarray) -> tuple[str, ...]:
    """A sentence where the residuals are far beyond what neighbouring samples scatter."""
    if known.any() or not state.solution.outcome.success:
        return ()
    ratio, channel = _scatter(state)
    if ratio < SUSPICIOUS:
        return ()
    return (
        f"the residuals of {channel} are {ratio:.1f} times what neighbouring samples scatter: the model "
        "lacks something (diagnose), outliers pull (try huber=1.345), or there are several optima (try starts=5)",
    )
