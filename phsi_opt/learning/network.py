"""A network of ReLU layers as a force: its values, its output layer, and torch.

Once trained, a network is a list of matrices and needs no torch. torch is imported
inside the functions that train. The output layer is found by ridge regression, whose
weight is chosen by the prediction of folds of the data that were left out.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.errors import DataError, ModelError
from phsi_opt.force_analysis.cross_validation import N_FOLDS, normal_equations
from phsi_opt.sweeps.local_workers import one_thread

# (weight (n_out, n_in), bias (n_out,)) of every layer
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]

# Ridge weights that are tried, in units of the mean sum of squares of a ridged column.
RIDGE_WEIGHTS = np.logspace(-10, 0, num=11)
# Share of the largest singular value below which a direction is left alone.
SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Network:
    """A network of variables v: layers of (v - shift) / spread, each (n_variables,).

    It knows nothing beyond the data: outside the range of its training its variables
    are held at the edge.
    """

    shift: np.ndarray
    spread: np.ndarray
    seen: np.ndarray  # (2, n_variables), least and largest value in training
    layers: Layers = ()  # the hidden ones, and the output

    @classmethod
    def scaled(cls, v: np.ndarray) -> "Network":
        """Without layers, for values (n, n_variables) of its variables."""
        spread = np.maximum(v.std(axis=0), LEAST_SIZE)
        return cls(v.mean(axis=0), spread, range_of(v))

    def standardized(self, v: np.ndarray) -> np.ndarray:
        """What the first layer is given at values (n, n_variables)."""
        return (np.clip(v, *self.seen) - self.shift) / self.spread

    def features(self, v: np.ndarray) -> np.ndarray:
        """Output of the last hidden layer, (n, n_features), at v (n, n_variables)."""
        z = self.standardized(v)
        for weights, bias in self.layers[:-1]:
            z = np.maximum(z @ weights.T + bias, 0.0)
        return z

    def at(self, v: np.ndarray) -> np.ndarray:
        """The force, (n, n_outputs), at v (n, n_variables)."""
        weights, bias = self.layers[-1]
        return self.features(v) @ weights.T + bias

    def check_sizes(self, n_variables: int, n_outputs: int) -> None:
        """Refuse arrays from a file that are not of so many variables and outputs.

        Raises:
            DataError, TypeError, ValueError: a size does not fit.
        """
        sizes: dict[str, tuple[np.ndarray, tuple[int, ...]]] = {
            "shift": (self.shift, (n_variables,)),
            "spread": (self.spread, (n_variables,)),
            "seen": (self.seen, (2, n_variables)),
        }
        hidden = [len(weights) for weights, _ in self.layers[:-1]]
        ends = pairwise([n_variables, *hidden, n_outputs])
        for k, (layer, (n_in, n_out)) in enumerate(
            zip(self.layers, ends, strict=True), 1
        ):
            sizes[f"weights of layer {k}"] = (layer[0], (n_out, n_in))
            sizes[f"bias of layer {k}"] = (layer[1], (n_out,))
        for name, (array, size) in sizes.items():
            if array.shape != size:
                raise DataError(
                    f"the {name} of the network has the size {array.shape}; expected "
                    f"{size}."
                )


def range_of(v: np.ndarray) -> np.ndarray:
    """Least and largest of values (n, n_variables), (2, n_variables)."""
    return np.stack([v.min(axis=0), v.max(axis=0)])


# ---- the output layer by ridge regression --------------------------------------------


def cross_validated_ridge(
    columns: np.ndarray, d: np.ndarray, folds: np.ndarray, ridged: np.ndarray
) -> np.ndarray:
    """The z (n_columns,) that minimises ``|d + columns z|^2 + weight |z_ridged|^2``.

    The weight is the largest within a standard error of the one that predicts the folds
    (numbers below `N_FOLDS`) best when they are left out. Columns are (n_intervals,
    n_equations, n_columns), d (n_intervals, n_equations).
    """
    parts = []
    for fold in range(N_FOLDS):
        of_fold = columns[folds == fold].reshape(-1, columns.shape[2])
        parts.append((of_fold, -d[folds == fold].ravel()))
    normals = np.stack([normal_equations(*part) for part in parts])
    normal = normals.sum(axis=0)
    ridge = np.diag(ridged * np.mean(np.diag(normal)[ridged]))

    def solution(equations: np.ndarray, weight: float) -> np.ndarray:
        regularized = equations[:, :-1] + weight * ridge
        return np.linalg.lstsq(regularized, equations[:, -1], rcond=SINGULAR)[0]

    errors = np.zeros((len(RIDGE_WEIGHTS), N_FOLDS))
    for fold, (of_fold, target) in enumerate(parts):
        for place, weight in enumerate(RIDGE_WEIGHTS):
            z = solution(normal - normals[fold], weight)
            errors[place, fold] = np.sum((target - of_fold @ z) ** 2)
    more = errors - errors[np.argmin(errors.sum(axis=1))]
    standard_error = more.std(axis=1, ddof=1) / np.sqrt(N_FOLDS)
    is_good = more.mean(axis=1) <= standard_error
    return solution(normal, RIDGE_WEIGHTS[is_good][-1])


# ---- in torch ------------------------------------------------------------------------


@contextmanager
def torch_with(seed: int) -> Iterator[Any]:
    """Torch with one thread and its own random numbers, for a training.

    Raises:
        ModelError: torch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise ModelError(
            "a neural force needs torch: pip install 'phsi_opt[neural]'."
        ) from None
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield torch


def trainable(sizes: Sequence[int]) -> Any:
    """Layers of these sizes in torch, the first that of the variables.

    Weights and biases are drawn evenly within +-1 over the root of the inputs' number.
    """
    from torch import float64, nn

    parts: list[Any] = []
    for n_in, n_out in pairwise(sizes):
        parts += (nn.Linear(n_in, n_out, dtype=float64), nn.ReLU())
    return nn.Sequential(*parts[:-1])


def layers_of(net: Any) -> Layers:
    """What is trained in torch as it is now, in NumPy."""
    arrays = [tensor.detach().numpy().copy() for tensor in net.parameters()]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True))


def begin_at(net: Any, layers: Layers) -> None:
    """Continue a training in torch at layers in NumPy."""
    for tensor, array in zip(net.parameters(), chain(*layers), strict=True):
        tensor.data = tensor.data.new_tensor(array)
