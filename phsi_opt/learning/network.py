"""A force by a network of ReLU layers: settings, values and training.

torch is needed for the training alone; a trained force is a list of matrices.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.optimization.torch_threads import one_thread

N_FOLDS = 5
RIDGES = 10.0 ** np.arange(
    -9, 1
)  # weights that are tried, relative to the size of a feature
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True)
class NeuralForce:
    """A force in ``equations`` that depends on the states ``variables`` through a
    network (None: on all states).

    ``hidden`` are the sizes of its ReLU layers (thesis Section 6.4: three of 100),
    ``epochs`` those of the first turn; later turns, which begin with a trained network,
    take a quarter of them. ``weight_decay`` is that of AdamW, strong enough to keep
    noise out of the features. The epoch that is kept, and the weight of the squared
    output weights in the last layer, are those that predict trajectories best which
    were left out.
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
                    f"{name}={given!r} of NeuralForce must be a tuple of states, such as ('p',)."
                )
        if not self.hidden or any(not isinstance(n, int) or n < 1 for n in self.hidden):
            raise ModelError(
                f"hidden={self.hidden!r} of NeuralForce must be sizes of layers, such as (100, 100, 100)."
            )
        for name in ("epochs", "batch", "learning_rate"):
            if not getattr(self, name) > 0:
                raise ModelError(
                    f"{name}={getattr(self, name)!r} of NeuralForce must be a number above zero."
                )


@dataclass(frozen=True, eq=False)
class TrainedForce:
    """A trained network: force(x) for states x (n_samples, n_states) is (n_samples,
    n_equations).

    It knows nothing beyond what it has seen: there its variables are held at the edge
    of the range ``seen`` in training.
    """

    equations: tuple[str, ...]
    columns: tuple[int, ...]
    rows: tuple[int, ...]
    shift: np.ndarray
    spread: np.ndarray
    seen: np.ndarray  # (2, n_variables): least and largest value
    layers: Layers

    def __call__(self, x: np.ndarray) -> np.ndarray:
        weights, bias = self.layers[-1]
        return self.features(x) @ weights.T + bias

    def features(self, x: np.ndarray) -> np.ndarray:
        """Output of the last hidden layer, (n_samples, n_features)."""
        z = (
            np.clip(np.atleast_2d(x)[:, self.columns], *self.seen) - self.shift
        ) / self.spread
        for weights, bias in self.layers[:-1]:
            z = np.maximum(z @ weights.T + bias, 0.0)
        return z


