"""The vector of unknown parameters: shared ones once, those `per_trajectory` once for
every trajectory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry


@dataclass(frozen=True, eq=False)
class Theta:
    """Names and places of the unknown parameters of a model in several trajectories.

    Attributes:
        names: of each entry: ``k``, and ``m[run 1]``, ``m[run 2]`` for a parameter per
            trajectory (of several).
        owner: (n_theta,) position of each entry's parameter in ``model.free``.
        table: (n_free, n_trajectories) place of each model parameter of each trajectory
            in theta.
    """

    model: Model
    runs: tuple[str, ...]
    names: tuple[str, ...]
    owner: np.ndarray
    table: np.ndarray

    @classmethod
    def of(cls, model: Model, runs: Sequence[str]) -> "Theta":
        """The unknown parameters of ``model`` in the trajectories ``runs``."""
        names: list[str] = []
        owner: list[int] = []
        table = np.zeros((len(model.free), len(runs)), dtype=int)
        for i, name in enumerate(model.free):
            local = len(runs) > 1 and model.entries[name].parameter.per_trajectory
            table[i] = len(names) + (np.arange(len(runs)) if local else 0)
            names += [f"{name}[{run}]" for run in runs] if local else [name]
            owner += [i] * (len(runs) if local else 1)
        twice = (
            {name for name in names if names.count(name) > 1}
            if len(set(names)) < len(names)
            else set()
        )
        if twice:
            raise ModelError(
                f"the name {sorted(twice)[0]!r} stands for two parameters, one of them of a trajectory; rename the "
                "trajectory, or name the term."
            )
        return cls(model, tuple(runs), tuple(names), np.array(owner, dtype=int), table)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_shared(self) -> bool:
        """Whether every trajectory has the same parameters."""
        return len(self.names) == len(self.model.free)

    @property
    def entries(self) -> list[Entry]:
        """The model's entry of each parameter in theta."""
        found = self.model.entries
        return [found[self.model.free[i]] for i in self.owner]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Theta from one value per model parameter."""
        return np.asarray(values, dtype=float)[self.owner]

    def by_trajectory(self, theta: Any) -> Any:
        """The parameters of the model as columns: one for all, or (n_free,
        n_trajectories); symbols or numbers.
        """
        if self.is_shared:
            return theta
        if isinstance(theta, np.ndarray):
            return theta[self.table]
        return ca.reshape(theta[self.table.T.ravel().tolist()], *self.table.shape)

    def means(self, theta: np.ndarray) -> np.ndarray:
        """One value per model parameter: its mean over the trajectories."""
        return np.asarray(theta[self.table].mean(axis=1)) if len(theta) else np.zeros(0)

    def values_of(self, theta: np.ndarray, run: str) -> dict[str, float]:
        """The model's parameters in one trajectory."""
        column = self.table[:, self.runs.index(run)]
        return dict(zip(self.model.free, theta[column].tolist(), strict=True))

    def from_values(
        self, values: Mapping[str, float], default: np.ndarray
    ) -> np.ndarray:
        """Theta from values by name: of its own (``m[run 1]``), else of its model
        parameter, else the default.
        """
        pairs = zip(self.names, self.owner, default, strict=True)
        return np.array(
            [values.get(n, values.get(self.model.free[i], d)) for n, i, d in pairs]
        )
