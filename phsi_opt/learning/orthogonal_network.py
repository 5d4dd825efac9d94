"""A network of one tanh layer for a missing force, kept orthogonal to what the physics
can produce.

N(v) = tanh(z weights' + bias) a + b with z the standardised variables. The hidden layer
is trained by Adam in torch on the missing force, weighted by its uncertainty. N is
linear in the output layer, which is found by ridge regression of the measurements'
residuals on the traces of the hidden units (`screen`: the linearised likelihood,
dynamics hard, the parameters of the physics moving along): the missing force is a
smoothed guess, pale where it is sharp, and its deviation from point to point does not
say how little a curve through many points may err. Only output layers whose force is
orthogonal to the physics on the record are allowed.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.estimation.record import Record
from phsi_opt.optimization.torch_threads import one_thread
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.statistics import TINY

N_HIDDEN = 16
# bound of the first hidden weights: some units bend within the range, some are nearly
# straight
FIRST_WEIGHTS = 2.5
RATE = 0.02  # of Adam
N_FOLDS = 5  # groups of stretches of time that are left out in turn
STOPS = (0.0, 0.2, 0.4, 0.7, 1.0)  # shares of the epochs at which training may stop
RIDGES = 10.0 ** np.arange(
    -10, 1
)  # weights of the squared output weights that are tried, relative to the features
NOTHING = 1e-8  # share of a column's size below which others explain it
Hidden = tuple[np.ndarray, np.ndarray]  # weights (n_hidden, n_variables) and bias
Output = tuple[np.ndarray, float]  # weights (n_hidden,) and bias


@dataclass(frozen=True, eq=False)
class ForceSamples:
    """The missing force of one equation along the record: variables v (n, n_variables),
    w and its deviation std (n,).

    ``physics`` (n, n_columns): orthonormal basis of the forces that the free parameters
    can produce, over std.
    """

    v: np.ndarray
    w: np.ndarray
    std: np.ndarray
    physics: np.ndarray

    @property
    def beyond_physics(self) -> np.ndarray:
        """The missing force (n,) less what the physics can explain of it, by weighted
        least squares.
        """
        scaled = self.w / self.std
        return np.asarray(scaled - self.physics @ (self.physics.T @ scaled)) * self.std


@dataclass(frozen=True, eq=False)
class Response:
    """What a force in equation ``row`` does to the residuals of the measurements, in
    units of the noise.

    ``residual`` (n_values,) is what the fit leaves; ``fold`` and ``value_fold`` say to
    which group of stretches of time an interval and a measured value belong.
    """

    linearized: LinearizedRecord
    row: int
    residual: np.ndarray
    fold: np.ndarray
    value_fold: np.ndarray

    @classmethod
    def of(cls, record: Record, row: int) -> "Response":
        """The response of a record, linearised at the states of its missing force."""
        linearized = LinearizedRecord.of(record)
        grid = linearized.grid
        is_measured = linearized.weight > 0
        # Two stretches per fold, so that a fold sees the beginning and the end of what
        # decays.
        of_node = np.arange(grid.n_nodes) * 2 * N_FOLDS // grid.n_nodes % N_FOLDS
        values = np.repeat(of_node, record.model.n_states)[is_measured]
        residual = linearized.residual[is_measured]
        return cls(linearized, row, residual, of_node[grid.begin], values)

    def traces(self, forces: np.ndarray) -> np.ndarray:
        """Change (n_values, n_forces) of what is explained by forces (n_intervals,
        n_forces).
        """
        linearized = self.linearized
        grid = linearized.grid
        n_states = linearized.model.n_states
        n_forces = forces.shape[1]
        of_defects = np.zeros((grid.n_intervals, n_states, n_forces))
        of_defects[:, self.row] = -forces
        of_outputs = np.zeros((grid.n_nodes * n_states, n_forces))
        traces = linearized.traces(of_defects.reshape(-1, n_forces), of_outputs)
        return traces[linearized.weight > 0]


def chosen(
    z: np.ndarray, record: ForceSamples, response: Response, epochs: int, seed: int
) -> tuple[Hidden, Output, float]:
    """Hidden layer, output layer, and the share explained, with epochs and ridge chosen
    on stretches left out.

    The share of each fold is that of the choice made on the other folds, so that
    choosing does not flatter it.
    """
    errors, r = np.zeros((N_FOLDS, len(STOPS), len(RIDGES))), response.residual
    for k in range(N_FOLDS):
        used, left = response.fold != k, response.value_fold == k
        inside = np.clip(z, z[used].min(axis=0), z[used].max(axis=0))
        for s, hidden in enumerate(_trained(z, record, used, epochs, seed)):
            features = features_of(inside, hidden)
            traces, free = response.traces(features), _orthogonal(features, record)
            for i, output in enumerate(_outputs(traces[~left], r[~left], free)):
                errors[k, s, i] = np.sum((r[left] - traces[left] @ output) ** 2)
    total = errors.sum(axis=0)
    others = [
        np.unravel_index(int(np.argmin(total - errors[k])), total.shape)
        for k in range(N_FOLDS)
    ]
    explains = 1 - sum(errors[k][at] for k, at in enumerate(others)) / max(
        float(r @ r), TINY
    )
    best = np.unravel_index(int(np.argmin(total)), total.shape)
    hidden = _trained(z, record, np.ones(len(z), dtype=bool), epochs, seed)[best[0]]
    features = features_of(z, hidden)
    output = _outputs(response.traces(features), r, _orthogonal(features, record))[
        best[1]
    ]
    return hidden, (output[:-1], float(output[-1])), float(explains)


def features_of(z: np.ndarray, hidden: Hidden) -> np.ndarray:
    """The hidden units and a one, (n, n_hidden + 1)."""
    return np.hstack([np.tanh(z @ hidden[0].T + hidden[1]), np.ones((len(z), 1))])


def _orthogonal(features: np.ndarray, record: ForceSamples) -> np.ndarray:
    """Orthonormal directions (n_features, n_free) of output weights whose force is
    orthogonal to the physics.
    """
    _, sizes, directions = np.linalg.svd(
        record.physics.T @ (features / record.std[:, None])
    )
    return np.asarray(
        directions[np.sum(sizes > 1e-12 * np.max(sizes, initial=0.0)) :].T
    )


def _outputs(
    traces: np.ndarray, residual: np.ndarray, free: np.ndarray
) -> list[np.ndarray]:
    """Output weights, bias last, within the free directions: one per ridge."""
    A = traces @ free
    ridge = (
        free.T[:, :-1] @ free[:-1] * np.mean(traces**2) * len(traces)
    )  # the bias is free
    normal, right = A.T @ A, A.T @ residual
    return [
        free @ np.linalg.lstsq(normal + weight * ridge, right, rcond=1e-15)[0]
        for weight in RIDGES
    ]


def _trained(
    z: np.ndarray, record: ForceSamples, used: np.ndarray, epochs: int, seed: int
) -> list[Hidden]:
    """The hidden layer at each of the `STOPS`, by Adam on the weighted squares that the
    physics leaves.
    """
    try:
        import torch
    except ImportError:
        raise ModelError(
            "a learned force needs torch: pip install 'phsi_opt[neural]'."
        ) from None

    with one_thread():
        made = torch.Generator().manual_seed(seed)

        def start(bound: float, *shape: int) -> Any:
            drawn = bound * (
                2 * torch.rand(shape, generator=made, dtype=torch.float64) - 1
            )
            return drawn.requires_grad_()

        layer = [
            start(FIRST_WEIGHTS, N_HIDDEN, z.shape[1]),
            start(FIRST_WEIGHTS, N_HIDDEN),
        ]
        last = [start(0.1, N_HIDDEN), start(0.1)]
        target = (record.beyond_physics / record.std)[used]
        size = max(float(np.sqrt(np.mean(target**2))), 1e-12)
        points, y = torch.tensor(z[used]), torch.tensor(target / size)
        weight = torch.tensor(np.median(record.std) / record.std[used])
        basis = torch.tensor(
            np.linalg.svd(record.physics[used], full_matrices=False)[0]
        )
        optimiser = torch.optim.Adam([*layer, *last], lr=RATE)
        stops, found = {round(share * epochs) for share in STOPS}, {}
        for epoch in range(epochs + 1):
            if epoch in stops:
                found[epoch] = (
                    layer[0].detach().numpy().copy(),
                    layer[1].detach().numpy().copy(),
                )
            optimiser.zero_grad()
            force = weight * (
                torch.tanh(points @ layer[0].T + layer[1]) @ last[0] + last[1]
            )
            torch.mean((force - basis @ (basis.T @ force) - y) ** 2).backward()
            optimiser.step()
    return [found[round(share * epochs)] for share in STOPS]
