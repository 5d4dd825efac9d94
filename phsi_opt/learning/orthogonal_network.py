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

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.force_analysis.cross_validation import N_FOLDS, normal_equations
from phsi_opt.learning.force_samples import ForceSamples, Response
from phsi_opt.learning.network import (
    Layers,
    Network,
    layers_of,
    range_of,
    torch_for,
    trainable,
)
from phsi_opt.learning.ridge import RIDGE_WEIGHTS, SINGULAR, solutions
from phsi_opt.statistics import TINY, rms

# Bounds of the first weights of both layers: some units bend within the range, some are
# nearly straight; the output is in root mean squares of the target.
FIRST_WEIGHTS = (2.5, 0.1)
STOPS = (0.0, 0.2, 0.4, 0.7, 1.0)  # shares of the epochs at which training may stop


@dataclass(frozen=True)
class Training:
    """Of a hidden layer on samples of a force beside the physics.

    Attributes:
        samples: the missing force.
        response: of the residuals to a force.
        epochs: the most; how many are used is chosen on stretches of time left out.
        seed: of the first weights.
    """

    samples: ForceSamples
    response: Response
    epochs: int
    seed: int

    def result(self) -> tuple[Network, float]:
        """The network, and the share of left-out residuals that such networks explain.

        Epochs and ridge are chosen on stretches of time left out. Where nothing is
        explained the network is zero.

        Raises:
            ModelError: torch is not installed.
        """
        residual = self.response.residual
        errors = self._errors_left_out()
        total = errors.sum(axis=0)
        stop, ridge = np.unravel_index(int(np.argmin(total)), total.shape)
        network = self._trained(np.ones(len(self.samples.w), dtype=bool))[stop]
        features = _Features.of(network, self)
        weights = features.outputs(np.ones(len(residual), dtype=bool), residual)[ridge]
        left = 0.0
        for of_fold in errors:
            # By the choice made on the other folds, so that choosing flatters nothing.
            of_others = total - of_fold
            choice = np.unravel_index(int(np.argmin(of_others)), total.shape)
            left += of_fold[choice]
        explains = float(1 - left / max(float(residual @ residual), TINY))
        if explains <= 0:
            weights = 0 * weights
        layers = (*network.layers[:-1], (weights[None, :-1], weights[-1:]))
        whole = range_of(self.samples.v)
        return replace(network, layers=layers, seen=whole), explains

    def _errors_left_out(self) -> np.ndarray:
        """Squared residuals of each fold left out, (n_folds, n_stops, n_ridges)."""
        residual = self.response.residual
        errors = np.zeros((N_FOLDS, len(STOPS), len(RIDGE_WEIGHTS)))
        fold_of_interval, fold_of_value = self.response.folds()
        for fold in range(N_FOLDS):
            left_out = fold_of_value == fold
            networks = self._trained(fold_of_interval != fold)
            for stop, network in enumerate(networks):
                features = _Features.of(network, self)
                found = features.outputs(~left_out, residual)
                for ridge, weights in enumerate(found):
                    predicted = features.traces[left_out] @ weights
                    left = residual[left_out] - predicted
                    errors[fold, stop, ridge] = np.sum(left**2)
        return errors

    def _trained(self, used: np.ndarray) -> list[Network]:
        """The network at each of the `STOPS`, by the samples that are used."""
        samples = self.samples
        scaled = Network.scaled(samples.v, "tanh")
        seen = replace(scaled, seen=range_of(samples.v[used]))
        stops = [round(share * self.epochs) for share in STOPS]
        found: dict[int, Layers] = {}
        with torch_for("a learned force", self.seed) as torch:
            net = trainable((samples.v.shape[1], 16, 1), scaled.activation)
            torch.manual_seed(self.seed)
            for layer, bound in zip(net[::2], FIRST_WEIGHTS, strict=True):
                for tensor in layer.parameters():
                    torch.nn.init.uniform_(tensor, -bound, bound)
            loss = self._loss(net, scaled.standardized(samples.v), used)
            optimiser = torch.optim.Adam(net.parameters(), lr=0.02)
            for epoch in range(self.epochs + 1):
                if epoch in stops:
                    found[epoch] = layers_of(net)
                optimiser.zero_grad()
                loss().backward()
                optimiser.step()
        return [replace(seen, layers=found[epoch]) for epoch in stops]

    def _loss(self, net: Any, z: np.ndarray, used: np.ndarray) -> Callable[[], Any]:
        """Mean square of what a network at z leaves beside the physics, where used."""
        from torch import tensor

        samples = self.samples
        values = samples.without_physics(samples.w)[used]
        size = max(rms(values), LEAST_SIZE)
        physics = np.linalg.svd(samples.physics[used], full_matrices=False)[0]
        target = tensor(values / size)
        weight = tensor(np.median(samples.std) / samples.std[used])
        basis = tensor(physics)
        points = tensor(z[used])

        def loss() -> Any:
            force = weight * net(points)[:, 0]
            beyond = force - basis @ (basis.T @ force)
            return ((beyond - target) ** 2).mean()

        return loss


@dataclass(frozen=True, eq=False)
class _Features:
    """Hidden units along a record, with a one for the bias.

    Attributes:
        traces: (n_values, n_features), theirs in the residuals.
        free: (n_features, n_free), orthonormal directions of output weights whose force
            is orthogonal to the physics.
    """

    traces: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, network: Network, training: Training) -> "_Features":
        """Those of a network on the samples of its training."""
        units = network.features(training.samples.v)
        features = np.hstack([units, np.ones((len(units), 1))])
        scaled = features / training.samples.std[:, None]
        _, sizes, directions = np.linalg.svd(training.samples.physics.T @ scaled)
        n_bound = np.sum(sizes > SINGULAR * np.max(sizes, initial=0.0))
        traces = training.response.traces(features)
        return cls(traces, directions[n_bound:].T)

    def outputs(self, used: np.ndarray, residual: np.ndarray) -> list[np.ndarray]:
        """Output weights, bias last, within the free directions: one per ridge.

        Of the residual (n_values,) where it is used, (n_values,) of bool.
        """
        traces = self.traces[used]
        weights = self.free[:-1].T @ self.free[:-1]  # the bias is free
        ridge = weights * np.sum(traces**2) / traces.shape[1]
        normal = normal_equations(traces @ self.free, residual[used])
        found = solutions(normal, ridge)
        return [self.free @ coefficients for coefficients in found]
