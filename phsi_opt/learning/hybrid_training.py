"""Training of a force network on what a model leaves of the data, by AdamW in torch.

torch is imported inside, so that a trained force can be used without it.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.learning.hybrid_network import NeuralForce, TrainedForce, known_names
from phsi_opt.model.model import Model
from phsi_opt.optimization.torch_threads import one_thread

# Least scale of a variable or a target: keeps quotients finite where it is constant.
LEAST_SCALE = 1e-12
LEFT_OUT = 0  # the fold that chooses the epoch
# Share of the left-out error by which a further training may raise it. Measured: noise
# in the tanks raises it by up to 0.03; strong weight decay takes the force of exact
# data, or one of two variables, away by 8 to 240 times.
LARGEST_RISE = 0.05

TorchLayers = list[tuple[Any, Any]]  # (weight (n_out, n_in), bias) of every layer


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """What a force must be at the stages of the steps.

    Attributes:
        stages: (n_intervals, n_stages, n_names), states, inputs and time at the stages
            of the integrator.
        weights: of the stages, (n_stages,); their sum is 1.
        target: (n_intervals, n_equations), the mean of the force over the stages.
        folds: (n_intervals,), number of the fold of every interval.
    """

    stages: np.ndarray
    weights: np.ndarray
    target: np.ndarray
    folds: np.ndarray


@dataclass(frozen=True)
class Schedule:
    """How long and how fast: epochs, the first learning rate, the seed of the order."""

    epochs: int
    rate: float
    seed: int


def untrained(
    model: Model,
    settings: NeuralForce,
    rows: tuple[int, ...],
    columns: tuple[int, ...],
    stages: np.ndarray,
) -> TrainedForce:
    """The force before training: no layers, the scale of its variables from the data.

    Args:
        model: whose states, inputs and time it may depend on.
        settings: of the force.
        rows: numbers of its equations.
        columns: numbers of its variables, as those of `TrainedForce`.
        stages: (n_intervals, n_stages, n_names), as those of `TrainingSet`.
    """
    variables = stages[:, :, columns]
    shift = variables.mean(axis=(0, 1))
    spread = np.maximum(variables.std(axis=(0, 1)), LEAST_SCALE)
    seen = _range(variables)
    return TrainedForce(
        equations=settings.equations,
        columns=columns,
        rows=rows,
        names=known_names(model),
        n_states=model.n_states,
        shift=shift,
        spread=spread,
        seen=seen,
        layers=(),
    )


def _range(variables: np.ndarray) -> np.ndarray:
    return np.stack([variables.min(axis=(0, 1)), variables.max(axis=(0, 1))])


def train(
    settings: NeuralForce,
    before: TrainedForce,
    data: TrainingSet,
    schedule: Schedule,
) -> TrainedForce:
    """Minimise the mean squared difference between the force's mean and the target.

    AdamW (Loshchilov and Hutter 2019) with a learning rate that falls along a cosine.
    The epoch is kept that predicts the fold `LEFT_OUT` best, which is left out. The
    start is kept where even that one predicts it worse by more than `LARGEST_RISE`.

    Args:
        settings: of the force.
        before: where to start; without layers (see `untrained`): at random weights.
        data: what it must be.
        schedule: epochs, learning rate and seed.

    Raises:
        ModelError: if torch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise ModelError(
            "a neural force needs torch: pip install 'phsi_opt[neural]'."
        ) from None

    variables = data.stages[:, :, before.columns]
    scale = np.maximum(np.sqrt(np.mean(data.target**2, axis=0)), LEAST_SCALE)
    with one_thread():
        generator = torch.Generator().manual_seed(schedule.seed)
        z = torch.tensor((variables - before.shift) / before.spread)
        y = torch.tensor(data.target / scale)
        if before.layers:
            layers = _scaled_layers(before, scale)
        else:
            sizes = [len(before.columns), *settings.hidden, len(before.rows)]
            layers = _random_layers(sizes, generator)
        batches = _Batches(
            z, torch.tensor(data.weights), y, torch.tensor(data.folds), generator
        )
        arrays = _descended(layers, batches, settings, schedule)
    weights, bias = arrays[-1]
    arrays[-1] = (weights * scale[:, None], bias * scale)
    return replace(before, seen=_range(variables), layers=tuple(arrays))


@dataclass(frozen=True, eq=False)
class _Batches:
    """Tensors of a training: variables, weights of the stages, targets and folds, and
    the generator of the order.
    """

    z: Any
    weights: Any
    y: Any
    folds: Any
    generator: Any


def _descended(
    layers: TorchLayers, data: _Batches, settings: NeuralForce, schedule: Schedule
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The layers of the epoch with the least error on the fold that is left out."""
    import torch

    def error(chosen: Any) -> Any:
        at_stages = _forward(layers, data.z[chosen])
        mean = (data.weights[:, None] * at_stages).sum(dim=1)
        return torch.mean((mean - data.y[chosen]) ** 2)

    used = torch.nonzero(data.folds != LEFT_OUT).ravel()
    left_out = torch.nonzero(data.folds == LEFT_OUT).ravel()
    parameters = [array for layer in layers for array in layer]
    optimiser = torch.optim.AdamW(
        parameters, lr=schedule.rate, weight_decay=settings.weight_decay
    )
    n_steps = schedule.epochs * -(-len(used) // settings.batch)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, n_steps)
    with torch.no_grad():
        limit = (1 + LARGEST_RISE) * float(error(left_out))
    least = np.inf
    start = _arrays(layers)
    best = start
    for _ in range(schedule.epochs):
        order = used[torch.randperm(len(used), generator=data.generator)]
        for chosen in order.split(settings.batch):
            optimiser.zero_grad()
            error(chosen).backward()
            optimiser.step()
            rates.step()
        with torch.no_grad():
            now = float(error(left_out))
        if now < least:
            least = now
            best = _arrays(layers)
    return best if least <= limit else start


def _arrays(layers: TorchLayers) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(w.detach().numpy().copy(), b.detach().numpy().copy()) for w, b in layers]


def _random_layers(sizes: list[int], generator: Any) -> TorchLayers:
    """Uniform within +-1/sqrt(number of inputs), weights and biases alike."""
    import torch

    def drawn(bound: float, *shape: int) -> Any:
        draw = torch.rand(shape, generator=generator, dtype=torch.float64)
        return (bound * (2 * draw - 1)).requires_grad_()

    layers = []
    for n_in, n_out in pairwise(sizes):
        bound = 1 / sqrt(n_in)
        weights = drawn(bound, n_out, n_in)
        bias = drawn(bound, n_out)
        layers.append((weights, bias))
    return layers


def _scaled_layers(trained: TrainedForce, scale: np.ndarray) -> TorchLayers:
    """The layers of a trained force, its output in units of ``scale``."""
    import torch

    weights, bias = trained.layers[-1]
    last = (weights / scale[:, None], bias / scale)
    layers = []
    for w, b in (*trained.layers[:-1], last):
        layers.append(
            (torch.tensor(w).requires_grad_(), torch.tensor(b).requires_grad_())
        )
    return layers


def _forward(layers: TorchLayers, z: Any) -> Any:
    for weights, bias in layers[:-1]:
        z = (z @ weights.T + bias).relu()
    weights, bias = layers[-1]
    return z @ weights.T + bias
