"""The result of gradient descent with a force network beside the dictionary.

It needs no torch: the network is a list of matrices.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.baselines.descent_settings import JointForce
from phsi_opt.baselines.network_simulation import (
    Layers,
    force_variables,
    input_of,
    integrated,
    known_columns,
    network_values,
    state_rows,
)
from phsi_opt.baselines.result import Baseline


@dataclass(frozen=True, eq=False, kw_only=True)
class HybridBaseline(Baseline):
    """dx/dt = dictionary model + force network (the thesis' hybrid, Section 6.4).

    ``model``, its tables and `sympy` hold the dictionary part alone; `simulate` and
    `equations` know both.

    Attributes:
        neural: where the force acts and what it depends on.
        layers: (weight (n_in, n_out), bias) of every layer.
    """

    neural: JointForce
    layers: Layers

    def force(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """The network's force, (n, n_equations).

        Args:
            x: states (n, n_states).
            t: times (n,), if the force depends on them.
            u: inputs (n, n_inputs), if the force depends on them.

        Raises:
            DataError: if x has another shape, or t or u is needed.
        """
        x = state_rows(x, self.model.n_states)
        states = dict(zip(self.model.states, x.T, strict=True))
        known = known_columns(states, t, self.model.inputs, u)
        v = force_variables(self.neural.variables, known, len(x))
        return network_values(self.layers, v, self.neural.first)

    def without_force(self) -> Baseline:
        """The dictionary model alone; its loss, not that of the training, is NaN."""
        return Baseline(
            model=self.model,
            hold=self.hold,
            seconds=self.seconds,
            removed=self.removed,
            history=self.history,
            settings=self.settings,
            method=f"{self.method}, left out",
        )

    def equations(self) -> list[str]:
        """The right-hand sides, the network by the name ``network``."""
        inside = ", ".join(self.neural.variables)
        lines = super().equations()
        for i, name in enumerate(self.model.states):
            if name in self.neural.equations:
                lines[i] += f" + network_{name}({inside})"
        return lines

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) with the network's force, by SciPy.

        Args:
            t: increasing times (n_samples,).
            x0: states (n_states,) at t[0].
            u: inputs (n_samples, n_inputs) at t; None for a model without inputs.

        Raises:
            DataError: if t, x0 or u does not suit.
            SolveError: if the solution ends before the last time.
        """
        dictionary = self.casadi()
        rows = [self.model.index(name) for name in self.neural.equations]
        times = np.asarray(t, dtype=float)
        inputs_at = input_of(times, u, self.model.n_inputs, self.hold)

        def rhs(time: float, x: np.ndarray) -> np.ndarray:
            inputs = inputs_at(time)
            dx = np.array(dictionary(x, inputs, time)).ravel()
            dx[rows] += self.force(x[None, :], time, inputs[None, :])[0]
            return dx

        return integrated(rhs, t, x0, self.model.states)
