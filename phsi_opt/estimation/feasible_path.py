"""The likelihood along solutions of the model, maximised by Gauss-Newton steps.

After each step the model holds exactly.
IPOPT lets the states leave the model on the way to the optimum, which is what makes it
fast and robust far away. Where the model has sharp corners (a body that sticks) the
linearised model says little about states that have left it, and the iterates go to and
fro. Here each step is followed by a march from the starting states (`March`). Dry
friction makes such a march stable, and the likelihood itself judges the step.

Only programs in theta and the states are solved in this way: nothing with slack
variables, and no windows.
"""

import time
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.march import FEASIBLE, March
from phsi_opt.model.model import Model
from phsi_opt.optimization import endings
from phsi_opt.optimization.endings import Ending
from phsi_opt.optimization.evaluated import Evaluated
from phsi_opt.optimization.ipopt import Solution, Solver, at_bounds
from phsi_opt.optimization.outcome import Outcome
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.elimination import ReducedSystem, regularized_inverse
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.optimality_system import eliminated
from phsi_opt.transcription.parameter_vector import Theta

# Falls of -2 log likelihood: that a step promises at the optimum, that the last steps
# together make where it has settled, and that they make, or one promises, where a kink
# is in the way of every longer step. Where residuals are larger than the noise that is
# assumed, they are what the noise will be found to be (`_in_deviance`).
PROMISED = 1e-3
SETTLED_DEVIANCE = 0.05
KINK_DEVIANCE = 1.0
LAST = 3  # steps that are looked at
SHORTER = 0.3  # factor by which a step is shortened that leads upwards
TRIALS = 4  # how often
# Added to the diagonal of the information, as a share of it, where no length will do:
# at first, the factor by which it grows and shrinks, and at most.
FIRST_RIDGE = 0.1
GROWTH = 10.0
LARGEST_RIDGE = 1.0
ENOUGH = 1e-4  # share of the fall that a step promises by its slope, and has to make
# distance from a bound, over 1 + |value|, up to which a scaled parameter is at it
CLOSE = 1e-9
MAX_ITERATIONS = 30  # where it was measured, successes had taken up to 29


@dataclass(frozen=True, eq=False)
class _Place:
    """A point on the model, the objective and its gradient, in scaled variables."""

    z: np.ndarray
    objective: float
    gradient: np.ndarray


@dataclass(frozen=True, eq=False)
class _Step:
    """A change of all scaled variables, and the fall of -2 log likelihood that the
    undamped step promises.
    """

    change: np.ndarray
    promise: float


@dataclass(frozen=True, eq=False)
class _Lower:
    """A place that is lower, and the share of the step that led there."""

    place: _Place
    share: float


@dataclass(frozen=True, eq=False)
class _Descent:
    """Where the steps stand: the place, the objectives of the last `LAST` + 1 places,
    the ridge of the next step, the share that was taken of the last one, and how they
    ended.
    """

    place: _Place
    recent: tuple[float, ...]
    ridge: float = 0.0
    share: float = 1.0
    iterations: int = 0
    ending: Ending | None = None


