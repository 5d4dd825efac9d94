"""Training of a force network on what a model leaves of the data, by AdamW in torch."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.learning.hybrid_network import NeuralForce, TrainedForce
from phsi_opt.learning.network import (
    Layers,
    Network,
    begin_at,
    layers_of,
    range_of,
    torch_for,
    trainable,
)

# Share of the left-out error by which a further training may raise it. Measured: noise
# in the tanks raises it by up to 0.03; strong weight decay takes the force of exact
# data, or one of two variables, away by 8 to 240 times.
LARGEST_RISE = 0.05


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

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Of values (n_intervals, n_stages, ...) over the stages."""
        return np.tensordot(values, self.weights, axes=(1, 0))


def train(
    settings: NeuralForce, before: TrainedForce, data: TrainingSet, seed: int
) -> TrainedForce:
    """Minimise the mean squared difference between the force's mean and the target.

    AdamW (Loshchilov and Hutter 2019) with a learning rate that falls along a cosine.
    The epoch is kept that predicts the first fold best, which is left out. The start is
    kept where even that one predicts it worse by more than `LARGEST_RISE`. A force that
    has no layers begins at random ones; the seed is theirs, and that of the order of
    the batches.

    Raises:
        ModelError: if torch is not installed.
    """
    v = before.values_in(data.stages)
    visited = v.reshape(-1, v.shape[-1])
    network = before.network
    if not network.layers:
        network = Network.scaled(visited, network.activation)
    network = replace(network, seen=range_of(visited))
    scale = np.maximum(np.sqrt(np.mean(data.target**2, axis=0)), LEAST_SIZE)
    with torch_for("a neural force", seed) as torch:
        sizes = [v.shape[-1], *settings.hidden, len(scale)]
        net = trainable(sizes, network.activation)
        if network.layers:
            *hidden, (weights, bias) = network.layers
            begin_at(net, (*hidden, (weights / scale[:, None], bias / scale)))
            torch.manual_seed(seed)  # what was drawn is not used
        z = torch.tensor(network.standardized(v))
        of_stages = torch.tensor(data.weights[:, None])
        y = torch.tensor(data.target / scale)

        def error(chosen: Any) -> Any:
            """Mean squared difference in the intervals that are chosen."""
            mean = (of_stages * net(z[chosen])).sum(dim=1)
            return ((mean - y[chosen]) ** 2).mean()

        *hidden, (weights, bias) = _best(net, error, data.folds, settings)
    output = (weights * scale[:, None], bias * scale)
    return replace(before, network=replace(network, layers=(*hidden, output)))


def _best(
    net: Any,
    error: Callable[[Any], Any],
    folds: np.ndarray,
    settings: NeuralForce,
) -> Layers:
    """The layers of the epoch with the least error on the fold 0, which is left out."""
    import torch

    used = torch.tensor(np.flatnonzero(folds))
    left_out = torch.tensor(np.flatnonzero(folds == 0))
    rate = settings.learning_rate
    decay = settings.weight_decay
    optimiser = torch.optim.AdamW(net.parameters(), rate, weight_decay=decay)
    n_steps = settings.epochs * -(-len(used) // settings.batch)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, n_steps)
    start = layers_of(net)
    limit = (1 + LARGEST_RISE) * error(left_out).item()
    best = start
    least = np.inf
    for _ in range(settings.epochs):
        order = used[torch.randperm(len(used))]
        for chosen in order.split(settings.batch):
            optimiser.zero_grad()
            error(chosen).backward()
            optimiser.step()
            rates.step()
        now = error(left_out).item()
        if now < least:
            least = now
            best = layers_of(net)
    return best if least <= limit else start
