"""The verb: start -> program -> solve -> prune -> repeat, until there is a `Fit`."""

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from typing import Any

import numpy as np

from phsi_opt import start as starting
from phsi_opt import uncertainty
from phsi_opt.errors import DataError, ModelError, SolveError
from phsi_opt.fit import Fit
from phsi_opt.grid import Grid, grid_of
from phsi_opt.losses import MaximumLikelihood, MissingForce, PHSILoss, Point, complete, l1_weights, rate_size
from phsi_opt.measurements import Measurements
from phsi_opt.model import Model
from phsi_opt.nlp import Program
from phsi_opt.pruning import Pruning
from phsi_opt.simulate import simulate
from phsi_opt.solver import Settings, Solution, solve

Loss = PHSILoss | MaximumLikelihood
Progress = Callable[[str], None]
MOST_STEPS = 16
NOISE_ROUNDS = 6
CHECKED = 50


def identify(
    model: Model,
    data: Measurements,
    loss: Loss | None = None,
    l1: Mapping[str, float] | float | None = None,
    pruning: Pruning | None = None,
    *,
    start: Fit | None = None,
    settings: Settings | None = None,
    raise_on_failure: bool = True,
    progress: Progress | None = None,
) -> Fit:
    """Find the parameters of ``model`` that explain ``data``.

    Args:
        loss: `PHSILoss` or `MaximumLikelihood` (default).
        l1: weight lambda of |coefficient| per slot, such as {"H": 0.1, "F": 0.01}; a number stands for both.
        pruning: how terms are removed; None keeps them all.
        start: a fit of a similar model of the same measurements, to start from its states and values.
        raise_on_failure: False returns the fit with an outcome that says what went wrong.
        progress: called with a line of text as the work goes on, such as ``print``.

    Raises `DataError` if model and data do not match, `ModelError` for a model that cannot be solved, `SolveError` if
    the solver fails.
    """
    began = time.perf_counter()
    loss = MaximumLikelihood() if loss is None else loss
    if not model.free:
        raise ModelError("the model has no free parameter, so there is nothing to identify; use compare or simulate.")
    task = _Task(model, matched(model, data), l1_weights(l1), pruning, settings or Settings(), progress or _silent)
    state = loss_methods(loss)(task, loss, start)
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
    """`identify` with further inputs that the measurements do not hold: ``layout`` adds them to the grid."""
    task = _Task(model, data, l1_weights(l1), pruning, Settings(), _silent, layout)
    state = _by_defects(task, loss, start)
    if not state.solution.outcome.success:
        raise SolveError(f"The solver failed: {state.solution.outcome}")
    return state.fit()


def loss_methods(loss: Loss) -> Callable[["_Task", Any, Fit | None], "_State"]:
    """How each loss is solved."""
    for kind, method in ((PHSILoss, _by_defects), (MaximumLikelihood, _by_likelihood)):
        if isinstance(loss, kind):
            return method
    hint = (
        " A missing force is estimated by diagnose(fit, data).missing_force." if isinstance(loss, MissingForce) else ""
    )
    raise ModelError(
        f"loss={loss!r} is not a loss that finds parameters; expected PHSILoss() or MaximumLikelihood().{hint}"
    )


def matched(model: Model, data: Measurements) -> Measurements:
    """The measurements with their states and inputs in the model's order; raises `DataError` if they do not match."""
    for what, mine, theirs in (("state", model.states, data.states), ("input", model.inputs, data.inputs)):
        for name in mine:
            if name not in theirs:
                hint = f"; declare it as not measured: states={{..., {name!r}: None}}" if what == "state" else ""
                raise DataError(f"{what} {name!r} of the model is not in the measurements ({', '.join(theirs)}){hint}.")
    if extra := set(data.states) - set(model.states):
        raise DataError(f"state {sorted(extra)[0]!r} of the measurements is not in the model; leave its column out.")
    columns, inputs = [data.states.index(n) for n in model.states], [data.inputs.index(n) for n in model.inputs]
    if data.states == model.states and data.inputs == model.inputs:
        return data
    runs = tuple(replace(run, x=run.x[:, columns], u=run.u[:, inputs]) for run in data.trajectories)
    kept = {"t", *model.states, *model.inputs}
    units = {name: unit for name, unit in data.units.items() if name in kept}
    return replace(data, trajectories=runs, states=tuple(model.states), inputs=tuple(model.inputs), units=units)


@dataclass(frozen=True, eq=False)
class _Task:
    model: Model
    data: Measurements
    l1: dict[str, float]
    pruning: Pruning | None
    settings: Settings
    say: Progress
    layout: Callable[[Grid], Grid] = lambda grid: grid


