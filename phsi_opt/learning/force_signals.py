"""A network's force as further inputs of a model, known at the stages of every step.

The solver then sees the force as it sees measured inputs. Over each step it is the
polynomial in the share of the step that passes through it at the nodes of the scheme:
its coefficients are inputs that stay, and the share is one that rises from 0 to 1.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import integrator

SIGNAL = "network_signal_"  # the inputs begin so
STEP_SHARE = f"{SIGNAL}share"  # of the step


def with_signals(model: Model, equations: Sequence[str], scheme: str = "srk4") -> Model:
    """The model with the force's inputs, each added to its equation."""
    powers = range(len(integrator(scheme).nodes))
    F = dict(model.F)
    for equation in equations:
        added = [Term(f"{_coefficient(equation, k)}*{STEP_SHARE}**{k}") for k in powers]
        F[equation] = Dictionary((*model.F.get(equation, ()), *added))
    names = [_coefficient(equation, k) for k in powers for equation in equations]
    return replace(model, inputs=(*model.inputs, *names, STEP_SHARE), F=F)


def _coefficient(equation: str, power: int) -> str:
    return f"{SIGNAL}{equation}_{power}"


def without_signals(model: Model) -> Model:
    """The inverse of `with_signals`, with the values that the model has now."""
    signals = {name for name in model.inputs if name.startswith(SIGNAL)}
    F = {}
    for equation, terms in model.F.items():
        kept = tuple(term for term in terms if signals.isdisjoint(names_of(term.body)))
        if kept:
            F[equation] = Dictionary(kept)
    inputs = tuple(name for name in model.inputs if name not in signals)
    return replace(model, inputs=inputs, F=F)


def with_force(grid: Grid, force: np.ndarray, scheme: str = "srk4") -> Grid:
    """The grid with the force (n_intervals, n_stages, n_equations) as inputs.

    Where two stages are at one node (RK4's middle), it passes through the mean of both.
    """
    rule = integrator(scheme)
    shares = np.array(rule.shares)
    at_nodes = np.stack([force[:, shares == c].mean(axis=1) for c in rule.nodes])
    powers = np.vander(rule.nodes, increasing=True)
    coefficients = np.tensordot(np.linalg.inv(powers), at_nodes, axes=1)
    share = np.zeros((grid.n_intervals, 1))
    at_begin = np.hstack([*coefficients, share])
    u = np.zeros((grid.n_nodes, at_begin.shape[1]))
    u[grid.begin] = at_begin
    return replace(
        grid,
        u0=np.hstack([grid.u0, at_begin]),
        u1=np.hstack([grid.u1, *coefficients, share + 1]),
        u=np.hstack([grid.u, u]),
    )
