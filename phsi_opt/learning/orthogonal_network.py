"""A network of one tanh layer for a missing force, orthogonal to the physics.

::

    N(v) = tanh(z weights' + bias) a + b,    z: the standardised variables v

The hidden layer is trained on the missing force (`hidden_layer`). N is linear in the
output layer, which is found by ridge regression of the measurements' residuals on the
traces of the hidden units (`LinearizedRecord`: dynamics hard, the parameters of the
physics moving along): the missing force is a smoothed guess, pale where it is sharp,
and its deviation from point to point does not say how little a curve through many
points may err. Only output layers whose force is orthogonal to the physics on the
record are allowed.
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.learning.force_response import N_FOLDS, Response
from phsi_opt.learning.force_samples import ForceSamples
from phsi_opt.learning.hidden_layer import STOPS, HiddenLayer, Training, trained_layers
from phsi_opt.statistics import TINY

# Weights of the squared output weights that are tried, relative to the features.
OUTPUT_RIDGES = 10.0 ** np.arange(-10, 1)
# Singular values, over the largest, that count as zero: rounding, of a force on the
# physics, and of the ridge regression.
ORTHOGONAL = 1e-12
NORMAL_RANK_TOLERANCE = 1e-15


@dataclass(frozen=True, eq=False)
class OutputLayer:
    """Weights (n_hidden,) of the hidden units, and a ``bias``."""

    weights: np.ndarray
    bias: float

    def at(self, features: np.ndarray) -> np.ndarray:
        """The force (n,) from hidden units and a one, (n, n_hidden + 1)."""
        return np.asarray(features[:, :-1] @ self.weights + self.bias)


@dataclass(frozen=True, eq=False)
class Network:
    """Both layers, and the share of left-out residuals that such networks explain."""

    hidden: HiddenLayer
    output: OutputLayer
    explains: float


@dataclass(frozen=True, eq=False)
class _Features:
    """Hidden units along a record, with a one.

    Attributes:
        traces: (n_values, n_features), theirs in the residuals.
        free: (n_features, n_free), orthonormal directions of output weights whose force
            is orthogonal to the physics.
    """

    traces: np.ndarray
    free: np.ndarray

    @classmethod
    def of(
        cls, features: np.ndarray, samples: ForceSamples, response: Response
    ) -> "_Features":
        """From features (n_intervals, n_features)."""
        traces = response.traces(features)
        scaled = features / samples.std[:, None]
        _, sizes, directions = np.linalg.svd(samples.physics.T @ scaled)
        n_bound = np.sum(sizes > ORTHOGONAL * np.max(sizes, initial=0.0))
        return cls(traces, np.asarray(directions[n_bound:].T))

    def outputs(self, used: np.ndarray, residual: np.ndarray) -> list[np.ndarray]:
        """Output weights, bias last, within the free directions: one per ridge.

        Args:
            used: (n_values,) of bool, the values that are regressed.
            residual: (n_values,).
        """
        traces = self.traces[used]
        free = self.free
        columns = traces @ free
        # the bias is free
        weights = free.T[:, :-1] @ free[:-1]
        ridge = weights * np.mean(traces**2) * len(traces)
        normal = columns.T @ columns
        right = columns.T @ residual[used]
        outputs = []
        for weight in OUTPUT_RIDGES:
            regularized = normal + weight * ridge
            found = np.linalg.lstsq(regularized, right, rcond=NORMAL_RANK_TOLERANCE)
            outputs.append(free @ found[0])
        return outputs


def fitted_network(
    z: np.ndarray, samples: ForceSamples, response: Response, training: Training
) -> Network:
    """The network, with epochs and ridge chosen on stretches of time left out.

    Args:
        z: (n, n_variables), the standardised variables.
        samples: the missing force there.
        response: of the residuals to a force.
        training: of the hidden layer.

    Raises:
        ModelError: torch is not installed.
    """
    errors = _errors_left_out(z, samples, response, training)
    total = errors.sum(axis=0)
    stop, ridge = np.unravel_index(int(np.argmin(total)), total.shape)
    everything = np.ones(len(z), dtype=bool)
    hidden = trained_layers(z, samples, everything, training)[stop]
    features = _Features.of(hidden.features(z), samples, response)
    every_value = np.ones(len(response.residual), dtype=bool)
    weights = features.outputs(every_value, response.residual)[ridge]
    output = OutputLayer(weights[:-1], float(weights[-1]))
    return Network(hidden, output, _explained_share(errors, response.residual))


def _errors_left_out(
    z: np.ndarray, samples: ForceSamples, response: Response, training: Training
) -> np.ndarray:
    """Squared residuals of each fold when it is left out.

    Returns:
        (n_folds, n_stops, n_ridges).
    """
    residual = response.residual
    errors = np.zeros((N_FOLDS, len(STOPS), len(OUTPUT_RIDGES)))
    for fold in range(N_FOLDS):
        used = response.fold != fold
        left_out = response.value_fold == fold
        lower = z[used].min(axis=0)
        upper = z[used].max(axis=0)
        inside = np.clip(z, lower, upper)
        for stop, hidden in enumerate(trained_layers(z, samples, used, training)):
            features = _Features.of(hidden.features(inside), samples, response)
            outputs = features.outputs(~left_out, residual)
            for ridge, weights in enumerate(outputs):
                predicted = features.traces[left_out] @ weights
                left = residual[left_out] - predicted
                errors[fold, stop, ridge] = np.sum(left**2)
    return errors


def _explained_share(errors: np.ndarray, residual: np.ndarray) -> float:
    """The share of the squared residuals that is predicted when it is left out.

    That of each fold is of the choice made on the other folds, so that choosing does
    not flatter it.
    """
    total = errors.sum(axis=0)
    left = 0.0
    for of_fold in errors:
        of_others = total - of_fold
        choice = np.unravel_index(int(np.argmin(of_others)), total.shape)
        left += of_fold[choice]
    squares = max(float(residual @ residual), TINY)
    return float(1 - left / squares)
