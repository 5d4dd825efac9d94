"""A network of one tanh layer for a missing force, orthogonal to the physics.

::

    N(v) = tanh(z weights' + bias) a + b,    z: the standardised variables v

The hidden layer is trained on the missing force, weighted by its uncertainty, by Adam
(Kingma and Ba 2015); only what the physics cannot produce counts. The output layer that
is trained beside it is thrown away. N is linear in the output layer, which is found by
ridge regression of the measurements' residuals on the traces of the hidden units
(`LinearizedRecord`: dynamics hard, the parameters of the physics moving along): the
missing force is a smoothed guess, pale where it is sharp, and its deviation from point
to point does not say how little a curve through many points may err. Only output layers
whose force is orthogonal to the physics on the record are allowed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.errors import DataError, ModelError
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.cross_validation import N_FOLDS, normal_equations
from phsi_opt.force_analysis.force_record import Points
from phsi_opt.learning.network import (
    RIDGE_WEIGHTS,
    SINGULAR,
    Network,
    layers_of,
    range_of,
    ridge_solutions,
    torch_for,
    trainable,
)
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.statistics import TINY, rms
from phsi_opt.transcription.parameter_vector import Theta

# Bounds of the first weights of both layers: some units bend within the range, some are
# nearly straight; the output is in root mean squares of the target.
FIRST_WEIGHTS = (2.5, 0.1)
STOPS = (0.0, 0.2, 0.4, 0.7, 1.0)  # shares of the epochs at which training may stop
# Singular value, as a share of the largest, below which a direction is one that others
# explain.
RANK_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class ForceSamples:
    """The missing force (n,) of one equation in the middle of every interval."""

    v: np.ndarray  # (n, n_variables), the variables it may depend on
    w: np.ndarray
    std: np.ndarray
    physics: np.ndarray  # (n, n_columns), orthonormal: forces of free parameters / std

    @classmethod
    def of(cls, record: Record, equation: str, on: Sequence[str]) -> "ForceSamples":
        """The samples of the force missing in an equation, on variables.

        Raises:
            ModelError: the equation is unknown, or one of kinematics.
            DataError: there are too few intervals.
        """
        estimate = record.estimate
        grid = estimate.grid
        model = record.model.with_values(estimate.rounded)
        row = model.index(equation, "equation of a learned force")
        if row not in estimate.rows:
            raise ModelError(
                f"d{equation}/dt is a kinematic equation, in which no force acts; "
                "learn the force in the equation of a momentum."
            )
        if grid.n_intervals < 50:  # every stretch of time left out holds a few
            raise DataError(
                f"{grid.n_intervals} intervals are too few to learn a force; "
                "at least 50 are needed."
            )
        points = Points.middles(record)
        column = estimate.rows.index(row)
        std = np.maximum(estimate.posterior.deviation[:, column], TINY)
        unknown = Theta.of(model, record.trajectories)
        slopes = np.zeros((grid.n_intervals, len(unknown)))
        places = unknown.table[:, grid.runs].T
        np.put_along_axis(slopes, places, points.slopes(model)[:, row], axis=1)
        basis, sizes, _ = np.linalg.svd(slopes / std[:, None], full_matrices=False)
        physics = basis[:, sizes > RANK_TOLERANCE * np.max(sizes, initial=0.0)]
        v = points.values(model.function(*on))
        return cls(v, estimate.w[:, column], std, physics)

    def without_physics(self, force: np.ndarray) -> np.ndarray:
        """A force (n,) over ``std``, less what the physics explains of it, (n,)."""
        scaled = force / self.std
        return scaled - self.physics @ (self.physics.T @ scaled)


@dataclass(frozen=True, eq=False)
class Response:
    """The linearised response of the residuals (n_values,) to a force."""

    linearized: LinearizedRecord  # at the states of the missing force
    row: int  # of the equation
    residual: np.ndarray  # in units of the noise

    @classmethod
    def of(cls, record: Record, row: int) -> "Response":
        """The response of a record."""
        linearized = LinearizedRecord.of(record)
        return cls(linearized, row, linearized.residual)

    def folds(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of stretches of time, (n_intervals,) and (n_values,)."""
        grid = self.linearized.grid
        # With two, a fold sees the beginning and the end of what decays.
        n_stretches = 2 * N_FOLDS
        of_node = np.arange(grid.n_nodes) * n_stretches // grid.n_nodes % N_FOLDS
        return of_node[grid.begin], of_node[np.nonzero(grid.measured)[0]]

    def traces(self, forces: np.ndarray) -> np.ndarray:
        """What forces (n_intervals, n_forces) change of the explained values.

        In units of the noise, (n_values, n_forces).
        """
        grid = self.linearized.grid
        n_states = self.linearized.model.n_states
        n_forces = forces.shape[1]
        of_defects = np.zeros((grid.n_intervals, n_states, n_forces))
        of_defects[:, self.row] = -forces
        of_outputs = np.zeros((grid.n_nodes * n_states, n_forces))
        return self.linearized.traces(of_defects.reshape(-1, n_forces), of_outputs)


