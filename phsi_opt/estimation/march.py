"""Solutions of a model on a grid: from a starting state interval by interval.

In every interval the scheme's defect is solved for the state at the end by Newton's
method, in compiled chunks of intervals: two steps first, which are enough from a guess
that is near. A chunk in which they are not is gone through once more, with more steps
and, in the intervals that need it, CasADi's own method with its line search. This is
implicit integration with the very scheme of the likelihood, so that its defects vanish
to `FEASIBLE`; it judges nothing and chooses no step size.
"""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.evaluated import Evaluated
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import argument_symbols

FEASIBLE = 1e-7  # scaled defect up to which an interval is solved
# Intervals per call of the compiled march, at most, and steps of Newton's method in all
# of them, and in those of a chunk in which these were not enough. Of 1500 marches along
# EMPS, 50 to 200 intervals, 1 to 4 steps and no quick march were tried: a quarter less
# than 4 steps in 200.
MARCH_CHUNK = 100
QUICK_STEPS = 2
MORE_STEPS = 4
SOLVED = 1e-10  # scaled defect at which those few steps have converged
# Its own line search keeps Newton's method from going to and fro over a corner.
NEWTON = {
    "abstol": 1e-10,
    "abstolStep": 1e-12,
    "max_iter": 50,
    "error_on_fail": False,
    "line_search": True,
    "show_eval_warnings": False,
}


