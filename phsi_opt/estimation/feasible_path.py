"""The likelihood along solutions of the model: Gauss-Newton steps after each of which
the model holds exactly.

IPOPT lets the states leave the model on the way to the optimum, which is what makes it
fast and robust far away. Where the model has sharp corners (a body that sticks) the
linearised model says little about states that have left it, and the iterates go to and
fro. Here each step is followed by a march: from the starting states interval by
interval, each defect solved for its end. Dry friction makes such a march stable, and
the likelihood itself judges the step.
"""

import time
from dataclasses import dataclass
from functools import cached_property, partial

import casadi as ca
import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import Solution, Solver, at_bounds
from phsi_opt.optimization.outcome import (
    PATH_ITERATIONS,
    PATH_TIME,
    Ending,
    Outcome,
    ending_by_time,
)
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import FEASIBLE_PATH
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.elimination import ReducedSystem, regularized_inverse
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

# Falls of -2 log likelihood: that a step promises at the optimum, that the last steps
# together make where it has settled, and that they make, or one promises, where a kink
# is in the way of every longer step.
PROMISED, SETTLED, AT_KINK = 1e-3, 0.05, 1.0
LAST = 3  # steps that are looked at
AT_A_KINK = "the likelihood settled at a kink of the model, where no slope vanishes"
SHORTER, TRIALS = (
    0.3,
    4,
)  # factor by which a step is shortened that leads upwards, and how often
FIRST_RIDGE, GROWTH, LARGEST_RIDGE = (
    0.1,
    10.0,
    1.0,
)  # added to the diagonal of the information where no length will do
ENOUGH = 1e-4  # share of the fall that a step promises by its slope, and has to make
FEASIBLE = 1e-7  # scaled defect up to which an interval is solved
MAX_ITERATIONS = 30
STEPS = "the steps along solutions of the model"
OTHERWISE = "Start from other values, or use more steps per sample."
NO_OPTIMUM = Ending(
    False, "no optimum was found along solutions of the model", OTHERWISE
)
NO_SLOPES = Ending(
    False, "the slopes of the model are not finite along its solution", OTHERWISE
)
OUT_OF_ITERATIONS = Ending(
    False,
    f"no optimum was found in {MAX_ITERATIONS} steps along solutions of the model",
    OTHERWISE,
)
CHUNK = 200  # intervals per call of the compiled march


@dataclass(frozen=True, eq=False)
class _Place:
    """A point on the model, the objective and its gradient, in scaled variables."""

    z: np.ndarray
    objective: float
    gradient: np.ndarray


