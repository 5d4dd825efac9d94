"""The verb: start -> program -> solve -> prune -> repeat, until there is a `Fit`."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.maximum_likelihood import by_likelihood
from phsi_opt.estimation.phsi import by_defects
from phsi_opt.estimation.problem import Loss, Progress, State, Task
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import (
    MaximumLikelihood,
    MissingForce,
    PHSILoss,
    l1_weights,
)
from phsi_opt.transcription.parameter_vector import Theta


def identify(
    model: Model,
    data: Measurements,
    loss: Loss | None = None,
    l1: Mapping[str, float] | float | None = None,
    pruning: Pruning | None = None,
    *,
    start: Fit | None = None,
    settings: SolverSettings | None = None,
    raise_on_failure: bool = True,
    progress: Progress | None = None,
) -> Fit:
    """Find the parameters of ``model`` that explain ``data``.

    Args:
        loss: `PHSILoss` or `MaximumLikelihood` (default).
        l1: weight lambda of |coefficient| per slot, such as {"H": 0.1, "F": 0.01}; a
            number stands for both.
        pruning: how terms are removed; None keeps them all.
        start: a fit of a similar model of the same measurements, to start from its
            states and values.
        raise_on_failure: False returns the fit with an outcome that says what went
            wrong.
        progress: called with a line of text as the work goes on, such as ``print``.

    Raises `DataError` if model and data do not match, `ModelError` for a model that
    cannot be solved, `SolveError` if the solver fails.
    """
    began = time.perf_counter()
    loss = MaximumLikelihood() if loss is None else loss
    if not model.free:
        raise ModelError(
            "the model has no free parameter, so there is nothing to identify; use compare or simulate."
        )
    task = Task(
        model,
        aligned(model, data),
        l1_weights(l1),
        pruning,
        settings or SolverSettings(),
        progress or _silent,
    )
    state = loss_methods(loss)(task, loss, start, _pruned)
    if raise_on_failure and not state.solution.outcome.success:
        raise SolveError(f"The solver failed: {state.solution.outcome}")
    fit = state.fit()
    return replace(fit, seconds=time.perf_counter() - began)


def identify_forced(
    model: Model,
    data: Measurements,
    loss: PHSILoss,
    l1: Mapping[str, float] | float | None,
    pruning: Pruning | None,
    layout: Callable[[Grid], Grid],
    start: Fit | None = None,
) -> Fit:
    """`identify` with further inputs that the measurements do not hold: ``layout`` adds
    them to the grid.
    """
    task = Task(model, data, l1_weights(l1), pruning, SolverSettings(), _silent, layout)
    state = by_defects(task, loss, start, _pruned)
    if not state.solution.outcome.success:
        raise SolveError(f"The solver failed: {state.solution.outcome}")
    return state.fit()


def loss_methods(loss: Loss) -> Callable[[Task, Any, Fit | None, Any], State]:
    """How each loss is solved."""
    for kind, method in ((PHSILoss, by_defects), (MaximumLikelihood, by_likelihood)):
        if isinstance(loss, kind):
            return method
    hint = (
        " A missing force is estimated by diagnose(fit, data).missing_force."
        if isinstance(loss, MissingForce)
        else ""
    )
    raise ModelError(
        f"loss={loss!r} is not a loss that finds parameters; expected PHSILoss() or MaximumLikelihood().{hint}"
    )


Solver = Callable[[State, Model, np.ndarray, dict[str, float]], State]


def _pruned(state: State, solver: Solver) -> State:
    """Warm-started re-solves until the support stays: by size with L1, then without it,
    then by significance.
    """
    pruning = state.task.pruning
    if pruning is None:
        return state
    n_tests = len(pruning.candidates(state.model))
    for _ in range(pruning.max_rounds):
        gone, l1 = pruning.small(state.model, state.sizes), state.l1
        if not gone and pruning.debias and any(l1.values()):
            l1 = {}
        elif (
            not gone
            and pruning.significance is not None
            and state.solution.outcome.success
        ):
            gone = pruning.insignificant(
                state.model, state.values, _of_shared(state), n_tests
            )
        if not gone and l1 == state.l1:
            break
        kept = [name for name in state.model.free if name not in gone]
        energy = [term.coefficient_name("H") for term in state.model.H]
        if not kept or (energy and set(energy) <= gone):
            raise ModelError(
                f"{pruning!r} removes every term{' of H' if kept else ''}; lower its threshold or the L1 weight, or "
                "add terms that the data need."
            )
        model = state.model.without(gone)
        left, now = (
            Theta.of(model, state.unknown.runs),
            dict(zip(state.unknown.names, state.theta, strict=True)),
        )
        theta = left.from_values(now, np.zeros(len(left)))
        removed = (*state.removed, *sorted(gone))
        state = replace(
            solver(state, model, theta, l1), removed=removed, notes=state.notes
        )
    return state


def _silent(line: str) -> None:
    pass


def _of_shared(state: State) -> np.ndarray:
    """Covariance in the order of ``model.free``; NaN for parameters that every
    trajectory has of its own.
    """
    unknown, covariance = state.unknown, state.uncertainty.covariance
    alone = np.bincount(unknown.owner) == 1
    first = unknown.table[:, 0]
    return np.where(np.outer(alone, alone), covariance[np.ix_(first, first)], np.nan)
