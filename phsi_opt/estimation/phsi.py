"""How `PHSILoss` is solved: from every starting point that a scan finds, with the
states fixed to the data.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.problem import State, Task
from phsi_opt.initialization.convex_start import starting_values
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.initialization.scaling import first_point
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import solve
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import PHSILoss, complete_intervals
from phsi_opt.transcription.parameter_vector import Theta

Pruner = Callable[
    [State, Callable[[State, Model, np.ndarray, dict[str, float]], State]], State
]


def by_defects(task: Task, loss: PHSILoss, start: Fit | None, prune: Pruner) -> State:
    """The best of the solutions from several starts, each pruned by ``prune``."""
    grid = task.layout(grid_of(task.data))
    used = complete_intervals(task.model, grid)
    model = resolve_guesses(task.model, used, np.nan_to_num(used.y))
    thetas = (
        [from_fit(model, start)] if start else starting_values(model, used, task.l1)
    )
    states = [
        prune(
            solve_defects(task, loss, model, grid, theta, task.l1),
            lambda s, m, theta, l1: solve_defects(task, loss, m, grid, theta, l1),
        )
        for theta in thetas
    ]
    return chosen(states, _preference)


def chosen(
    states: list[State], preference: Callable[[State], tuple[bool, float]]
) -> State:
    """The state that is preferred (smallest), with a note on how many of several starts
    agree with it.
    """
    best = min(states, key=preference)
    if len(states) == 1:
        return best
    objectives = sorted(s.solution.outcome.objective for s in states)
    close = sum(o <= objectives[0] * (1 + 1e-6) + 1e-12 for o in objectives)
    return replace(
        best,
        notes=(
            f"{close} of {len(states)} starting frequencies led to the best solution",
        ),
    )


def _preference(state: State) -> tuple[bool, float]:
    """Which of several starts to keep: the smaller loss, a term more only where it pays
    (BIC, as a rule of thumb).
    """
    loss, n = max(state.solution.outcome.objective, TINY), state.n_values
    return not state.solution.outcome.success, n * np.log(loss) + len(
        state.model.free
    ) * np.log(n)


def solve_defects(
    task: Task,
    loss: PHSILoss,
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    l1: dict[str, float],
) -> State:
    """One solve from ``theta``."""
    point = first_point(model, complete_intervals(model, grid), theta)
    program = loss.program(model, grid, point, l1)
    solution = solve(program, task.settings, raise_on_failure=False)
    task.say(f"PHSI loss, {len(model.free)} parameters: {solution.outcome}")
    sigma = np.full(model.n_states, np.nan)
    return State(
        task,
        loss,
        model,
        grid,
        Theta.of(model, ("",)),
        point,
        program,
        solution,
        l1,
        sigma,
    )


def from_fit(model: Model, start: Fit) -> np.ndarray:
    """The model's parameters at the values of a fit, where it has them."""
    return np.array([start.values.get(name, model.values[name]) for name in model.free])