def orthogonal_network(
    samples: ForceSamples, response: Response, epochs: int, seed: int
) -> tuple[Network, float]:
    """The network, and the share of left-out residuals that such networks explain.

    Epochs (at most those given) and ridge are chosen on stretches of time left out.
    Where nothing is explained the network is zero. The seed is that of the first
    weights.

    Raises:
        ModelError: torch is not installed.
    """
    residual = response.residual
    errors = np.zeros((N_FOLDS, len(STOPS), len(RIDGE_WEIGHTS)))
    fold_of_interval, fold_of_value = response.folds()
    for fold in range(N_FOLDS):
        left_out = fold_of_value == fold
        used = fold_of_interval != fold
        for number, network in enumerate(_trained(samples, used, epochs, seed)):
            traces, outputs = _outputs(network, samples, response, ~left_out)
            for place, weights in enumerate(outputs):
                unexplained = residual[left_out] - traces[left_out] @ weights
                errors[fold, number, place] = np.sum(unexplained**2)
    total = errors.sum(axis=0)
    stop, ridge = np.unravel_index(int(np.argmin(total)), total.shape)
    network = _trained(samples, np.full(len(samples.w), True), epochs, seed)[stop]
    _, outputs = _outputs(network, samples, response, np.full(len(residual), True))
    weights = outputs[ridge]
    error = 0.0
    for of_fold in errors:
        # By the choice made on the other folds, so that choosing flatters nothing.
        of_others = total - of_fold
        error += of_fold[np.unravel_index(int(np.argmin(of_others)), total.shape)]
    explains = float(1 - error / max(float(residual @ residual), TINY))
    if explains <= 0:
        weights = 0 * weights
    layers = (*network.layers[:-1], (weights[None, :-1], weights[-1:]))
    return replace(network, layers=layers, seen=range_of(samples.v)), explains


def _trained(
    samples: ForceSamples, used: np.ndarray, epochs: int, seed: int
) -> list[Network]:
    """The network at each of the `STOPS`, by the samples that are used."""
    scaled = Network.scaled(samples.v, "tanh")
    seen = replace(scaled, seen=range_of(samples.v[used]))
    stops = [round(share * epochs) for share in STOPS]
    found = {}
    with torch_for("a learned force", seed) as torch:
        net = trainable((samples.v.shape[1], 16, 1), scaled.activation)
        torch.manual_seed(seed)
        for layer, bound in zip(net[::2], FIRST_WEIGHTS, strict=True):
            for tensor in layer.parameters():
                torch.nn.init.uniform_(tensor, -bound, bound)
        loss = _loss(net, samples, scaled.standardized(samples.v), used)
        optimiser = torch.optim.Adam(net.parameters(), lr=0.02)
        for epoch in range(epochs + 1):
            if epoch in stops:
                found[epoch] = layers_of(net)
            optimiser.zero_grad()
            loss().backward()
            optimiser.step()
    return [replace(seen, layers=found[epoch]) for epoch in stops]


def _loss(
    net: Any, samples: ForceSamples, z: np.ndarray, used: np.ndarray
) -> Callable[[], Any]:
    """Mean squared error of a network at z, beside the physics, where used."""
    from torch import tensor

    values = samples.without_physics(samples.w)[used]
    physics = np.linalg.svd(samples.physics[used], full_matrices=False)[0]
    target = tensor(values / max(rms(values), LEAST_SIZE))
    weight = tensor(np.median(samples.std) / samples.std[used])
    basis = tensor(physics)
    points = tensor(z[used])

    def loss() -> Any:
        force = weight * net(points)[:, 0]
        beyond = force - basis @ (basis.T @ force)
        return ((beyond - target) ** 2).mean()

    return loss


def _outputs(
    network: Network, samples: ForceSamples, response: Response, used: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Traces of hidden units (n_values, n_features), and output weights by ridge."""
    # The bias is the last of both. Weights are within the directions whose force is
    # orthogonal to the physics, found where values are ``used``, (n_values,) of bool.
    units = network.features(samples.v)
    features = np.hstack([units, np.ones((len(units), 1))])
    scaled = features / samples.std[:, None]
    _, sizes, directions = np.linalg.svd(samples.physics.T @ scaled)
    n_bound = np.sum(sizes > SINGULAR * np.max(sizes, initial=0.0))
    free = directions[n_bound:].T
    traces = response.traces(features)
    of_used = traces[used]
    weights = free[:-1].T @ free[:-1]  # the bias is free
    ridge = weights * np.sum(of_used**2) / of_used.shape[1]
    normal = normal_equations(of_used @ free, response.residual[used])
    return traces, [free @ found for found in ridge_solutions(normal, ridge)]
