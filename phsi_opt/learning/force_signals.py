"""A network's force as further inputs of a model, known at the stages of every step.

The solver then sees the force as it sees measured inputs, which are straight lines over
every step. A line holds the force at one node of a scheme or at two; at the three of
RK4 a bend is added to it, the product of a rising and a falling line.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import Integrator, integrator

NODES_OF_A_LINE = 2
# c (1 - c) at the middle of a step is a quarter.
MIDDLE_OF_A_BEND = 1 / 4
# Inputs that carry the force in an equation: the line, and what makes the bend.
LINE = "network_{}"
RISE = "network_{}_rise"
FALL = "network_{}_fall"
BEND = f"{RISE}*{FALL}"


def is_bent(rule: Integrator) -> bool:
    """Whether a straight line cannot hold the force at all nodes."""
    return len(rule.nodes) > NODES_OF_A_LINE


def with_signals(model: Model, equations: Sequence[str], scheme: str = "srk4") -> Model:
    """The model with the force's inputs, each added to its equation."""
    bent = is_bent(integrator(scheme))
    bodies = [LINE, BEND] if bent else [LINE]
    F = dict(model.F)
    for equation in equations:
        added = [Term(body.format(equation, equation)) for body in bodies]
        F[equation] = Dictionary((*model.F.get(equation, ()), *added))
    carriers = [LINE, RISE, FALL] if bent else [LINE]
    names: list[str] = []
    for name in carriers:
        names += map(name.format, equations)
    return replace(model, inputs=(*model.inputs, *names), F=F)


def without_signals(model: Model, equations: Sequence[str]) -> Model:
    """The inverse of `with_signals`, with the values that the model has now."""
    forms = (LINE, RISE, FALL, BEND)
    added: set[str] = set()
    for form in forms:
        added.update(form.format(name, name) for name in equations)
    F = {}
    for equation, terms in model.F.items():
        kept = tuple(term for term in terms if term.body not in added)
        if kept:
            F[equation] = Dictionary(kept)
    inputs = tuple(name for name in model.inputs if name not in added)
    return replace(model, inputs=inputs, F=F)


def with_force(grid: Grid, force: np.ndarray, scheme: str = "srk4") -> Grid:
    """The grid with the force (n_intervals, n_stages, n_equations) as inputs.

    Over each interval they pass through the force at the nodes of the scheme; where two
    stages are at one node (RK4's middle), through the mean of both.
    """
    rule = integrator(scheme)
    shares = np.array(rule.shares)
    nodes = rule.nodes
    at_nodes = [force[:, shares == node].mean(axis=1) for node in nodes]
    first = at_nodes[0]
    last = at_nodes[-1]
    width = nodes[-1] - nodes[0] or 1.0  # through one node the line is level
    slope = (last - first) / width
    u0 = [first - nodes[0] * slope]
    u1 = [u0[0] + slope]
    if is_bent(rule):
        nothing = np.zeros_like(first)
        u0 += [nothing, np.ones_like(first)]
        u1 += [(at_nodes[1] - (first + last) / 2) / MIDDLE_OF_A_BEND, nothing]
    at_begin = np.hstack(u0)
    u = np.zeros((grid.n_nodes, at_begin.shape[1]))
    u[grid.begin] = at_begin
    return replace(
        grid,
        u0=np.hstack([grid.u0, at_begin]),
        u1=np.hstack([grid.u1, *u1]),
        u=np.hstack([grid.u, u]),
    )
