"""A force by a network of ReLU layers beside a dictionary: settings, values, training.

The training is by AdamW, in torch, on the mean of the force over the stages of every
step.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phsi_opt.arguments import is_count, require, require_known, require_positive
from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.errors import DataError
from phsi_opt.learning.network import (
    Layers,
    Network,
    begin_at,
    layers_of,
    range_of,
    torch_with,
    trainable,
)
from phsi_opt.model.model import Model

TIME_NAME = "t"  # of the time among the variables
UNTRAINED = Network(np.zeros(0), np.zeros(0), np.zeros((2, 0)))
# Share of the left-out error by which a further training may raise it. Noise in the
# tanks raises it by up to 0.03; strong weight decay takes the force of exact data, or
# one of two variables, away by 8 to 240 times.
LARGEST_RISE = 0.05


@dataclass(frozen=True)
class NeuralForce:
    """A force that is a network of states, inputs and time (thesis Section 6.4).

    Args:
        equations: states in whose equations it acts.
        variables: states, inputs or "t" that it depends on; None: all states.
        hidden: sizes of its ReLU layers (the thesis: three of 100).
        epochs: passes over the data in the first turn; later turns, which begin with a
            trained network, take a quarter of them.
        batch: intervals per step.
        learning_rate: of AdamW in the first turn.
        weight_decay: of AdamW, strong enough to keep noise out of the features.

    A force of the time wants five trajectories or more: with fewer, what is left out to
    judge it is a stretch of time.

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
        expected = {"equations": "states", "variables": "states, inputs or 't'"}
        for name, words in expected.items():
            given = getattr(self, name)
            fine = given is None or (bool(given) and not isinstance(given, str))
            require(fine, name, given, f"a tuple of {words}, such as ('p',)")
        fine = bool(self.hidden) and all(map(is_count, self.hidden))
        require(fine, "hidden", self.hidden, "sizes of layers, such as (100, 100, 100)")
        for name in ("epochs", "batch", "learning_rate"):
            require_positive(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class TrainedForce:
    """A trained network: force(x, t, u), with states (n_samples, n_states)."""

    equations: tuple[str, ...]  # states in whose equations it acts
    variables: tuple[str, ...]  # states, inputs and "t" that it depends on
    names: tuple[str, ...]  # all states, inputs and "t" of the model
    n_states: int
    network: Network

    @classmethod
    def of(
        cls,
        model: Model,
        equations: tuple[str, ...],
        variables: tuple[str, ...] | None,
        network: Network = UNTRAINED,
    ) -> "TrainedForce":
        """The force in a model; variables None: all states.

        Raises:
            ModelError: a name is not one of the model.
        """
        for name in equations:
            model.index(name, "equation of NeuralForce")
        names = (*model.states, *model.inputs, TIME_NAME)
        on = tuple(variables or model.states)
        for name in on:
            said = f"variable of NeuralForce {name!r} is not a state, an input or the"
            require_known(name, names, f"{said} time 't' of the model")
        return cls(tuple(equations), on, names, model.n_states, network)

    @property
    def rows(self) -> list[int]:
        """Numbers of the equations."""
        return list(map(self.names.index, self.equations))

    def __call__(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """The force, (n_samples, n_equations).

        Args:
            x: states (n_samples, n_states).
            t: times (n_samples,), if it depends on the time.
            u: inputs (n_samples, n_inputs), if it depends on one.

        Raises:
            DataError: if t or u is needed and not given, or has another shape.
        """
        columns = [np.atleast_2d(x)]
        inputs = self.names[self.n_states : -1]
        for argument, values, names in (("u", u, inputs), ("t", t, (TIME_NAME,))):
            shape = (len(columns[0]), len(names))
            if values is None:
                values = np.zeros(shape)  # of what nothing depends on
                for name in filter(names.__contains__, self.variables):
                    raise DataError(
                        f"the force depends on {name!r}; give {argument} together "
                        "with x."
                    )
            if np.size(values) != shape[0] * shape[1]:
                raise DataError(
                    f"{argument} has shape {np.shape(values)}; expected {shape}, a row "
                    "per row of x."
                )
            columns.append(np.reshape(np.asarray(values, dtype=float), shape))
        return self.at(np.hstack(columns))

    def at(self, rows: np.ndarray) -> np.ndarray:
        """The force, (n_samples, n_equations), at rows (n_samples, n_names)."""
        return self.network.at(self.values_in(rows))

    def values_in(self, rows: np.ndarray) -> np.ndarray:
        """Those of the variables in rows (..., n_names), (..., n_variables)."""
        return rows[..., list(map(self.names.index, self.variables))]


# ---- training ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """What a force must be, (n_intervals, ...), at the stages of the steps."""

    stages: np.ndarray  # (n_intervals, n_stages, n_names) states, inputs and time
    weights: np.ndarray  # of the stages, (n_stages,); their sum is 1
    target: np.ndarray  # mean over the stages, (n_intervals, n_equations)
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
        network = Network.scaled(visited)
    network = replace(network, seen=range_of(visited))
    scale = np.maximum(np.sqrt(np.mean(data.target**2, axis=0)), LEAST_SIZE)
    with torch_with(seed) as torch:
        net = trainable([v.shape[-1], *settings.hidden, len(scale)])
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
    net: Any, error: Callable[[Any], Any], folds: np.ndarray, settings: NeuralForce
) -> Layers:
    """The layers of the epoch with the least error on the fold 0, which is left out."""
    import torch

    used = torch.tensor(np.flatnonzero(folds))
    left_out = torch.tensor(np.flatnonzero(folds == 0))
    optimiser = torch.optim.AdamW(
        net.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
    )
    n_steps = settings.epochs * -(-len(used) // settings.batch)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, n_steps)
    best = layers_of(net)
    least = (1 + LARGEST_RISE) * error(left_out).item()
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
    return best
