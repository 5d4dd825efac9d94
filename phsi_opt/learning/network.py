"""Networks that stand for a force: their values, and what their training shares.

Once trained, a network is a list of matrices and needs no torch. torch is imported
inside the functions that train.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.optimization.torch_threads import one_thread

# (weight (n_out, n_in), bias (n_out,)) of every layer, in NumPy or in torch
Layers = tuple[tuple[Any, Any], ...]

LEAST_SCALE = 1e-12  # of a variable or target: keeps quotients finite where it is still


@dataclass(frozen=True, eq=False)
class Network:
    """A network of variables v: layers of (v - shift) / spread.

    It knows nothing beyond the data: outside the range of its training its variables
    are held at the edge.

    Attributes:
        shift: (n_variables,), subtracted from the variables.
        spread: (n_variables,), by which they are then divided.
        seen: (2, n_variables), least and largest value in training.
        activation: of the hidden layers, 'relu' or 'tanh'.
        layers: the hidden ones, and the output.
    """

    shift: np.ndarray
    spread: np.ndarray
    seen: np.ndarray
    activation: str
    layers: Layers = ()

    @classmethod
    def scaled(cls, v: np.ndarray, activation: str) -> "Network":
        """Without layers, for values (n, n_variables) of its variables."""
        spread = np.maximum(v.std(axis=0), LEAST_SCALE)
        return cls(v.mean(axis=0), spread, range_of(v), activation)

    def standardized(self, v: np.ndarray) -> np.ndarray:
        """What the first layer is given at values (n, n_variables)."""
        return (np.clip(v, *self.seen) - self.shift) / self.spread

    def features(self, v: np.ndarray) -> np.ndarray:
        """Output of the last hidden layer, (n, n_features), at v (n, n_variables)."""
        z = self.standardized(v)
        for weights, bias in self.layers[:-1]:
            z = z @ weights.T + bias
            z = np.tanh(z) if self.activation == "tanh" else np.maximum(z, 0.0)
        return z

    def at(self, v: np.ndarray) -> np.ndarray:
        """The force, (n, n_outputs), at v (n, n_variables)."""
        weights, bias = self.layers[-1]
        return self.features(v) @ weights.T + bias

    def is_of(self, n_variables: int, n_outputs: int) -> bool:
        """Whether all arrays have the sizes of so many variables and outputs."""
        scales = (self.shift, self.spread, *self.seen)
        sizes = [n_variables]
        fits = all(scale.shape == (n_variables,) for scale in scales)
        for weights, bias in self.layers:
            fits = fits and weights.shape == (len(bias), sizes[-1])
            sizes.append(len(bias))
        return fits and len(self.seen) == 2 and sizes[-1] == n_outputs


def range_of(v: np.ndarray) -> np.ndarray:
    """Least and largest of values (n, n_variables), (2, n_variables)."""
    return np.stack([v.min(axis=0), v.max(axis=0)])


def numbers(content: Any) -> np.ndarray:
    """The array (n,) or (n, k) that a file holds as lists."""
    return np.array(content, dtype=float)


# ---- in torch


@contextmanager
def torch_for(what: str) -> Iterator[Any]:
    """Torch with one thread.

    Args:
        what: is trained, for the message.

    Raises:
        ModelError: torch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise ModelError(
            f"{what} needs torch: pip install 'phsi_opt[neural]'."
        ) from None
    with one_thread():
        yield torch


def drawn_layers(
    sizes: Sequence[int], bounds: Sequence[float], generator: Any
) -> Layers:
    """Layers in torch, weights and biases drawn evenly.

    Args:
        sizes: of the variables and of every layer.
        bounds: of the numbers of each layer.
        generator: of torch.
    """
    import torch

    def drawn(bound: float, *shape: int) -> Any:
        share = torch.rand(shape, generator=generator, dtype=torch.float64)
        return (bound * (2 * share - 1)).requires_grad_()

    layers = []
    for (n_in, n_out), bound in zip(pairwise(sizes), bounds, strict=True):
        weights = drawn(bound, n_out, n_in)
        layers.append((weights, drawn(bound, n_out)))
    return tuple(layers)


def in_torch(layers: Layers) -> Layers:
    """The layers as tensors to be trained."""
    import torch

    tensors = []
    for layer in layers:
        weights, bias = (torch.tensor(array).requires_grad_() for array in layer)
        tensors.append((weights, bias))
    return tuple(tensors)


def in_numpy(layers: Layers) -> Layers:
    """The layers of tensors as they are now."""
    arrays = []
    for layer in layers:
        weights, bias = (tensor.detach().numpy().copy() for tensor in layer)
        arrays.append((weights, bias))
    return tuple(arrays)


def outputs(layers: Layers, z: Any, activation: str) -> Any:
    """Of layers in torch, at standardised variables (..., n_variables)."""
    for weights, bias in layers[:-1]:
        z = getattr(z @ weights.T + bias, activation)()
    weights, bias = layers[-1]
    return z @ weights.T + bias
