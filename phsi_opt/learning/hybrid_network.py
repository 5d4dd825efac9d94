"""A force by a network of ReLU layers: its settings, and its values once trained.

A trained force is a list of matrices and needs no torch. Its training is in
`network_training`.
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.errors import ModelError

# (weight (n_out, n_in), bias (n_out,)) of every layer
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True)
class NeuralForce:
    """A force that is a network of states (thesis Section 6.4).

    Args:
        equations: states in whose equations it acts.
        variables: states that it depends on; None: all.
        hidden: sizes of its ReLU layers (the thesis: three of 100).
        epochs: passes over the data in the first turn; later turns, which begin with a
            trained network, take a quarter of them.
        batch: intervals per step.
        learning_rate: of AdamW in the first turn.
        weight_decay: of AdamW, strong enough to keep noise out of the features.

    The epoch that is kept, and the weight of the squared output weights in the last
    layer, are those that predict trajectories best which were left out.

    Raises:
        ModelError: if a setting is not possible.
    """

    equations: tuple[str, ...]
    variables: tuple[str, ...] | None = None
    hidden: tuple[int, ...] = (100, 100, 100)
    epochs: int = 120
    batch: int = 256
    learning_rate: float = 2e-3
    weight_decay: float = 3.0

    def __post_init__(self) -> None:
        for name in ("equations", "variables"):
            given = getattr(self, name)
            if given is not None and (isinstance(given, str) or not given):
                raise ModelError(
                    f"{name}={given!r} of NeuralForce must be a tuple of states, "
                    "such as ('p',)."
                )
        possible = all(isinstance(size, int) and size >= 1 for size in self.hidden)
        if not self.hidden or not possible:
            raise ModelError(
                f"hidden={self.hidden!r} of NeuralForce must be sizes of layers, "
                "such as (100, 100, 100)."
            )
        for name in ("epochs", "batch", "learning_rate"):
            value = getattr(self, name)
            if not value > 0:
                raise ModelError(
                    f"{name}={value!r} of NeuralForce must be a number above zero."
                )


@dataclass(frozen=True, eq=False)
class TrainedForce:
    """A trained network: force(x) for states x.

    It knows nothing beyond the data: outside the range of its training its variables
    are held at the edge.

    Attributes:
        equations: states in whose equations it acts.
        columns: numbers of the states that it depends on.
        rows: numbers of the equations.
        shift: (n_variables,), subtracted from the variables.
        spread: (n_variables,), by which they are then divided.
        seen: (2, n_variables), least and largest value in training.
        layers: of the network.
    """

    equations: tuple[str, ...]
    columns: tuple[int, ...]
    rows: tuple[int, ...]
    shift: np.ndarray
    spread: np.ndarray
    seen: np.ndarray
    layers: Layers

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The force (n_samples, n_equations) at states x (n_samples, n_states)."""
        weights, bias = self.layers[-1]
        return self.features(x) @ weights.T + bias

    def features(self, x: np.ndarray) -> np.ndarray:
        """Output of the last hidden layer, (n_samples, n_features)."""
        variables = np.atleast_2d(x)[:, self.columns]
        inside = np.clip(variables, *self.seen)
        z = (inside - self.shift) / self.spread
        for weights, bias in self.layers[:-1]:
            z = np.maximum(z @ weights.T + bias, 0.0)
        return z
