"""The hybrid: a dictionary for H and R, a neural network for a force without a formula.

    dx/dt = (S - R) grad H(x) + F(x, t, u),    F_k = network in the forced equations k

The dictionary is identified by the solver and the network is trained in torch, in
turns, each with the other's latest estimate, on one and the same loss: the defects of
an integrator. A turn is

1. the program for H and R, with the force of the network as an input at the stages of
   every step (`transcription.stages`);
2. the network on what is left of the forced equations at these stages (AdamW);
3. its last layer once more, exactly, by least squares together with every coefficient
   of H and R: what the dictionary can explain is shared out as the joint loss wants it,
   whichever of the two was fitted first.

The network itself is in `hybrid_network`, its training in `hybrid_training`, and what
one turn computes in `hybrid_problem`.
"""

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_forced
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.interrupts import interruptible
from phsi_opt.learning.force_signals import without_signals
from phsi_opt.learning.hybrid_network import NeuralForce, TrainedForce
from phsi_opt.learning.hybrid_problem import HybridProblem
from phsi_opt.learning.hybrid_result import Hybrid
from phsi_opt.learning.hybrid_training import train
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid, aligned_once
from phsi_opt.transcription.losses import PHSILoss

__all__ = ["Hybrid", "NeuralForce", "TrainedForce", "hybrid"]

# By then the network has taken its part, and what is small is small beside it.
FIRST_PRUNED_TURN = 2
SETTLED = 1e-3  # relative change of a coefficient below which it does not move


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
) -> Hybrid:
    """Identify a dictionary and train a neural force beside it, in turns.

    The turns end when the coefficients move by less than a thousandth and the force by
    less than a hundredth, or after ``max_turns``.

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

    Raises:
        DataError: if data and model do not match.
        ModelError: for unknown names or integrators, or without torch.
        SolveError: if the solver fails.
    """
    began = time.perf_counter()
    record = aligned_once(model, data)
    trained = TrainedForce.of(model, force.equations, force.variables)
    problem = HybridProblem.of(model, record, trained, integrator)
    shape = (problem.grid.n_intervals, len(problem.rule.shares), len(trained.rows))
    at_stages = np.zeros(shape)
    loss = PHSILoss(integrator)
    fit: Fit | None = None
    turns = []
    converged = False
    for turn in range(max_turns):
        at_begin = (model, at_stages)
        prune = pruning if turn >= FIRST_PRUNED_TURN else None
        laid_out = partial(_given, problem.with_force(at_stages))
        forced = problem.forced(model)
        fit = identify_forced(forced, record, loss, l1, prune, laid_out, fit)
        model = without_signals(fit.model)
        stages = problem.training_set(model, at_stages)
        rate = force.learning_rate * 0.8**turn
        epochs = max(force.epochs // 4, 1) if turn > 0 else force.epochs
        in_turn = replace(force, epochs=epochs, learning_rate=rate)
        trained = train(in_turn, trained, stages, seed)
        trained = problem.with_best_output(trained, model, stages)
        at_stages = trained.at(stages.stages)
        row = problem.changes(*at_begin, model, at_stages)
        turns.append({"turn": turn + 1, **row})
        converged = (
            row["coefficient_change"] < SETTLED and row["force_change"] < 10 * SETTLED
        )
        if converged and turn > (FIRST_PRUNED_TURN if pruning else 0):
            break
    assert fit is not None
    return Hybrid(
        model=model,
        hold=checked_hold(record.hold, record.inputs),
        seconds=time.perf_counter() - began,
        removed=fit.removed,
        fit=fit,
        force=trained,
        convergence=pd.DataFrame(turns),
        converged=converged,
    )


def _given(grid: Grid, _: Grid) -> Grid:
    """The grid with the force, in place of the one that the measurements have."""
    return grid
