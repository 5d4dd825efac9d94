"""A force by a network of ReLU layers beside a dictionary: settings, values, training.

The training is by AdamW, in torch, on the mean of the force over the stages of every
step. Once trained, a network is a list of matrices and needs no torch, which is
imported inside the functions that train. Its output layer is found by ridge regression,
whose weight is chosen by the prediction of folds of the data that were left out.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np

from phsi_opt.arguments import is_count, require, require_known, require_positive
from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.errors import DataError, ModelError
from phsi_opt.force_analysis.cross_validation import N_FOLDS, normal_equations
from phsi_opt.model.model import Model
from phsi_opt.sweeps.local_workers import one_thread

# (weight (n_out, n_in), bias (n_out,)) of every layer
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


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
class Network:
    """A network of variables v: layers of (v - shift) / spread, each (n_variables,).

    It knows nothing beyond the data: outside the range of its training its variables
    are held at the edge.
    """

    shift: np.ndarray
    spread: np.ndarray
    seen: np.ndarray  # (2, n_variables), least and largest value in training
    layers: Layers = ()  # the hidden ones, and the output

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


UNTRAINED = Network(np.zeros(0), np.zeros(0), np.zeros((2, 0)))


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
        names = (*model.states, *model.inputs, "t")
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
        for argument, values, names in (("u", u, inputs), ("t", t, ("t",))):
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


def train(
    settings: NeuralForce, before: TrainedForce, data: TrainingSet, seed: int
) -> TrainedForce:
    """Minimise the mean squared difference between the force's mean and the target.

    AdamW (Loshchilov and Hutter 2019) with a learning rate that falls along a cosine.
    The epoch is kept that predicts the first fold best, which is left out. The start is
    kept where even that one predicts it much worse. A force that has no layers begins
    at random ones; the seed is theirs, and that of the order of the batches.

    Raises:
        ModelError: if torch is not installed.
    """
    v = before.values_in(data.stages)
    visited = v.reshape(-1, v.shape[-1])
    seen = np.stack([visited.min(axis=0), visited.max(axis=0)])
    network = replace(before.network, seen=seen)
    if not network.layers:
        spread = np.maximum(visited.std(axis=0), LEAST_SIZE)
        network = Network(visited.mean(axis=0), spread, seen)
    scale = np.maximum(np.sqrt(np.mean(data.target**2, axis=0)), LEAST_SIZE)
    with torch_with(seed) as torch:
        net = _random_layers([v.shape[-1], *settings.hidden, len(scale)])
        if network.layers:
            *hidden, (weights, bias) = network.layers
            start = (*hidden, (weights / scale[:, None], bias / scale))
            for tensor, array in zip(net.parameters(), chain(*start), strict=True):
                tensor.data = tensor.data.new_tensor(array)
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
    best = _layers_of(net)
    # A further training may raise the left-out error by 5 %. Noise in the tanks raises
    # it by up to 3 %; strong weight decay takes the force of exact data, or one of two
    # variables, away by 8 to 240 times.
    least = 1.05 * error(left_out).item()
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
            best = _layers_of(net)
    return best


def _random_layers(sizes: Sequence[int]) -> Any:
    """Layers of these sizes in torch, the first that of the variables.

    Weights and biases are drawn evenly within +-1 over the root of the inputs' number.
    """
    from torch import float64, nn

    parts: list[Any] = []
    for n_in, n_out in pairwise(sizes):
        parts += (nn.Linear(n_in, n_out, dtype=float64), nn.ReLU())
    return nn.Sequential(*parts[:-1])


def _layers_of(net: Any) -> Layers:
    """What is trained in torch as it is now, in NumPy."""
    arrays = [tensor.detach().numpy().copy() for tensor in net.parameters()]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True))


# ---- the output layer by ridge regression --------------------------------------------


def cross_validated_ridge(
    columns: np.ndarray, d: np.ndarray, folds: np.ndarray, ridged: np.ndarray
) -> np.ndarray:
    """The z (n_columns,) that minimises ``|d + columns z|^2 + weight |z_ridged|^2``.

    The weight is the largest within a standard error of the one that predicts the folds
    (numbers below `N_FOLDS`) best when they are left out. Columns are (n_intervals,
    n_equations, n_columns), d (n_intervals, n_equations).
    """
    # In units of the mean sum of squares of a ridged column.
    weights = np.logspace(-10, 0, num=11)
    parts = []
    for fold in range(N_FOLDS):
        of_fold = columns[folds == fold].reshape(-1, columns.shape[2])
        parts.append((of_fold, -d[folds == fold].ravel()))
    normals = np.stack([normal_equations(*part) for part in parts])
    normal = normals.sum(axis=0)
    ridge = np.diag(ridged * np.mean(np.diag(normal)[ridged]))

    def solution(equations: np.ndarray, weight: float) -> np.ndarray:
        regularized = equations[:, :-1] + weight * ridge
        return np.linalg.lstsq(regularized, equations[:, -1], rcond=1e-12)[0]

    errors = np.zeros((len(weights), N_FOLDS))
    for fold, (of_fold, target) in enumerate(parts):
        for place, weight in enumerate(weights):
            z = solution(normal - normals[fold], weight)
            errors[place, fold] = np.sum((target - of_fold @ z) ** 2)
    more = errors - errors[np.argmin(errors.sum(axis=1))]
    standard_error = more.std(axis=1, ddof=1) / np.sqrt(N_FOLDS)
    is_good = more.mean(axis=1) <= standard_error
    return solution(normal, weights[is_good][-1])
