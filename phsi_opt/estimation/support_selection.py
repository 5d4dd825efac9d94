"""Which terms of a dictionary stay: solve, prune, solve again, until the support stays.

Sequential thresholding, first by size with the L1 term, then without it, then by
significance. `Pruning` says which terms go; here is the loop around the solves.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.model.model import Model
from phsi_opt.transcription.parameter_vector import Theta

E = TypeVar("E", bound=Estimate)
# A warm-started solve: (estimate so far, model with fewer terms, theta, L1 weights)
Resolve = Callable[[E, Model, np.ndarray, dict[str, float]], E]


@dataclass(frozen=True)
class _Change:
    """What the next solve leaves out: terms, or the L1 term."""

    removed: set[str]
    l1: dict[str, float]


def pruned(estimate: E, resolve: Resolve[E]) -> E:
    """Warm-started re-solves of the task's pruning until the support stays.

    The tests of significance count the terms that are left and those that the estimate
    says were removed before.

    Raises:
        ModelError: if every term, or every one of H, would go.
    """
    pruning = estimate.task.pruning
    if pruning is None:
        return estimate
    n_tests = len(pruning.candidates(estimate.model)) + len(estimate.removed)
    for _ in range(pruning.max_rounds):
        change = _next_change(estimate, pruning, n_tests)
        if change is None:
            break
        _check_rest(estimate.model, change.removed, pruning)
        model = estimate.model.without(change.removed)
        theta = _warm_start(model, estimate)
        again = resolve(estimate, model, theta, change.l1)
        removed = (*estimate.removed, *sorted(change.removed))
        estimate = replace(again, removed=removed, notes=estimate.notes)
    return estimate


def _next_change(estimate: Estimate, pruning: Pruning, n_tests: int) -> _Change | None:
    model = estimate.model
    small = pruning.small(model, estimate.sizes)
    if small:
        return _Change(small, estimate.l1)
    if pruning.debias and estimate.has_l1:
        return _Change(set(), {})
    if pruning.significance is None or not estimate.is_success:
        return None
    insignificant = pruning.insignificant(
        model, estimate.values, estimate.shared_covariance, n_tests
    )
    return _Change(insignificant, estimate.l1) if insignificant else None


def _check_rest(model: Model, removed: set[str], pruning: Pruning) -> None:
    if not removed:
        return
    energy = {term.coefficient_name("H") for term in model.H}
    if set(model.free) <= removed:
        what = "every term"
    elif energy and energy <= removed:
        what = "every term of H"
    else:
        return
    raise ModelError(
        f"{pruning!r} removes {what}; lower its threshold or the L1 weight, or add "
        "terms that the data need."
    )


def _warm_start(model: Model, estimate: Estimate) -> np.ndarray:
    """Theta of the smaller model at the values of the estimate."""
    unknown = Theta.of(model, estimate.unknown.runs)
    theta = estimate.theta
    values = dict(zip(estimate.unknown.names, theta, strict=True))
    return unknown.from_values(values, np.zeros(len(unknown)))
