"""Points at which a model's functions and their slopes are taken, all at once."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model


@dataclass(frozen=True, eq=False)
class Points:
    """Arguments of a model's functions.

    Attributes:
        x: states, (n, n_states).
        u: inputs, (n, n_inputs).
        t: times, (n,).
        theta: free parameters, (n_free, n).
    """

    x: np.ndarray
    u: np.ndarray
    t: np.ndarray
    theta: np.ndarray

    @classmethod
    def middles(cls, record: Record) -> "Points":
        """The middle of every interval, where an estimate has the missing force."""
        grid = record.estimate.grid
        x = record.estimate.x
        middle = (x[grid.begin] + x[grid.begin + 1]) / 2
        u = (grid.u0 + grid.u1) / 2
        t = grid.t[grid.begin] + grid.h / 2
        return cls(middle, u, t, record.theta[:, grid.trajectory[grid.begin]])

    def values(self, function: ca.Function) -> np.ndarray:
        """Of a function of states, inputs, time and parameters, (n, n_out)."""
        mapped = function.map(len(self.t))
        columns = mapped(self.x.T, self.u.T, self.t[None, :], self.theta)
        return np.array(columns).T

    def slopes(self, model: Model) -> np.ndarray:
        """Of dx/dt in the free parameters, (n, n_states, n_free)."""
        rhs = model.rhs()
        arguments = [ca.SX.sym("s", rhs.size1_in(i)) for i in range(4)]
        jacobian = ca.densify(ca.jacobian(rhs(*arguments), arguments[-1]))
        # Row by row, so that reshaping gives back states and parameters.
        columns = ca.Function("slopes", arguments, [ca.vec(jacobian.T)])
        return self.values(columns).reshape(len(self.t), model.n_states, -1)
