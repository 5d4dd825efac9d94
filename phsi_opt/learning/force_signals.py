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
from phsi_opt.transcription.stages import StageRule, stage_rule

NODES_OF_A_LINE = 2
# c (1 - c) at the middle of a step is a quarter.
MIDDLE_OF_A_BEND = 1 / 4


def signal(equation: str) -> str:
    """Name of the input that carries the force in an equation."""
    return f"network_{equation}"


def _rise(equation: str) -> str:
    return f"{signal(equation)}_rise"


def _fall(equation: str) -> str:
    return f"{signal(equation)}_fall"


def _bend(equation: str) -> str:
    """The formula of what the force has beside a straight line."""
    return f"{_rise(equation)}*{_fall(equation)}"


def is_bent(rule: StageRule) -> bool:
    """Whether a straight line cannot hold the force at all nodes."""
    return len(rule.nodes) > NODES_OF_A_LINE


def with_signals(model: Model, equations: Sequence[str], scheme: str = "srk4") -> Model:
    """The model with the force's inputs, each added to its equation."""
    bent = is_bent(stage_rule(scheme))
    F = dict(model.F)
    for equation in equations:
        terms = [*model.F.get(equation, Dictionary()), Term(signal(equation))]
        if bent:
            terms.append(Term(_bend(equation)))
        F[equation] = Dictionary(tuple(terms))
    names = [signal(equation) for equation in equations]
    if bent:
        names += [_rise(equation) for equation in equations]
        names += [_fall(equation) for equation in equations]
    return replace(model, inputs=(*model.inputs, *names), F=F)


def without_signals(model: Model, equations: Sequence[str]) -> Model:
    """The inverse of `with_signals`, with the values that the model has now."""
    added = set()
    for equation in equations:
        added |= {signal(equation), _rise(equation), _fall(equation), _bend(equation)}
    F = {}
    for equation, terms in model.F.items():
        kept = tuple(term for term in terms if term.body not in added)
        if kept:
            F[equation] = Dictionary(kept)
    inputs = tuple(name for name in model.inputs if name not in added)
    return replace(model, inputs=inputs, F=F)


def with_force(grid: Grid, force: np.ndarray, scheme: str = "srk4") -> Grid:
    """The grid with the force as inputs.

    Over each interval they pass through the force at the nodes of the scheme; where two
    stages are at one node (RK4's middle), through the mean of both.

    Args:
        grid: without the force.
        force: (n_intervals, n_stages, n_equations).
        scheme: name of the integrator.
    """
    rule = stage_rule(scheme)
    at_nodes = _at_nodes(force, rule)
    first = at_nodes[:, 0]
    slope = np.zeros_like(first)
    if len(rule.nodes) > 1:
        slope = (at_nodes[:, -1] - first) / (rule.nodes[-1] - rule.nodes[0])
    begin = first - rule.nodes[0] * slope
    u0 = [begin]
    u1 = [begin + slope]
    if is_bent(rule):
        nothing = np.zeros_like(begin)
        whole = np.ones_like(begin)
        line_in_the_middle = (first + at_nodes[:, -1]) / 2
        u0 += [nothing, whole]
        u1 += [(at_nodes[:, 1] - line_in_the_middle) / MIDDLE_OF_A_BEND, nothing]
    return _with_inputs(grid, np.hstack(u0), np.hstack(u1))


def _at_nodes(force: np.ndarray, rule: StageRule) -> np.ndarray:
    """The force at the distinct nodes, (n_intervals, n_nodes, n_equations)."""
    shares = np.array(rule.shares)
    values = [force[:, shares == node].mean(axis=1) for node in rule.nodes]
    return np.stack(values, axis=1)


def _with_inputs(grid: Grid, u0: np.ndarray, u1: np.ndarray) -> Grid:
    at_nodes = np.zeros((grid.n_nodes, u0.shape[1]))
    at_nodes[grid.begin] = u0
    return replace(
        grid,
        u0=np.hstack([grid.u0, u0]),
        u1=np.hstack([grid.u1, u1]),
        u=np.hstack([grid.u, at_nodes]),
    )