@dataclass(frozen=True, eq=False)
class _State:
    """Where the work stands: the model (with what is left of it), the program and its solution."""

    task: _Task
    loss: Loss
    model: Model
    grid: Grid
    point: Point
    program: Program
    solution: Solution
    l1: dict[str, float]
    sigma: np.ndarray
    removed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        return dict(zip(self.model.free, self.solution.values["theta"].tolist(), strict=True))

    @property
    def n_values(self) -> int:
        if isinstance(self.loss, PHSILoss):
            return complete(self.model, self.grid).n_intervals * self.model.n_states
        return int(self.grid.measured.sum())

    def fit(self) -> Fit:
        uncertain = self._uncertainty()
        model = self.model.with_values(self.values)
        likelihood = isinstance(self.loss, MaximumLikelihood)
        names = zip(self.model.states, self.sigma, self.grid.measured.T, strict=True)
        return Fit(
            model=model,
            loss=type(self.loss).__name__,
            loss_value=self._loss_value(),
            covariance=uncertain.covariance,
            noise={name: float(s) for name, s, seen in names if seen.any()} if likelihood else {},
            outcome=self.solution.outcome,
            n_values=self.n_values,
            bic=self._bic() if likelihood else np.nan,
            hold=self.task.data.hold,
            units=dict(self.task.data.units),
            removed=self.removed,
            warnings=self.notes + uncertain.warnings,
            provenance=_provenance(self),
            states=self._states() if likelihood else (),
        )

    def _uncertainty(self) -> uncertainty.Uncertainty:
        n = len(self.model.free)
        if not self.solution.outcome.success:
            return uncertainty.unknown(n, "no standard errors: the solver did not reach an optimum")
        if any(self.l1.values()):
            return uncertainty.unknown(
                n, "no standard errors: the L1 term shrinks the coefficients (prune with debias)"
            )
        if isinstance(self.loss, MaximumLikelihood):
            return uncertainty.of_likelihood(self.model, self.program, self.solution, self.n_values)
        used = complete(self.model, self.grid)
        theta, scale = self.solution.values["theta"], self.point.theta_scale
        return uncertainty.of_defects(
            self.model, used, self.loss.integrator, theta, scale, self.solution.outcome.at_bounds
        )

    def _loss_value(self) -> float:
        value = float(np.sum(self.solution.residual**2) / 2)
        return value * rate_size(complete(self.model, self.grid)) if isinstance(self.loss, PHSILoss) else value

    def _bic(self) -> float:
        counts = self.grid.measured.sum(axis=0)
        misfit = self._loss_value() * self.n_values
        return float(
            misfit + np.sum(counts * np.log(2 * np.pi * self.sigma**2)) + len(self.model.free) * np.log(self.n_values)
        )

    def _states(self) -> tuple[np.ndarray, ...]:
        x = self.solution.values["x"].reshape(self.grid.y.shape)
        edges = [*self.grid.first.tolist(), self.grid.n_nodes]
        return tuple(x[a:b][self.grid.sample[a:b]] for a, b in pairwise(edges))


def _by_defects(task: _Task, loss: PHSILoss, start: Fit | None) -> _State:
    grid = task.layout(grid_of(task.data))
    used = complete(task.model, grid)
    model = starting.resolved(task.model, used, np.nan_to_num(used.y))
    thetas = [_from_fit(model, start)] if start else starting.starting_values(model, used, task.l1)
    states = [
        _pruned(
            _solve_defects(task, loss, model, grid, theta, task.l1),
            lambda s, m, theta, l1: _solve_defects(task, loss, m, grid, theta, l1),
        )
        for theta in thetas
    ]
    best = min(states, key=_preference)
    return replace(best, notes=(_agreement(states),)) if len(states) > 1 else best


def _preference(state: _State) -> tuple[bool, float]:
    """Which of several starts to keep: the smaller loss, a term more only where it pays (BIC, as a rule of thumb)."""
    loss, n = max(state.solution.outcome.objective, 1e-300), state.n_values
    return not state.solution.outcome.success, n * np.log(loss) + len(state.model.free) * np.log(n)


def _solve_defects(
    task: _Task, loss: PHSILoss, model: Model, grid: Grid, theta: np.ndarray, l1: dict[str, float]
) -> _State:
    point = starting.first_point(model, complete(model, grid), theta)
    program = loss.program(model, grid, point, l1)
    solution = solve(program, task.settings, raise_on_failure=False)
    task.say(f"PHSI loss, {len(model.free)} parameters: {solution.outcome}")
    return _State(task, loss, model, grid, point, program, solution, l1, np.full(model.n_states, np.nan))


def _agreement(states: list[_State]) -> str:
    objectives = sorted(s.solution.outcome.objective for s in states)
    close = sum(o <= objectives[0] * (1 + 1e-6) + 1e-12 for o in objectives)
    return f"{close} of {len(states)} starting frequencies led to the best solution"


