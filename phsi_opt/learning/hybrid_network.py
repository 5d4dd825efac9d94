"""A force by a network of ReLU layers beside a dictionary: its settings and its values.

Its training is in `hybrid_training`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.arguments import is_count, require, require_known, require_positive
from phsi_opt.errors import DataError
from phsi_opt.learning.network import Network
from phsi_opt.model.model import Model

TIME_NAME = "t"  # of the time among the variables
UNTRAINED = Network(np.zeros(0), np.zeros(0), np.zeros((2, 0)), "relu")


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
    """A trained network: force(x, t, u) for states x, times t and inputs u.

    Attributes:
        equations: states in whose equations it acts.
        variables: states, inputs and "t" that it depends on.
        names: all states, inputs and "t" of the model.
        n_states: number of the states among the names.
        network: of the variables.
    """

    equations: tuple[str, ...]
    variables: tuple[str, ...]
    names: tuple[str, ...]
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
        x = np.atleast_2d(x)
        u = self._given(u, "u", self.names[self.n_states : -1], len(x))
        t = self._given(t, TIME_NAME, (TIME_NAME,), len(x))
        return self.at(np.hstack([x, u, t]))

    def at(self, rows: np.ndarray) -> np.ndarray:
        """The force, (n_samples, n_equations), at rows (n_samples, n_names)."""
        return self.network.at(self.values_in(rows))

    def values_in(self, rows: np.ndarray) -> np.ndarray:
        """Those of the variables in rows (..., n_names), (..., n_variables)."""
        return rows[..., list(map(self.names.index, self.variables))]

    def _given(
        self, values: Any, argument: str, names: tuple[str, ...], n_samples: int
    ) -> np.ndarray:
        """Inputs or times in the shape of rows; zeros where nothing depends on them."""
        shape = (n_samples, len(names))
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
