"""A force by a network of ReLU layers: its settings, and its values once trained.

A trained force is a list of matrices and needs no torch. Its training is in
`network_training`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.model.model import Model

TIME_NAME = "t"  # of the time among the variables

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
            if given is not None and (isinstance(given, str) or not given):
                raise ModelError(
                    f"{name}={given!r} of NeuralForce must be a tuple of {words}, "
                    "such as ('p',)."
                )
        possible = all(isinstance(size, int) and size >= 1 for size in self.hidden)
        if not self.hidden or not possible:
            raise ModelError(
                f"hidden={self.hidden!r} of NeuralForce must be sizes of layers, "
                "such as (100, 100, 100)."
            )
        for name in ("epochs", "batch", "learning_rate"):
            value = getattr(self, name)
            if not value > 0:
                raise ModelError(
                    f"{name}={value!r} of NeuralForce must be a number above zero."
                )


@dataclass(frozen=True, eq=False)
class TrainedForce:
    """A trained network: force(x, t, u) for states x, times t and inputs u.

    It knows nothing beyond the data: outside the range of its training its variables,
    the time included, are held at the edge.

    Attributes:
        equations: states in whose equations it acts.
        columns: numbers of its variables among ``names``.
        rows: numbers of the equations.
        names: states, inputs and "t", of the model.
        n_states: number of the states among the names.
        shift: (n_variables,), subtracted from the variables.
        spread: (n_variables,), by which they are then divided.
        seen: (2, n_variables), least and largest value in training.
        layers: of the network.
    """

    equations: tuple[str, ...]
    columns: tuple[int, ...]
    rows: tuple[int, ...]
    names: tuple[str, ...]
    n_states: int
    shift: np.ndarray
    spread: np.ndarray
    seen: np.ndarray
    layers: Layers

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of what it depends on."""
        return tuple(self.names[column] for column in self.columns)

    def __call__(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """The force, (n_samples, n_equations).

        Args:
            x: states (n_samples, n_states).
            t: times (n_samples,), if it depends on the time.
            u: inputs (n_samples, n_inputs), if it depends on one.

        Raises:
            DataError: if t or u is needed and not given, or has another shape.
        """
        return self.at(self._rows_of(np.atleast_2d(x), t, u))

    def at(self, rows: np.ndarray) -> np.ndarray:
        """The force, (n_samples, n_equations), at rows of states, inputs and time.

        Args:
            rows: (n_samples, n_names), a column per name.
        """
        weights, bias = self.layers[-1]
        return self.features(rows) @ weights.T + bias

    def _rows_of(self, x: np.ndarray, t: Any, u: Any) -> np.ndarray:
        n_inputs = len(self.names) - self.n_states - 1
        parts = [
            x,
            self._given(u, "u", self.names[self.n_states : -1], (len(x), n_inputs)),
            self._given(t, TIME_NAME, (TIME_NAME,), (len(x), 1)),
        ]
        return np.hstack(parts)

    def _given(
        self, values: Any, argument: str, names: Sequence[str], shape: tuple[int, int]
    ) -> np.ndarray:
        """Inputs or times in the shape of rows; zeros where nothing depends on them."""
        needed = [name for name in self.variables if name in names]
        if values is None and needed:
            raise DataError(
                f"the force depends on {needed[0]!r}; give {argument} beside x."
            )
        if values is None:
            return np.zeros(shape)
        if np.size(values) != shape[0] * shape[1]:
            raise DataError(
                f"{argument} has shape {np.shape(values)}; expected {shape}, a row per "
                "row of x."
            )
        return np.reshape(np.asarray(values, dtype=float), shape)

    def features(self, rows: np.ndarray) -> np.ndarray:
        """Output of the last hidden layer, (n_samples, n_features).

        Args:
            rows: (n_samples, n_names), as those of `at`.
        """
        variables = rows[:, self.columns]
        inside = np.clip(variables, *self.seen)
        z = (inside - self.shift) / self.spread
        for weights, bias in self.layers[:-1]:
            z = np.maximum(z @ weights.T + bias, 0.0)
        return z


def known_names(model: Model) -> tuple[str, ...]:
    """What a force of a model may depend on: states, inputs, and the time "t"."""
    return (*model.states, *model.inputs, TIME_NAME)


def variable_columns(model: Model, variables: Sequence[str]) -> tuple[int, ...]:
    """Numbers of variables among `known_names`.

    Raises:
        ModelError: if one is none of them.
    """
    names = known_names(model)
    columns = []
    for variable in variables:
        if variable not in names:
            raise ModelError(
                f"variable of NeuralForce {variable!r} is not a state, an input or the "
                f"time 't' of the model; expected one of {', '.join(names)}."
                f"{did_you_mean(str(variable), names)}"
            )
        columns.append(names.index(variable))
    return tuple(columns)