Solver = Callable[["_State", Model, np.ndarray, dict[str, float]], "_State"]


def _pruned(state: _State, solver: Solver) -> _State:
    """Warm-started re-solves until the support stays: by size with L1, then without it, then by significance."""
    pruning = state.task.pruning
    if pruning is None:
        return state
    n_tests = len(pruning.candidates(state.model))
    for _ in range(pruning.max_rounds):
        gone, l1 = pruning.small(state.model, state.values), state.l1
        if not gone and pruning.debias and any(l1.values()):
            l1 = {}
        elif not gone and pruning.significance is not None and state.solution.outcome.success:
            gone = pruning.insignificant(state.model, state.values, state._uncertainty().covariance, n_tests)
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
        theta = np.array([state.values[name] for name in model.free])
        removed = (*state.removed, *sorted(gone))
        state = replace(solver(state, model, theta, l1), removed=removed, notes=state.notes)
    return state


def _by_likelihood(task: _Task, loss: MaximumLikelihood, start: Fit | None) -> _State:
    _check_enough(task)
    given = _given_noise(loss, task.data)
    sigma = starting.initial_noise(task.data, given)
    steps = loss.steps or 1
    model, theta, x, sigma, notes = _likelihood_start(task, loss, sigma, given is not None, start)
    state = _solve_likelihood(task, loss, model, steps, theta, x, sigma, task.l1)
    while loss.steps is None and steps < MOST_STEPS and state.solution.outcome.success and _is_coarse(state):
        steps *= 2
        task.say(f"integration error is visible beside the noise: {steps} steps per sample")
        state = _solve_likelihood(
            task, loss, model, steps, state.solution.values["theta"], state._states(), state.sigma, task.l1
        )
    state = replace(state, notes=notes)
    return _pruned(
        state,
        lambda s, m, th, l1: _solve_likelihood(task, loss, m, steps, th, s._states(), s.sigma, l1),
    )


def _check_enough(task: _Task) -> None:
    n_values = sum(int(np.isfinite(run.x).sum()) for run in task.data.trajectories)
    n_unknown = len(task.model.free) + task.data.n_trajectories * task.model.n_states
    if n_values <= n_unknown:
        raise DataError(
            f"{n_values} measured values are too few for {n_unknown} unknowns ({len(task.model.free)} parameters and "
            f"the starting states of {task.data.n_trajectories} trajectories); measure more, or fix parameters."
        )


def _given_noise(loss: MaximumLikelihood, data: Measurements) -> np.ndarray | None:
    noise = loss.noise if loss.noise is not None else data.noise
    if noise is None:
        return None
    for name in data.measured:
        if name not in noise or not (np.isfinite(noise[name]) and noise[name] > 0):
            raise DataError(
                f"noise of the measured state {name!r} is {noise.get(name)!r}; expected a number above zero."
            )
    return np.array([noise.get(name, 1.0) for name in data.states])


Started = tuple[Model, np.ndarray, tuple[np.ndarray, ...], np.ndarray, tuple[str, ...]]


def _likelihood_start(
    task: _Task, loss: MaximumLikelihood, sigma: np.ndarray, known: bool, start: Fit | None
) -> Started:
    """Model with guesses resolved, theta, states at the samples, noise, notes."""
    grid = grid_of(task.data)
    if start is not None and len(start.states) == task.data.n_trajectories:
        if not known:
            sigma = np.array([start.noise.get(name, 1.0) for name in task.model.states])
        model = starting.resolved(task.model, grid, np.concatenate(start.states))
        return model, _from_fit(model, start), start.states, sigma, ()
    task.say("starting values")
    notes: tuple[str, ...] = ()
    model, complete_data = task.model, bool(grid.measured.all())
    x = grid.y
    if not complete_data:
        x, sigma = _smooth(model, grid, sigma, known, loss)
    for _ in range(2):
        model = starting.resolved(model, grid, x)
        by_defects = replace(task, model=model, l1=task.l1, pruning=None, say=_silent)
        first = _from_states(by_defects, loss, grid, x)
        notes = first.notes
        model = model.with_values(first.values)
        if complete_data:
            break
        x, sigma = _smooth(model, grid, sigma, known, loss)
    theta = np.array([model.values[name] for name in model.free])
    return model, theta, _split(grid, x), sigma, notes


def _smooth(
    model: Model, grid: Grid, sigma: np.ndarray, known: bool, loss: MaximumLikelihood
) -> tuple[np.ndarray, np.ndarray]:
    estimate = starting.smoothed(model, grid, sigma, loss.integrator, known)
    return estimate.x, estimate.sigma


