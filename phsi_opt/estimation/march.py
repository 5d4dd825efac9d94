"""Solutions of a model on a grid: from a starting state interval by interval.

In every interval the scheme's defect is solved for the state at the end by Newton's
method, in compiled chunks of `MARCH_CHUNK` intervals. This is implicit integration with
the very scheme of the likelihood, so that its defects vanish to `FEASIBLE`; it judges
nothing and chooses no step size.
"""

from functools import cached_property

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect
from phsi_opt.transcription.grid import Grid

FEASIBLE = 1e-7  # scaled defect up to which an interval is solved
MARCH_CHUNK = 200  # intervals per call of the compiled march
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

    @cached_property
    def quick(self) -> ca.Function:
        """From state to state by Newton's method from the guesses."""
        return self._compiled(is_careful=False)

    @cached_property
    def careful(self) -> ca.Function:
        """The same, in the intervals in which that fails also from the state before."""
        return self._compiled(is_careful=True)

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
        for first in range(0, n_intervals, MARCH_CHUNK):
            size = min(MARCH_CHUNK, n_intervals - first)
            chunk = columns[:, first : first + MARCH_CHUNK]
            ends = _ends(self.quick, last, chunk, size)
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
        n_filled = -(-n_intervals // MARCH_CHUNK) * MARCH_CHUNK
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

    def _compiled(self, is_careful: bool) -> ca.Function:
        """CasADi function (x, [guess, t, h, u0, u1, theta] of `MARCH_CHUNK` intervals)
        -> the states at their ends, and defects.

        On the wrong side of a corner Newton's method may end where nothing is solved;
        ``is_careful`` begins it once more at the state before, where a body that sticks
        stays.
        """
        n_states = self.model.n_states
        one = defect(self.model, self.scheme)
        symbols = [
            ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())
        ]
        x0, x1, *rest = symbols
        h = rest[1]
        scaled = one(*symbols) * h / ca.DM(self.scale)
        given = ca.vertcat(x0, *rest)
        problem = {"x": x1, "p": given, "g": scaled}
        newton = ca.rootfinder("end", "newton", problem, NEWTON)
        size = ca.Function("left", [x1, given], [ca.norm_inf(scaled)])

        x = ca.MX.sym("x", n_states)
        column = ca.MX.sym("column", ca.vertcat(x1, *rest).numel())
        known = ca.vertcat(x, column[n_states:])
        end = newton(x0=column[:n_states], p=known)["x"]
        if is_careful:
            again = newton(x0=x, p=known)["x"]
            end = ca.if_else(size(end, known) < FEASIBLE, end, again, True)
        interval = ca.Function("interval", [x, column], [end, size(end, known)])
        return interval.mapaccum(MARCH_CHUNK)


def _ends(
    march: ca.Function, x: np.ndarray, columns: np.ndarray, size: int
) -> np.ndarray | None:
    """The states at the ends of the first ``size`` intervals, where all of them are
    solved.
    """
    ends, left = march(x, columns)
    # Not so where they are not finite.
    is_solved = np.all(left.full().ravel()[:size] < FEASIBLE)
    return ends.full().T[:size] if is_solved else None
