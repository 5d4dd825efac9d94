"""Networks that stand for a force: their values, and what their training shares.

Once trained, a network is a list of matrices and needs no torch. torch is imported
inside the functions that train.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.errors import ModelError
from phsi_opt.sweeps.local_workers import one_thread

# (weight (n_out, n_in), bias (n_out,)) of every layer
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


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
        spread = np.maximum(v.std(axis=0), LEAST_SIZE)
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
def torch_for(what: str, seed: int) -> Iterator[Any]:
    """Torch with one thread, and random numbers of its own, for what is trained.

    Raises:
        ModelError: torch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise ModelError(
            f"{what} needs torch: pip install 'phsi_opt[neural]'."
        ) from None
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield torch


def trainable(sizes: Sequence[int], activation: str) -> Any:
    """Layers of these sizes in torch, the first that of the variables.

    Weights and biases are drawn evenly within +-1 over the root of the inputs' number.
    """
    from torch import float64, nn

    parts: list[Any] = []
    for n_in, n_out in pairwise(sizes):
        parts.append(nn.Linear(n_in, n_out, dtype=float64))
        parts.append(nn.Tanh() if activation == "tanh" else nn.ReLU())
    return nn.Sequential(*parts[:-1])


def layers_of(net: Any) -> Layers:
    """What is trained in torch as it is now, in NumPy."""
    arrays = [tensor.detach().numpy().copy() for tensor in net.parameters()]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True))


def begin_at(net: Any, layers: Layers) -> None:
    """Continue a training in torch at layers in NumPy."""
    arrays = chain.from_iterable(layers)
    for tensor, array in zip(net.parameters(), arrays, strict=True):
        tensor.data = tensor.data.new_tensor(array)
