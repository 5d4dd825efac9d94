"""The hidden layer of a force's network, trained by Adam in torch.

It is trained on the missing force, weighted by its uncertainty; only what the physics
cannot produce counts. The output layer that is trained beside it is thrown away
(`orthogonal_network` finds a better one). Adam is that of Kingma and Ba (2015).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.learning.force_samples import ForceSamples
from phsi_opt.optimization.torch_threads import one_thread

N_HIDDEN = 16
# Bound of the first hidden weights: some units bend within the range, some are nearly
# straight.
FIRST_WEIGHTS = 2.5
FIRST_OUTPUT_WEIGHTS = 0.1  # bound, in root mean squares of the target
LEARNING_RATE = 0.02  # of Adam
STOPS = (0.0, 0.2, 0.4, 0.7, 1.0)  # shares of the epochs at which training may stop
SMALLEST_TARGET = 1e-12  # root mean square, in standard deviations of the force


@dataclass(frozen=True, eq=False)
class HiddenLayer:
    """Units tanh(weights z + bias).

    Attributes:
        weights: (n_hidden, n_variables).
        bias: (n_hidden,).
    """

    weights: np.ndarray
    bias: np.ndarray

    def features(self, z: np.ndarray) -> np.ndarray:
        """The units at z (n, n_variables), and a one: (n, n_hidden + 1)."""
        units = np.tanh(z @ self.weights.T + self.bias)
        return np.hstack([units, np.ones((len(z), 1))])


@dataclass(frozen=True)
class Training:
    """How long a layer is trained at most, and the ``seed`` of its first weights."""

    epochs: int
    seed: int

    @property
    def stops(self) -> list[int]:
        """The epochs before which training may stop."""
        return [round(share * self.epochs) for share in STOPS]


@dataclass(frozen=True, eq=False)
class _Network:
    """A network in torch: tensors of both layers."""

    weights: Any
    bias: Any
    output_weights: Any
    output_bias: Any

    @classmethod
    def drawn(cls, n_variables: int, seed: int) -> "_Network":
        """With weights drawn evenly within their bounds."""
        import torch

        generator = torch.Generator().manual_seed(seed)

        def even(bound: float, *shape: int) -> Any:
            share = torch.rand(shape, generator=generator, dtype=torch.float64)
            return (bound * (2 * share - 1)).requires_grad_()

        return cls(
            weights=even(FIRST_WEIGHTS, N_HIDDEN, n_variables),
            bias=even(FIRST_WEIGHTS, N_HIDDEN),
            output_weights=even(FIRST_OUTPUT_WEIGHTS, N_HIDDEN),
            output_bias=even(FIRST_OUTPUT_WEIGHTS),
        )

    @property
    def parameters(self) -> list[Any]:
        """What is trained."""
        return [self.weights, self.bias, self.output_weights, self.output_bias]

    def at(self, points: Any) -> Any:
        """The force at points (n, n_variables)."""
        import torch

        units = torch.tanh(points @ self.weights.T + self.bias)
        return units @ self.output_weights + self.output_bias

    def hidden(self) -> HiddenLayer:
        """The hidden layer as it is now."""
        weights = self.weights.detach().numpy().copy()
        return HiddenLayer(weights, self.bias.detach().numpy().copy())


@dataclass(frozen=True, eq=False)
class _Target:
    """What the network is trained to.

    Attributes:
        points: (n, n_variables).
        weight: (n,), of the force at each.
        basis: (n, n_columns), orthonormal basis of what the physics produces.
        values: (n,), what the physics leaves, with a root mean square of one.
    """

    points: Any
    weight: Any
    basis: Any
    values: Any

    @classmethod
    def of(cls, z: np.ndarray, samples: ForceSamples, used: np.ndarray) -> "_Target":
        """From the samples that are used, (n,) of bool."""
        import torch

        scaled = (samples.beyond_physics / samples.std)[used]
        size = max(float(np.sqrt(np.mean(scaled**2))), SMALLEST_TARGET)
        weight = np.median(samples.std) / samples.std[used]
        basis = np.linalg.svd(samples.physics[used], full_matrices=False)[0]
        return cls(
            points=torch.tensor(z[used]),
            weight=torch.tensor(weight),
            basis=torch.tensor(basis),
            values=torch.tensor(scaled / size),
        )

    def loss(self, network: _Network) -> Any:
        """Mean square of what is left beside the physics."""
        import torch

        force = self.weight * network.at(self.points)
        beyond = force - self.basis @ (self.basis.T @ force)
        return torch.mean((beyond - self.values) ** 2)


def trained_layers(
    z: np.ndarray, samples: ForceSamples, used: np.ndarray, training: Training
) -> list[HiddenLayer]:
    """The hidden layer at each of the `STOPS` of its training.

    Args:
        z: (n, n_variables), the standardised variables.
        samples: the missing force there.
        used: (n,) of bool, which of them.
        training: how long, and from which weights.

    Raises:
        ModelError: torch is not installed.
    """
    torch = _torch()
    with one_thread():
        network = _Network.drawn(z.shape[1], training.seed)
        target = _Target.of(z, samples, used)
        optimiser = torch.optim.Adam(network.parameters, lr=LEARNING_RATE)
        layers = {}
        for epoch in range(training.epochs + 1):
            if epoch in training.stops:
                layers[epoch] = network.hidden()
            optimiser.zero_grad()
            target.loss(network).backward()
            optimiser.step()
    return [layers[epoch] for epoch in training.stops]


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise ModelError(
            "a learned force needs torch: pip install 'phsi_opt[neural]'."
        ) from None
    return torch
