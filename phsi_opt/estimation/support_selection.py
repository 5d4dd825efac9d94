"""Which terms of a dictionary stay: solve, prune, solve again, until the support stays.

Sequential thresholding, first by size with the L1 term, then without it, then by
significance. `Pruning` says which terms go; here is the loop around the solves.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.model.model import Model
from phsi_opt.transcription.parameter_vector import Theta

E = TypeVar("E", bound=Estimate)
# A warm-started solve: (model with fewer terms, theta, L1 weights, estimate so far)
Resolve = Callable[[Model, np.ndarray, dict[str, float], E], E]


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
        gone, l1 = change
        _check_rest(estimate.model, gone, pruning)
        model = estimate.model.without(gone)
        unknown = Theta.of(model, estimate.unknown.runs)
        values = dict(zip(estimate.unknown.names, estimate.theta, strict=True))
        theta = unknown.from_values(values, np.zeros(len(unknown)))
        again = resolve(model, theta, l1, estimate)
        removed = (*estimate.removed, *sorted(gone))
        estimate = replace(again, removed=removed, notes=estimate.notes)
    return estimate


def _next_change(
    estimate: Estimate, pruning: Pruning, n_tests: int
) -> tuple[set[str], dict[str, float]] | None:
    """Terms that the next solve leaves out, and its L1 weights; None: all is done."""
    model = estimate.model
    small = pruning.small(model, estimate.sizes)
    if small:
        return small, estimate.l1
    if pruning.debias and estimate.has_l1:
        return set(), {}
    if pruning.significance is None or not estimate.is_success:
        return None
    insignificant = pruning.insignificant(
        model, estimate.values, estimate.shared_covariance, n_tests
    )
    return (insignificant, estimate.l1) if insignificant else None


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
