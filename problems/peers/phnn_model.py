"""The trained pseudo-Hamiltonian network: its energy, its force, its simulation.

It needs no torch: the networks are lists of matrices. Their training is in `phnn`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.data.checks import Hold
from phsi_opt.model.model import FirstOrder
from phsi_opt.simulation.simulate import simulate_forced
from problems.peers.joint_force import JointForce, Layers, state_rows


@dataclass(frozen=True, eq=False, kw_only=True)
class PHNN:
    """dx/dt = (S - R) grad H(x) + F with trained networks H and F.

    Attributes:
        damping: R_ii by state.
        energy_layers, force_layers: (weight (n_in, n_out), bias) of every layer.
        neural: where the force acts and what it depends on; None without force.
        loss_value: mean of ``|(x1 - x0)/h - Psi|^2`` over all data, without penalty.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    S: np.ndarray
    damping: dict[str, float]
    energy_layers: Layers
    force_layers: Layers = ()
    neural: JointForce | None = None
    hold: Hold = "linear"
    seconds: float = float("nan")
    loss_value: float = float("nan")
    history: pd.DataFrame = field(default_factory=pd.DataFrame)
    settings: str = ""
    method: str = "PHNN"

    def energy(self, x: Any) -> np.ndarray:
        """H(x) - H(0), (n,), at states x (n, n_states).

        An energy is known up to a constant.
        """
        x = state_rows(x, len(self.states))
        weight, _ = self.energy_layers[-1]  # its bias drops out

        def output(x: np.ndarray) -> np.ndarray:
            return np.asarray(hidden_values(self.energy_layers, x)[-1] @ weight)

        return (output(x) - output(np.zeros_like(x[:1])))[:, 0]

    def efforts(self, x: Any) -> np.ndarray:
        """grad H, (n, n_states), at states x (n, n_states)."""
        x = state_rows(x, len(self.states))
        hidden = hidden_values(self.energy_layers, x)
        return np.asarray(input_gradient(self.energy_layers, hidden))

    def force(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """F, (n, n_states); zero without force."""
        x = state_rows(x, len(self.states))
        result = np.zeros((len(x), len(self.states)))
        if self.neural is None:
            return result
        rows = [self.states.index(name) for name in self.neural.equations]
        names = self.states, self.inputs
        result[:, rows] = self.neural.values(self.force_layers, *names, x, t, u)
        return result

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0], by SciPy."""
        damping = [self.damping.get(name, 0.0) for name in self.states]
        structure = self.S - np.diag(damping)

        def rates(time: float, x: np.ndarray, inputs: np.ndarray) -> np.ndarray:
            row = x[None, :]
            inside = self.efforts(row) @ structure.T
            known = inputs[None, : len(self.inputs)]
            dx: np.ndarray = (inside + self.force(row, time, known))[0]
            return dx

        at_rest = FirstOrder(self.states, {}, self.inputs)
        return simulate_forced(at_rest, t, x0, u, rates, hold=self.hold)


def hidden_values(layers: Sequence[tuple[Any, Any]], v: Any) -> list[Any]:
    """Values of the hidden layers with tanh, of torch or NumPy alike."""
    values = []
    for weight, bias in layers[:-1]:
        v = v @ weight + bias
        v = np.tanh(v) if isinstance(v, np.ndarray) else v.tanh()
        values.append(v)
    return values


def input_gradient(layers: Sequence[tuple[Any, Any]], hidden: Sequence[Any]) -> Any:
    """Gradient of a network with tanh by its inputs, (n_rows, n_inputs).

    It is written out, so that torch derives only once.
    """
    output_weight, _ = layers[-1]
    slope = output_weight.T * (1 - hidden[-1] ** 2)
    # Backwards from the last hidden layer but one; the first layer has no tanh before.
    for (weight, _), value in zip(layers[-2:0:-1], hidden[-2::-1], strict=True):
        slope = (slope @ weight.T) * (1 - value**2)
    first_weight, _ = layers[0]
    return slope @ first_weight.T