class FeasiblePath:
    """The steps for one program in theta and the states alone (no slack variables)."""

    def __init__(
        self,
        program: Program,
        model: Model,
        grid: Grid,
        unknown: Theta,
        loss: MaximumLikelihood,
        max_seconds: float = np.inf,
    ) -> None:
        self.max_seconds = max_seconds
        self.program, self.grid, self.unknown, self.solver = (
            program,
            grid,
            unknown,
            Solver(program),
        )
        self.theta, self.x = (
            program.variables["theta"].slice,
            program.variables["x"].slice,
        )
        self.lower, self.upper = program.lower[self.theta], program.upper[self.theta]
        self.half = (
            program.residual.numel() / 2
        )  # from the objective to -log likelihood
        self.n_states = model.n_states
        self._march = partial(
            _march, model, loss.integrator, program.scale[self.x][: model.n_states]
        )
        known = [program.z, program.settings]
        values = [
            program.objective,
            ca.gradient(program.objective, program.z),
            program.g,
        ]
        self.values = ca.Function("values", known, values)

    @cached_property
    def march(self) -> ca.Function:
        """From state to state by Newton's method from the guesses."""
        return self._march(is_careful=False)

    @cached_property
    def careful_march(self) -> ca.Function:
        """The same, in the intervals in which that fails also from the state before."""
        return self._march(is_careful=True)

    def solve(
        self, start: np.ndarray, set_to: np.ndarray, raise_on_failure: bool = True
    ) -> Solution:
        """The optimum that is reached from theta and the starting states in ``start``
        (scaled), or how far it went.
        """
        began, ridge, length, iteration = time.perf_counter(), 0.0, 1.0, 0
        sentence, failed, status = "", NO_OPTIMUM, FEASIBLE_PATH
        at = self.follow(start, set_to)
        recent = [np.inf] * LAST + [np.inf if at is None else at.objective]
        while at is not None and not sentence:
            if iteration >= MAX_ITERATIONS:
                failed, status = OUT_OF_ITERATIONS, PATH_ITERATIONS
                break
            if time.perf_counter() - began > self.max_seconds:
                failed = ending_by_time(self.max_seconds, STEPS)
                status = PATH_TIME
                break
            iteration += 1
            step, promise = self._step(at, ridge, set_to)
            if not np.isfinite(promise):
                failed = NO_SLOPES
                break
            if promise < PROMISED:
                sentence = "a local optimum was found along solutions of the model"
                break
            new, length = self._shortened(
                at, step, min(1.0, length / SHORTER**2), set_to
            )
            if new is None and ridge >= LARGEST_RIDGE:
                sentence = AT_A_KINK if promise < AT_KINK else ""
                break
            if new is None:
                ridge, length = max(GROWTH * ridge, FIRST_RIDGE), 1.0
                continue
            at, recent = new, [*recent[1:], new.objective]
            gain = 2 * self.half * (recent[0] - at.objective)
            if gain < SETTLED and ridge == 0:
                sentence = "the likelihood settled along solutions of the model"
            elif gain < AT_KINK and length < 1:
                sentence = AT_A_KINK
            ridge = ridge / GROWTH if ridge > FIRST_RIDGE else 0.0
        z, seconds = start if at is None else at.z, time.perf_counter() - began
        objective, _, g = self.values(z, set_to)
        worst = float(np.max(np.abs(np.array(g)), initial=0.0))
        ending = Ending(True, sentence) if sentence else failed
        outcome = Outcome(
            ending.is_usable,
            status,
            ending.sentence,
            ending.advice,
            iteration,
            seconds,
            float(objective),
            worst,
            at_bounds(self.program, z),
        )
        if raise_on_failure and not outcome.success:
            raise SolveError(f"The solver failed: {outcome}")
        return self.solver.solution(z, set_to, outcome)

    def at(self, solution: Solution, set_to: np.ndarray) -> Solution:
        """As `Solver.at`."""
        return self.solver.at(solution, set_to)

    def follow(self, z: np.ndarray, set_to: np.ndarray) -> _Place | None:
        """The solution of the model for theta and the starting states in z; its other
        states are first guesses.
        """
        values = z * self.program.scale
        guess, columns = (
            values[self.x].reshape(-1, self.n_states),
            values[self.theta][self.unknown.table],
        )
        found = []
        for run, (x, theta) in enumerate(
            zip(self.grid.split(guess), columns.T, strict=True)
        ):
            along = self._along(run, x, theta)
            if along is None:
                return None
            found.append(along)
        there = np.concatenate(
            [
                z[: self.x.start],
                np.concatenate(found).ravel() / self.program.scale[self.x],
            ]
        )
        objective, gradient, g = (
            np.array(part).ravel() for part in self.values(there, set_to)
        )
        if np.isfinite(objective[0]) and np.max(np.abs(g), initial=0.0) < FEASIBLE:
            return _Place(there, float(objective[0]), gradient)
        return None

    def _along(
        self, run: int, guess: np.ndarray, theta: np.ndarray
    ) -> np.ndarray | None:
        """The states (n_nodes, n_states) of a trajectory from the first of ``guess``;
        None where they are lost.
        """
        grid = self.grid
        own = np.flatnonzero(grid.trajectory[grid.begin] == run)
        last = np.minimum(
            np.arange(-(-len(own) // CHUNK) * CHUNK), len(own) - 1
        )  # the last interval fills the chunk
        filled = own[last]
        columns = np.vstack(
            [
                guess[1:][last].T,
                grid.t[grid.begin[filled]][None, :],
                grid.h[filled][None, :],
                grid.u0[filled].T,
                grid.u1[filled].T,
                np.repeat(theta[:, None], len(filled), axis=1),
            ]
        )
        x, at = guess.copy(), guess[0]
        for first in range(0, len(own), CHUNK):
            size = min(CHUNK, len(own) - first)
            ends = self._chunk(self.march, at, columns[:, first : first + CHUNK], size)
            if ends is None:
                ends = self._chunk(
                    self.careful_march, at, columns[:, first : first + CHUNK], size
                )
            if ends is None:
                return None
            x[1 + first : 1 + first + size], at = ends, ends[-1]
        return x

    def _chunk(
        self, march: ca.Function, x: np.ndarray, columns: np.ndarray, size: int
    ) -> np.ndarray | None:
        """The states at the ends of the first ``size`` intervals, where all of them are
        solved.
        """
        ends, left = march(x, columns)
        is_solved = np.all(
            left.full().ravel()[:size] < FEASIBLE
        )  # not so where they are not finite
        return ends.full().T[:size] if is_solved else None

    def _step(
        self, at: _Place, ridge: float, set_to: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """The damped Gauss-Newton step of theta and the states, and the fall that the
        undamped one promises.

        The fall is NaN where the model has no slopes (a Stribeck speed of zero, say).
        """
        kkt = self.solver.kkt(at.z, set_to)
        if not np.all(np.isfinite(kkt.jacobian.data)):
            return np.zeros_like(at.z), np.nan
        reduced = ReducedSystem(
            self.grid, self.n_states, kkt.hessian, kkt.jacobian, self.theta, self.x
        )
        step = self._bounded(at, reduced, reduced.information)
        promise = -float(at.gradient @ step) * self.half
        if ridge > 0:
            step = self._bounded(
                at,
                reduced,
                reduced.information + ridge * np.diag(np.diag(reduced.information)),
            )
        return step, promise

    def _bounded(
        self, at: _Place, reduced: ReducedSystem, information: np.ndarray
    ) -> np.ndarray:
        """The step for some information on theta; parameters at a bound do not move out
        of it.
        """
        theta, held = at.z[self.theta], np.zeros(len(self.lower), dtype=bool)
        no_offset = np.zeros(self.program.g.numel())
        while True:
            covariance = (
                regularized_inverse(
                    information * self.half, np.flatnonzero(held).tolist()
                )
                * self.half
            )
            step = reduced.solve(
                -at.gradient[self.x], no_offset, covariance, -at.gradient[self.theta]
            )
            close = 1e-9 * (1 + np.abs(theta))
            out = ((step.theta < 0) & (theta <= self.lower + close)) | (
                (step.theta > 0) & (theta >= self.upper - close)
            )
            if not np.any(out & ~held):
                return step.joined
            held |= out

    def _shortened(
        self, at: _Place, step: np.ndarray, length: float, set_to: np.ndarray
    ) -> tuple[_Place | None, float]:
        """The first place along the step that is as much lower as its slope lets
        expect, and its share of the step.
        """
        slope = float(at.gradient @ step)
        for _ in range(TRIALS):
            z = at.z + length * step
            z = np.clip(z, self.program.lower, self.program.upper)
            new = self.follow(z, set_to)
            if (
                new is not None
                and new.objective < at.objective + ENOUGH * length * slope
            ):
                return new, length
            length *= SHORTER
        return None, length


def _march(
    model: Model, scheme: str, scale: np.ndarray, is_careful: bool
) -> ca.Function:
    """CasADi function (x, [guess, t, h, u0, u1, theta] of `CHUNK` intervals) -> the
    states at their ends, and defects.

    On the wrong side of a corner Newton's method may end where nothing is solved;
    ``is_careful`` begins it once more at the state before, where a body that sticks
    stays.
    """
    one = defect(model, scheme)
    x0, x1, *rest = (
        ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())
    )
    scaled = one(x0, x1, *rest) * rest[1] / ca.DM(scale)
    # Its own line search keeps Newton's method from going to and fro over a corner.
    options = {
        "abstol": 1e-10,
        "abstolStep": 1e-12,
        "max_iter": 50,
        "error_on_fail": False,
        "line_search": True,
        "show_eval_warnings": False,
    }
    problem = {"x": x1, "p": ca.vertcat(x0, *rest), "g": scaled}
    end = ca.rootfinder("end", "newton", problem, options)
    x, column = (
        ca.MX.sym("x", model.n_states),
        ca.MX.sym("column", ca.vertcat(x1, *rest).numel()),
    )
    known = ca.vertcat(x, column[model.n_states :])
    left = ca.Function("left", [x1, problem["p"]], [ca.norm_inf(scaled)])
    found = end(x0=column[: model.n_states], p=known)["x"]
    if is_careful:
        found = ca.if_else(
            left(found, known) < FEASIBLE, found, end(x0=x, p=known)["x"], True
        )
    return ca.Function("interval", [x, column], [found, left(found, known)]).mapaccum(
        CHUNK
    )