class FeasiblePath:
    """The steps for one program in theta and the states alone (no slack variables).

    Args:
        program: the likelihood on ``grid``.
        model: that it was made of.
        grid: its nodes and intervals, uncut.
        unknown: which parameters each trajectory has.
        loss: whose integrator is used.
        max_seconds: the user's limit of time, in s.
    """

    def __init__(
        self,
        program: Program,
        model: Model,
        grid: Grid,
        unknown: Theta,
        loss: MaximumLikelihood,
        max_seconds: float = np.inf,
    ) -> None:
        self.program = program
        self.grid = grid
        self.unknown = unknown
        self.max_seconds = max_seconds
        self.n_states = model.n_states
        self.solver = Solver(program)
        self.theta = program.variables["theta"].slice
        self.x = program.variables["x"].slice
        self.lower = program.lower[self.theta]
        self.upper = program.upper[self.theta]
        # from the objective to -log likelihood
        self.half = program.residual.numel() / 2
        scale = program.scale[self.x][: model.n_states]
        self.march = March(model, grid, loss.integrator, scale)
        known = [program.z, program.settings]
        slope = ca.gradient(program.objective, program.z)
        values = [program.objective, ca.densify(slope), ca.densify(program.g)]
        self.values = Evaluated(ca.Function("values", known, values))

    def solve(
        self, start: np.ndarray, set_to: np.ndarray, raise_on_failure: bool = True
    ) -> Solution:
        """The optimum that is reached from a start, or how far it went.

        Args:
            start: scaled variables (n_variables,); theta and the starting states count,
                the other states are first guesses.
            set_to: values of ``program.settings``, (n_settings,).
            raise_on_failure: False returns what was reached.

        Raises:
            SolveError: no optimum was reached, and ``raise_on_failure``.
        """
        began = time.perf_counter()
        place = self.follow(start, set_to)
        if place is None:
            outcome = self._outcome(start, set_to, endings.PATH_FAILED, 0, began)
            z = start
        else:
            descent = self._descended(place, set_to, began)
            z = descent.place.z
            assert descent.ending is not None
            outcome = self._outcome(
                z, set_to, descent.ending, descent.iterations, began
            )
        if raise_on_failure and not outcome.success:
            raise SolveError(f"The solver failed: {outcome}")
        return self.solver.solution(z, set_to, outcome)

    def at(self, solution: Solution, set_to: np.ndarray) -> Solution:
        """As `Solver.at`, ``set_to`` (n_settings,)."""
        return self.solver.at(solution, set_to)

    def follow(self, z: np.ndarray, set_to: np.ndarray) -> _Place | None:
        """The solution of the model for theta and the starting states in z.

        Args:
            z: scaled variables (n_variables,); the states after the first ones are
                first guesses.
            set_to: values of ``program.settings``, (n_settings,).

        Returns:
            None where the model has no solution.
        """
        values = z * self.program.scale
        guesses = self.grid.split(values[self.x].reshape(-1, self.n_states))
        theta_by_run = values[self.theta][self.unknown.table].T
        solutions = []
        for run, guess in enumerate(guesses):
            states = self.march.states(run, guess, theta_by_run[run])
            if states is None:
                return None
            solutions.append(states)
        x = np.concatenate(solutions).ravel() / self.program.scale[self.x]
        on_model = np.concatenate([z[: self.x.start], x])
        objective, gradient, g = self._values_at(on_model, set_to)
        is_feasible = np.max(np.abs(g), initial=0.0) < FEASIBLE
        if not np.isfinite(objective[0]) or not is_feasible:
            return None
        return _Place(on_model, float(objective[0]), gradient)

    def _values_at(self, z: np.ndarray, set_to: np.ndarray) -> list[np.ndarray]:
        """Objective, its gradient, and the defects."""
        return [part.ravel().copy() for part in self.values(z, set_to)]

    def _descended(self, place: _Place, set_to: np.ndarray, began: float) -> _Descent:
        descent = _Descent(place, (*[np.inf] * LAST, place.objective))
        while descent.ending is None:
            limit = self._limit(descent.iterations, began)
            if limit is not None:
                return replace(descent, ending=limit)
            descent = self._advanced(descent, set_to)
        return descent

    def _limit(self, iterations: int, began: float) -> Ending | None:
        """The ending by a limit that has been reached, if any."""
        if iterations >= MAX_ITERATIONS:
            return endings.PATH_OUT_OF_ITERATIONS
        if time.perf_counter() - began > self.max_seconds:
            return endings.path_ending_by_time(self.max_seconds)
        return None

    def _advanced(self, now: _Descent, set_to: np.ndarray) -> _Descent:
        """After one more step, or after a larger ridge where no step leads down."""
        now = replace(now, iterations=now.iterations + 1)
        step = self._step(now.place, now.ridge, set_to)
        if not np.isfinite(step.promise):
            return replace(now, ending=endings.PATH_NO_SLOPES)
        if step.promise < PROMISED:
            return replace(now, ending=endings.PATH_OPTIMUM)
        first_share = min(1.0, now.share / SHORTER**2)
        lower = self._lower_place(now.place, step.change, first_share, set_to)
        if lower is not None:
            return self._moved(now, lower)
        if now.ridge < LARGEST_RIDGE:
            ridge = max(GROWTH * now.ridge, FIRST_RIDGE)
            return replace(now, ridge=ridge, share=1.0)
        ending = (
            endings.PATH_AT_KINK
            if step.promise < KINK_DEVIANCE
            else endings.PATH_FAILED
        )
        return replace(now, ending=ending)

    def _moved(self, before: _Descent, lower: _Lower) -> _Descent:
        objective = lower.place.objective
        recent = (*before.recent[1:], objective)
        fall = self._in_deviance(recent[0] - objective, lower.place)
        ending = None
        if fall < SETTLED_DEVIANCE and before.ridge == 0:
            ending = endings.PATH_SETTLED
        elif fall < KINK_DEVIANCE and lower.share < 1:
            ending = endings.PATH_AT_KINK
        ridge = before.ridge / GROWTH if before.ridge > FIRST_RIDGE else 0.0
        return _Descent(
            lower.place, recent, ridge, lower.share, before.iterations, ending
        )

    def _in_deviance(self, fall: float, at: _Place) -> float:
        """A fall of the objective as one of -2 log likelihood.

        The objective is the mean square of the residuals over the noise. Far above one
        it says that the noise is another one: a model that is wrong leaves a thousand
        times the noise of its sensors, and beside that a fall of one is nothing.
        """
        return 2 * self.half * fall / max(at.objective, 1.0)

    def _outcome(
        self,
        z: np.ndarray,
        set_to: np.ndarray,
        ending: Ending,
        iterations: int,
        began: float,
    ) -> Outcome:
        seconds = time.perf_counter() - began
        objective, _, g = self._values_at(z, set_to)
        return Outcome(
            success=ending.is_usable,
            status=ending.status,
            sentence=ending.sentence,
            advice=ending.advice,
            iterations=iterations,
            seconds=seconds,
            objective=float(objective[0]),
            infeasibility=float(np.max(np.abs(g), initial=0.0)),
            at_bounds=at_bounds(self.program, z),
        )

    def _step(self, place: _Place, ridge: float, set_to: np.ndarray) -> _Step:
        """The damped Gauss-Newton step of theta and the states.

        Its promise is NaN where the model has no slopes (a Stribeck speed of zero,
        say).
        """
        kkt = self.solver.kkt(place.z, set_to)
        if not np.all(np.isfinite(kkt.jacobian.data)):
            return _Step(np.zeros_like(place.z), np.nan)
        reduced = eliminated(
            self.grid, self.n_states, kkt.hessian, kkt.jacobian, self.theta.stop
        )
        information = reduced.information
        change = self._bounded(place, reduced, information)
        promise = self._in_deviance(-float(place.gradient @ change) / 2, place)
        if ridge > 0:
            diagonal = np.diag(np.diag(information))
            damped = information + ridge * diagonal
            change = self._bounded(place, reduced, damped)
        return _Step(change, promise)

    def _bounded(
        self, place: _Place, reduced: ReducedSystem, information: np.ndarray
    ) -> np.ndarray:
        """The step for some information on theta; parameters at a bound do not move out
        of it.
        """
        theta = place.z[self.theta]
        close = CLOSE * (1 + np.abs(theta))
        is_low = theta <= self.lower + close
        is_high = theta >= self.upper - close
        is_held = np.zeros(len(theta), dtype=bool)
        no_offset = np.zeros(self.program.g.numel())
        while True:
            held = np.flatnonzero(is_held).tolist()
            inverse = regularized_inverse(information * self.half, held)
            covariance = inverse * self.half
            step = reduced.solve(
                -place.gradient[self.x],
                no_offset,
                covariance,
                -place.gradient[self.theta],
            )
            is_out = ((step.theta < 0) & is_low) | ((step.theta > 0) & is_high)
            if not np.any(is_out & ~is_held):
                return step.joined
            is_held |= is_out

    def _lower_place(
        self, place: _Place, change: np.ndarray, share: float, set_to: np.ndarray
    ) -> _Lower | None:
        """The first place along the step that is low enough, from a share of it on.

        It is as much lower as its slope lets expect (Armijo's condition, 1966).
        """
        slope = float(place.gradient @ change)
        for _ in range(TRIALS):
            moved = place.z + share * change
            z = np.clip(moved, self.program.lower, self.program.upper)
            trial = self.follow(z, set_to)
            highest = place.objective + ENOUGH * share * slope
            if trial is not None and trial.objective < highest:
                return _Lower(trial, share)
            share *= SHORTER
        return None