def _from_states(task: _Task, loss: MaximumLikelihood, grid: Grid, x: np.ndarray) -> _State:
    known = starting.with_states(grid, x)
    thetas = starting.starting_values(task.model, known, task.l1)
    states = [_solve_defects(task, PHSILoss(loss.integrator), task.model, known, theta, task.l1) for theta in thetas]
    best = min(states, key=lambda s: (not s.solution.outcome.success, s.solution.outcome.objective))
    return replace(best, notes=(_agreement(states),) if len(states) > 1 else ())


def _split(grid: Grid, x: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(x[a:b] for a, b in pairwise([*grid.first.tolist(), grid.n_nodes]))


def _from_fit(model: Model, start: Fit) -> np.ndarray:
    return np.array([start.values.get(name, model.values[name]) for name in model.free])


def _solve_likelihood(
    task: _Task, loss: MaximumLikelihood, model: Model, steps: int, theta: np.ndarray, x: tuple[np.ndarray, ...],
    sigma: np.ndarray, l1: dict[str, float],
) -> _State:  # fmt: skip
    """Solve; where the noise is not given, estimate it from the residuals and solve again until it stays."""
    grid = grid_of(task.data, steps)
    nodes = np.concatenate([_between(run, steps) for run in x])
    estimated = _given_noise(loss, task.data) is None
    for _ in range(NOISE_ROUNDS if estimated else 1):
        scale = starting.first_point(model, grid).x_scale
        spread = np.where(grid.measured.any(axis=0), scale, np.maximum(np.std(nodes, axis=0), 1e-12))
        point = Point(theta, nodes, starting.theta_scale(model, grid, theta, nodes, spread), spread)
        program = loss.program(model, grid, point, l1, sigma)
        solution = solve(program, task.settings, raise_on_failure=False)
        task.say(f"maximum likelihood, {len(model.free)} parameters, {nodes.size} states: {solution.outcome}")
        state = _State(task, loss, model, grid, point, program, solution, l1, sigma)
        if not solution.outcome.success or not estimated:
            break
        theta, nodes = solution.values["theta"], solution.values["x"].reshape(nodes.shape)
        new = _noise_of(grid, nodes, sigma, len(theta))
        change, sigma = np.max(np.abs(np.log(new / sigma))), new
        if change < 0.005:
            break
    return state


def _between(x: np.ndarray, steps: int) -> np.ndarray:
    position = np.arange((len(x) - 1) * steps + 1) / steps
    return np.column_stack([np.interp(position, np.arange(len(x)), column) for column in x.T])


def _noise_of(grid: Grid, x: np.ndarray, sigma: np.ndarray, n_theta: int) -> np.ndarray:
    """Root mean square residual per channel, with the degrees of freedom that the fit used taken off."""
    seen = grid.measured
    n_free = n_theta + len(grid.first) * x.shape[1]
    share = max(1 - n_free / seen.sum(), 0.1)
    result = sigma.copy()
    for k in np.flatnonzero(seen.any(axis=0)):
        rms = np.sqrt(np.mean((grid.y[seen[:, k], k] - x[seen[:, k], k]) ** 2))
        floor = starting.CLEANEST * max(float(np.nanstd(grid.y[:, k])), 1e-300)
        result[k] = max(rms / np.sqrt(share), floor)
    return result


def _is_coarse(state: _State) -> bool:
    """Whether an independent integration leaves the estimated states by more than a tenth of the noise.

    Of many trajectories, `CHECKED` evenly spread ones are integrated.
    """
    model = state.model.with_values(state.values)
    seen = state.grid.measured.any(axis=0)
    pairs = list(zip(state.task.data.trajectories, state._states(), strict=True))
    try:
        for run, x in pairs[:: -(-len(pairs) // CHECKED)]:
            exact = simulate(model, run.t, x[0], run.u, hold=state.task.data.hold)
            error = np.sqrt(np.mean(((exact - x) / state.sigma)[:, seen] ** 2))
            if error > 0.1:
                return True
    except SolveError:
        return False
    return False


def data_digest(data: Measurements) -> str:
    """A fingerprint of the numbers of the measurements."""
    digest = hashlib.sha256()
    for run in data.trajectories:
        for array in (run.t, run.x, run.u):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _provenance(state: _State) -> dict[str, Any]:
    try:
        release = version("phsi_opt")
    except PackageNotFoundError:
        release = "unknown"
    return {
        "phsi_opt": release,
        "loss": repr(state.loss),
        "l1": dict(state.task.l1),
        "pruning": repr(state.task.pruning),
        "data_sha256": data_digest(state.task.data),
        "n_trajectories": state.task.data.n_trajectories,
        "n_samples": state.task.data.n_samples,
    }


def _silent(line: str) -> None:
    pass