def train(
    settings: NeuralForce,
    rows: tuple[int, ...],
    columns: tuple[int, ...],
    before: TrainedForce | None,
    stages: np.ndarray,
    target: np.ndarray,
    folds: np.ndarray,
    epochs: int,
    rate: float,
    seed: int,
) -> TrainedForce:
    """AdamW on the mean squared difference between the force's average over the two
    stages and the target.

    ``stages`` (n_intervals, 2, n_states), ``target`` (n_intervals, n_equations). Starts
    at the network ``before``; the epoch that predicts fold 0 of ``folds``
    (n_intervals,) best, which is left out, is kept.
    """
    try:
        import torch
    except ImportError:
        raise ModelError(
            "a neural force needs torch: pip install 'phsi_opt[neural]'."
        ) from None

    with one_thread():
        made = torch.Generator().manual_seed(seed)
        points = stages[:, :, columns]
        shift, spread = (
            points.mean(axis=(0, 1)),
            np.maximum(points.std(axis=(0, 1)), 1e-12),
        )
        if before is not None:
            shift, spread = before.shift, before.spread
        size = np.maximum(np.sqrt(np.mean(target**2, axis=0)), 1e-12)
        z, y = torch.tensor((points - shift) / spread), torch.tensor(target / size)
        sizes = [len(columns), *settings.hidden, len(rows)]
        layers = (
            _first_layers(sizes, made)
            if before is None
            else _torch_layers(before, size)
        )
        parameters = [p for layer in layers for p in layer]
        optimiser = torch.optim.AdamW(
            parameters, lr=rate, weight_decay=settings.weight_decay
        )
        fold = torch.tensor(folds)
        used, left_out = (
            torch.nonzero(fold != 0).ravel(),
            torch.nonzero(fold == 0).ravel(),
        )
        steps = epochs * -(-len(used) // settings.batch)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        best, arrays = np.inf, _arrays(layers)
        for _ in range(epochs):
            for chosen in used[torch.randperm(len(used), generator=made)].split(
                settings.batch
            ):
                optimiser.zero_grad()
                loss = torch.mean(
                    (_forward(layers, z[chosen]).mean(dim=1) - y[chosen]) ** 2
                )
                loss.backward()
                optimiser.step()
                schedule.step()
            with torch.no_grad():
                error = float(
                    torch.mean(
                        (_forward(layers, z[left_out]).mean(dim=1) - y[left_out]) ** 2
                    )
                )
            if error < best:
                best, arrays = error, _arrays(layers)
    weights, bias = arrays[-1]
    arrays[-1] = (weights * size[:, None], bias * size)
    seen = np.stack([points.min(axis=(0, 1)), points.max(axis=(0, 1))])
    return TrainedForce(
        settings.equations, columns, rows, shift, spread, seen, tuple(arrays)
    )


def cross_validated(
    whole: np.ndarray, d: np.ndarray, folds: np.ndarray, ridged: np.ndarray
) -> np.ndarray:
    """argmin |d + whole z|^2 + weight |z_ridged|^2, the weight chosen by its prediction
    of left-out folds.
    """
    parts = []
    for fold in range(N_FOLDS):
        A, b = (
            whole[folds == fold].reshape(-1, whole.shape[2]),
            d[folds == fold].ravel(),
        )
        parts.append((A.T @ A, A.T @ b, b @ b))
    normal, right = sum(p[0] for p in parts), sum(p[1] for p in parts)
    size = float(np.mean(np.diag(normal)[ridged]))

    def solved(weight: float, N: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(N + np.diag(weight * size * ridged), -r, rcond=1e-12)[0]

    def left_out(weight: float) -> np.ndarray:
        errors = []
        for N, r, square in parts:
            z = solved(weight, normal - N, right - r)
            errors.append(float(z @ N @ z + 2 * z @ r + square))
        return np.array(errors)

    # The smoothest force whose prediction is not significantly worse: the largest
    # weight within a standard error.
    errors = {weight: left_out(weight) for weight in RIDGES}
    best = min(RIDGES, key=lambda weight: float(errors[weight].sum()))
    more = {
        weight: errors[weight] - errors[best] for weight in RIDGES if weight >= best
    }
    fine = [
        weight
        for weight, d in more.items()
        if d.mean() <= d.std(ddof=1) / np.sqrt(N_FOLDS)
    ]
    return solved(max(fine), normal, right)


def _arrays(layers: list[tuple[Any, Any]]) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(w.detach().numpy().copy(), b.detach().numpy().copy()) for w, b in layers]


def _first_layers(sizes: list[int], made: Any) -> list[tuple[Any, Any]]:
    import torch

    layers = []
    for n_in, n_out in pairwise(sizes):
        bound = 1 / sqrt(n_in)
        w, b = (
            bound * (2 * torch.rand(s, generator=made, dtype=torch.float64) - 1)
            for s in ((n_out, n_in), (n_out,))
        )
        layers.append((w.requires_grad_(), b.requires_grad_()))
    return layers


def _torch_layers(trained: TrainedForce, size: np.ndarray) -> list[tuple[Any, Any]]:
    import torch

    arrays = [
        *trained.layers[:-1],
        (trained.layers[-1][0] / size[:, None], trained.layers[-1][1] / size),
    ]
    return [
        (torch.tensor(w).requires_grad_(), torch.tensor(b).requires_grad_())
        for w, b in arrays
    ]


def _forward(layers: list[tuple[Any, Any]], z: Any) -> Any:
    for w, b in layers[:-1]:
        z = (z @ w.T + b).relu()
    w, b = layers[-1]
    return z @ w.T + b