class March:
    """The march along every trajectory of a grid.

    Args:
        model: whose solutions are sought.
        grid: its intervals.
        scheme: name of the integrator.
        scale: (n_states,) of each state, by which its defects are divided.
    """

    def __init__(
        self, model: Model, grid: Grid, scheme: str, scale: np.ndarray
    ) -> None:
        self.model = model
        self.grid = grid
        self.scheme = scheme
        self.scale = scale
        longest = int(np.bincount(grid.trajectory[grid.begin]).max(initial=1))
        self.chunk = min(MARCH_CHUNK, longest)

    @cached_property
    def quick(self) -> Evaluated:
        """From state to state by `QUICK_STEPS` of Newton's method from the guesses."""
        return self._accumulated(self._few_steps(QUICK_STEPS))

    @cached_property
    def careful(self) -> Evaluated:
        """The same with `MORE_STEPS`, and as many as it takes where these fail."""
        return self._accumulated(self._as_many_as_it_takes())

    def states(
        self, run: int, guess: np.ndarray, theta: np.ndarray
    ) -> np.ndarray | None:
        """The states of a trajectory; None where they are lost.

        Args:
            run: number of the trajectory.
            guess: (n_nodes, n_states), the starting state and guesses of the others.
            theta: (n_free,) parameters of the trajectory.

        Returns:
            (n_nodes, n_states).
        """
        columns = self._columns(run, guess, theta)
        n_intervals = len(guess) - 1
        states = guess.copy()
        last = guess[0]
        for first in range(0, n_intervals, self.chunk):
            size = min(self.chunk, n_intervals - first)
            chunk = columns[:, first : first + self.chunk]
            ends = _ends(self.quick, last, chunk, size, SOLVED)
            if ends is None:
                ends = _ends(self.careful, last, chunk, size)
            if ends is None:
                return None
            states[1 + first : 1 + first + size] = ends
            last = ends[-1]
        return states

    def _columns(self, run: int, guess: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """What the march is given of every interval, a column each; the last interval
        fills the last chunk.
        """
        grid = self.grid
        intervals = np.flatnonzero(grid.trajectory[grid.begin] == run)
        n_intervals = len(intervals)
        n_filled = -(-n_intervals // self.chunk) * self.chunk
        place = np.minimum(np.arange(n_filled), n_intervals - 1)
        filled = intervals[place]
        return np.vstack(
            [
                guess[1:][place].T,
                grid.t[grid.begin[filled]][None, :],
                grid.h[filled][None, :],
                grid.u0[filled].T,
                grid.u1[filled].T,
                np.repeat(theta[:, None], n_filled, axis=1),
            ]
        )

    def _accumulated(self, interval: ca.Function) -> Evaluated:
        """(x, [guess, t, h, u0, u1, theta] of a chunk of intervals) -> the states at
        their ends, and defects.
        """
        return Evaluated(interval.mapaccum(self.chunk))

    def _few_steps(self, n_steps: int) -> ca.Function:
        """One interval by so many steps of Newton's method, all written out."""
        one = _Interval.of(self.model, self.scheme, self.scale)
        slope = ca.jacobian(one.scaled, one.end)
        moved = one.end - ca.solve(slope, one.scaled)
        step = ca.Function("step", [one.end, one.given], [moved])
        left = ca.Function("left", [one.end, one.given], [one.left])
        x = ca.SX.sym("x", self.model.n_states)
        column = ca.SX.sym("column", one.n_column)
        known = ca.vertcat(x, column[self.model.n_states :])
        end = column[: self.model.n_states]
        for _ in range(n_steps):
            end = step(end, known)
        return ca.Function("interval", [x, column], [end, left(end, known)])

    def _as_many_as_it_takes(self) -> ca.Function:
        """One interval by `MORE_STEPS`, and by CasADi's method only where they fail."""
        few = self._few_steps(MORE_STEPS)
        newton = self._newton()
        x = ca.MX.sym("x", few.size1_in(0))
        column = ca.MX.sym("column", few.size1_in(1))
        end, left = few(x, column)
        soon = ca.vertcat(end, left)
        later = ca.vertcat(*newton(x, column))
        both = ca.if_else(left < SOLVED, soon, later, True)
        n_states = self.model.n_states
        return ca.Function("interval", [x, column], [both[:n_states], both[n_states]])

    def _newton(self) -> ca.Function:
        """One interval by CasADi's method.

        On the wrong side of a corner it may end where nothing is solved; then it begins
        once more at the state before, where a body that sticks stays.
        """
        n_states = self.model.n_states
        one = _Interval.of(self.model, self.scheme, self.scale)
        problem = {"x": one.end, "p": one.given, "g": one.scaled}
        newton = ca.rootfinder("end", "newton", problem, NEWTON)
        left = ca.Function("left", [one.end, one.given], [one.left])
        x = ca.MX.sym("x", n_states)
        column = ca.MX.sym("column", one.n_column)
        known = ca.vertcat(x, column[n_states:])
        end = newton(x0=column[:n_states], p=known)["x"]
        again = newton(x0=x, p=known)["x"]
        end = ca.if_else(left(end, known) < FEASIBLE, end, again, True)
        return ca.Function("interval", [x, column], [end, left(end, known)])


@dataclass(frozen=True, eq=False)
class _Interval:
    """Symbols of one interval.

    Attributes:
        end: the state at its end.
        given: the state at its beginning, t, h, u0, u1 and theta.
        scaled: the defect there, scaled.
    """

    end: ca.SX
    given: ca.SX
    scaled: ca.SX

    @classmethod
    def of(cls, model: Model, scheme: str, scale: np.ndarray) -> "_Interval":
        """Of a model by a scheme, ``scale`` (n_states,) of its states."""
        one = defect(model, scheme)
        x0, x1, *rest = argument_symbols(one)
        h = rest[1]
        scaled = one(x0, x1, *rest) * h / ca.DM(scale)
        return cls(x1, ca.vertcat(x0, *rest), scaled)

    @property
    def left(self) -> ca.SX:
        """The largest scaled defect."""
        return ca.norm_inf(self.scaled)

    @property
    def n_column(self) -> int:
        """Number of values that the march is given of an interval."""
        return int(self.given.numel())


def _ends(
    march: Evaluated,
    x: np.ndarray,
    columns: np.ndarray,
    size: int,
    tolerance: float = FEASIBLE,
) -> np.ndarray | None:
    """The states at the ends of the first ``size`` intervals, where all of them are
    solved, to a scaled defect below the tolerance.
    """
    ends, left = march(x, columns)
    # Not so where they are not finite.
    is_solved = np.all(left[:size] < tolerance)
    return ends[:size].copy() if is_solved else None
