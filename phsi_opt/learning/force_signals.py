"""A network's force as further inputs of a model, known at the stages of every step.

The solver then sees the force as it sees measured inputs.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import FIRST_NODE, SECOND_NODE


def signal(equation: str) -> str:
    """Name of the input that carries the force in an equation."""
    return f"network_{equation}"


def with_signals(model: Model, equations: Sequence[str]) -> Model:
    """The model with the force's inputs, each added to its equation."""
    F = dict(model.F)
    for equation in equations:
        terms = model.F.get(equation, Dictionary())
        F[equation] = Dictionary((*terms, Term(signal(equation))))
    names = [signal(equation) for equation in equations]
    return replace(model, inputs=(*model.inputs, *names), F=F)


def without_signals(model: Model, equations: Sequence[str]) -> Model:
    """The inverse of `with_signals`, with the values that the model has now."""
    names = [signal(equation) for equation in equations]
    F = {}
    for equation, terms in model.F.items():
        kept = tuple(term for term in terms if term.body not in names)
        if kept:
            F[equation] = Dictionary(kept)
    inputs = tuple(name for name in model.inputs if name not in names)
    return replace(model, inputs=inputs, F=F)


def with_force(grid: Grid, force: np.ndarray) -> Grid:
    """The grid with the force as inputs.

    Over each interval they are the straight line that passes through the force at the
    two stages of SRK4.

    Args:
        grid: without the force.
        force: (n_intervals, 2, n_equations).
    """
    slope = (force[:, 1] - force[:, 0]) / (SECOND_NODE - FIRST_NODE)
    begin = force[:, 0] - FIRST_NODE * slope
    at_nodes = np.zeros((grid.n_nodes, force.shape[2]))
    at_nodes[grid.begin] = begin
    return replace(
        grid,
        u0=np.hstack([grid.u0, begin]),
        u1=np.hstack([grid.u1, begin + slope]),
        u=np.hstack([grid.u, at_nodes]),
    )
