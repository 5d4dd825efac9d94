"""The hybrid: a dictionary for H and R, a neural network for a force without a formula.

    dx/dt = (S - R) grad H(x) + F(x, t, u),    F_k = network in the forced equations k

The dictionary is identified by the solver and the network is trained in torch, in
turns, each with the other's latest estimate, on one and the same loss: the defects of
an integrator. A turn is

1. the program for H and R, with the force of the network as an input at the stages of
   every step (`transcription.stages`);
2. the network on what is left of the forced equations at these stages (Adam);
3. its last layer once more, exactly, by least squares together with every coefficient
   of H and R: what the dictionary can explain is shared out as the joint loss wants it,
   whichever of the two was fitted first.

The network itself is in `network`, its training in `network_training`, and what one
turn computes in `hybrid_problem`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_forced
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.interrupts import interruptible
from phsi_opt.learning.hybrid_network import NeuralForce, TrainedForce
from phsi_opt.learning.hybrid_problem import HybridProblem
from phsi_opt.learning.hybrid_result import Hybrid
from phsi_opt.learning.hybrid_training import Schedule, train, untrained
from phsi_opt.model.model import Model
from phsi_opt.transcription.alignment import aligned_once
from phsi_opt.transcription.losses import PHSILoss

__all__ = ["Hybrid", "NeuralForce", "TrainedForce", "hybrid"]

# By then the network has taken its part, and what is small is small beside it.
FIRST_PRUNED_TURN = 2
LATER_EPOCHS = 1 / 4  # share of the epochs, where the network is trained already
RATE_DECAY = 0.8  # of the learning rate, from turn to turn
FORCE_TOLERANCE = 10  # in units of the tolerance of the coefficients


@interruptible
def hybrid(
    model: Model,
    data: Measurements,
    force: NeuralForce,
    l1: dict[str, float] | float | None = None,
    pruning: Pruning | None = None,
    *,
    integrator: str = "srk4",
    seed: int = 0,
    max_turns: int = 20,
    tolerance: float = 1e-3,
    progress: Callable[[str], None] | None = None,
) -> Hybrid:
    """Identify a dictionary and train a neural force beside it, in turns.

    The turns end when the coefficients move by less than ``tolerance`` (relative) and
    the force by less than ten times that, or after ``max_turns``.

    Args:
        model: what is known or to be found by name; the force of the network is added
            in ``force.equations``.
        data: every state measured.
        force: where the force acts, what it depends on, how it is trained.
        l1: weights of ``|coefficient|``, as for `identify`.
        pruning: of terms, from the third turn on, when the network has taken its part.
        integrator: the scheme of the defects, as that of `PHSILoss`.
        seed: of the network's first weights and of the order of the batches.
        max_turns: limit of the turns.
        tolerance: relative change of a coefficient below which it does not move.
        progress: called with a line of text every turn.

    Raises:
        DataError: if data and model do not match.
        ModelError: for unknown names or integrators, or without torch.
        SolveError: if the solver fails.
    """
    began = time.perf_counter()
    record = aligned_once(model, data)
    problem = HybridProblem.of(model, record, force, integrator)
    estimate = _Estimate(model, problem.no_force())
    turns = []
    converged = False
    for turn in range(max_turns):
        prune = pruning if turn >= FIRST_PRUNED_TURN else None
        before = estimate
        fit = _dictionary_fit(problem, before, record, l1, prune)
        estimate = _with_force(problem, before, fit, _schedule(force, turn, seed))
        row = problem.changes(
            before.model, estimate.model, before.at_stages, estimate.at_stages
        )
        turns.append({"turn": turn + 1, **row})
        if progress is not None:
            progress(
                ", ".join(f"{key} {value:.4g}" for key, value in turns[-1].items())
            )
        converged = (
            row["coefficient_change"] < tolerance
            and row["force_change"] < FORCE_TOLERANCE * tolerance
        )
        if converged and turn > (FIRST_PRUNED_TURN if pruning else 0):
            break
    assert estimate.fit is not None and estimate.force is not None
    return Hybrid(
        model=estimate.model,
        hold=record.hold,
        seconds=time.perf_counter() - began,
        removed=estimate.fit.removed,
        fit=estimate.fit,
        force=estimate.force,
        convergence=pd.DataFrame(turns),
        converged=converged,
    )


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Where the two stand after a turn.

    Attributes:
        model: the dictionary's, without the force, with its latest values.
        at_stages: (n_intervals, n_stages, n_equations), the force at the stages.
        fit: of the dictionary beside the force; None before the first turn.
        force: the network; None before the first turn.
    """

    model: Model
    at_stages: np.ndarray
    fit: Fit | None = None
    force: TrainedForce | None = None


def _dictionary_fit(
    problem: HybridProblem,
    before: _Estimate,
    data: Measurements,
    l1: dict[str, float] | float | None,
    pruning: Pruning | None,
) -> Fit:
    """The program for H and R with the force as it is."""
    return identify_forced(
        problem.forced(before.model),
        data,
        PHSILoss(problem.scheme),
        l1,
        pruning,
        layout=lambda grid: problem.with_force(before.at_stages),
        start=before.fit,
    )


def _schedule(force: NeuralForce, turn: int, seed: int) -> Schedule:
    epochs = force.epochs
    if turn > 0:
        epochs = max(int(force.epochs * LATER_EPOCHS), 1)
    return Schedule(epochs, force.learning_rate * RATE_DECAY**turn, seed)


def _with_force(
    problem: HybridProblem, before: _Estimate, fit: Fit, schedule: Schedule
) -> _Estimate:
    """The network on what the fit leaves, its last layer together with the fit."""
    model = problem.unforced(fit.model)
    data = problem.training_set(model, before.at_stages)
    start = before.force
    if start is None:
        start = untrained(
            model, problem.settings, problem.rows, problem.columns, data.stages
        )
    trained = train(problem.settings, start, data, schedule)
    trained = problem.with_best_output(trained, model, data)
    return _Estimate(model, problem.at_stages(trained, data.stages), fit, trained)
