"""A force network trained with the dictionary: its settings, its values, its result.

Nothing here needs torch: a trained network is a list of matrices.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.baselines.descent import Baseline
from phsi_opt.simulation.simulate import simulate_forced

# (weight (n_in, n_out), bias (n_out,)) of every layer
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True)
class JointForce:
    """A force by a network beside the dictionary (the thesis' hybrid, Section 6.4).

    In the equation of each state i among ``equations``, F_i = net_i(variables).

    Args:
        equations: states in whose equations it acts.
        variables: states, inputs or "t" that it depends on.
        hidden: widths of the hidden layers, with ReLU.
        penalty: weight of the mean of ``|F|`` over the batch.
        first: function of the first hidden layer, "relu" (the text of the thesis) or
            "tanh" (its code, which has two hidden layers); with a large learning rate,
            a narrow input and only ReLU, units die.
        rate: learning rate of the weights; None takes that of the dictionary.
    """

    equations: tuple[str, ...]
    variables: tuple[str, ...]
    hidden: tuple[int, ...] = (100, 100, 100)
    penalty: float = 0.0
    first: str = "relu"
    rate: float | None = None

    def values(
        self,
        layers: Layers,
        states: Sequence[str],
        inputs: Sequence[str],
        x: Any,
        t: Any,
        u: Any,
    ) -> np.ndarray:
        """The force of a trained network, (n, n_equations), at states x (n, n_states),
        times t (n,) and inputs u (n, n_inputs) of these names.
        """
        x = state_rows(x, len(states))
        known: dict[str, Any] = dict(zip(states, x.T, strict=True)) | {"t": t}
        given = [None] * len(inputs) if u is None else np.atleast_2d(u).T
        known.update(zip(inputs, given, strict=True))
        columns = [np.broadcast_to(known[name], len(x)) for name in self.variables]
        return network_values(layers, np.stack(columns, 1), self.first)


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
        """The network's force, (n, n_equations)."""
        names = self.model.states, self.model.inputs
        return self.neural.values(self.layers, *names, x, t, u)

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) with the network's force, by SciPy."""
        return simulate_forced(self.model, t, x0, u, self._added, hold=self.hold)

    def _added(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """What the network adds to dx/dt, (n_states,)."""
        inputs = u[: self.model.n_inputs]
        rows = [self.model.index(name) for name in self.neural.equations]
        total = np.zeros(self.model.n_states)
        total[rows] = self.force(x[None, :], t, inputs[None, :])[0]
        return total


def network_values(layers: Layers, v: np.ndarray, first: str = "relu") -> np.ndarray:
    """Value (n_rows, n_outputs) of a network with ReLU between its layers.

    The same as ``torch_networks.relu_network``, in NumPy.
    """
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = v @ weight + bias
        v = np.tanh(v) if i == 0 and first == "tanh" else np.maximum(v, 0.0)
    weight, bias = layers[-1]
    result: np.ndarray = v @ weight + bias
    return result


def state_rows(x: Any, n_states: int) -> np.ndarray:
    """States as an array (n_rows, n_states)."""
    return np.asarray(x, dtype=float).reshape(-1, n_states)
