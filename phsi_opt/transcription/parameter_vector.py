"""The unknowns of a program: the vector theta of parameters, and a point to start from.

A parameter that all trajectories share stands in theta once, one that is
`per_trajectory` once for every trajectory. Values that are fixed are not in it. The
sizes of a point scale the variables and constraints of a program, so that the solver
sees numbers near one whatever the units are; they are found in
``phsi_opt.initialization``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry


@dataclass(frozen=True, eq=False)
class Theta:
    """Names and places of the unknown parameters of a model in several trajectories."""

    model: Model  # the model whose free parameters these are
    runs: tuple[str, ...]  # names of the trajectories
    # Of each entry: ``k``, and ``m[run 1]``, ``m[run 2]`` for a parameter per
    # trajectory (of several).
    names: tuple[str, ...]
    owner: np.ndarray  # (n_theta,) position of each entry's parameter in ``model.free``
    # (n_free, n_trajectories) place of each model parameter of each trajectory in
    # theta.
    table: np.ndarray

    @classmethod
    def of(cls, model: Model, runs: Sequence[str]) -> "Theta":
        """The unknown parameters of ``model`` in the trajectories ``runs``.

        Raises:
            ModelError: a name stands for two of them.
        """
        names: list[str] = []
        owner: list[int] = []
        table = np.zeros((len(model.free), len(runs)), dtype=int)
        for i, name in enumerate(model.free):
            is_local = len(runs) > 1 and model.entries[name].parameter.per_trajectory
            added = [f"{name}[{run}]" for run in runs] if is_local else [name]
            table[i] = len(names) + (np.arange(len(runs)) if is_local else 0)
            names += added
            owner += [i] * len(added)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ModelError(
                f"the name {twice[0]!r} belongs to two parameters, one of them for a "
                "single trajectory; rename the trajectory, or give the term a name."
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
        by_name = self.model.entries
        return [by_name[self.model.free[i]] for i in self.owner]

    @property
    def lower(self) -> np.ndarray:
        return np.array(list(map(attrgetter("parameter.lower"), self.entries)))

    @property
    def upper(self) -> np.ndarray:
        return np.array(list(map(attrgetter("parameter.upper"), self.entries)))

    @property
    def priors(self) -> np.ndarray:
        """Mean and 1/variance of each prior, (2, n_theta); zero where there is none."""
        found = np.zeros((2, len(self)))
        for place, entry in enumerate(self.entries):
            if entry.parameter.prior is not None:
                mean, deviation = entry.parameter.prior
                found[:, place] = [mean, deviation**-2]
        return found

    def weights(self, l1: Mapping[str, float]) -> np.ndarray:
        """Weight of each entry in an L1 term, (n_theta,), from weights by slot."""
        weights = [l1.get(one.slot, 0.0) * one.prunable for one in self.entries]
        return np.array(weights, dtype=float)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Theta from one value per model parameter, (n_free,) -> (n_theta,)."""
        return np.asarray(values, dtype=float)[self.owner]

    def by_trajectory(self, theta: Any) -> Any:
        """The parameters of the model as columns, (n_free, n_trajectories).

        ``theta`` (n_theta,) are symbols or numbers; where all are shared, it is
        returned as it is.
        """
        if self.is_shared:
            return theta
        if isinstance(theta, np.ndarray):
            return theta[self.table]
        column_by_column = self.table.T.ravel().tolist()
        return ca.reshape(theta[column_by_column], *self.table.shape)

    def stacked(self, parameters: np.ndarray) -> np.ndarray:
        """Theta from (n_free, n_trajectories): what `by_trajectory` takes apart."""
        theta = np.zeros(len(self))
        theta[self.table] = parameters
        return theta

    def means(self, theta: np.ndarray) -> np.ndarray:
        """One value per model parameter, (n_free,): its mean over the trajectories."""
        if not len(theta):
            return np.zeros(0)
        return np.asarray(theta[self.table].mean(axis=1))

    def values_of(self, theta: np.ndarray, run: str) -> dict[str, float]:
        """The model's parameters in one trajectory, by name."""
        places = self.table[:, self.runs.index(run)]
        return dict(zip(self.model.free, theta[places].tolist(), strict=True))

    def from_values(
        self, values: Mapping[str, float], default: np.ndarray
    ) -> np.ndarray:
        """Theta from values by name.

        The value of an entry is that of its own name (``m[run 1]``), else that of its
        model parameter, else the default (n_theta,).
        """
        theta = []
        for name, owner, fallback in zip(self.names, self.owner, default, strict=True):
            of_parameter = values.get(self.model.free[owner], fallback)
            theta.append(values.get(name, of_parameter))
        return np.array(theta)


UNBOUNDED = np.array([-np.inf, np.inf])[:, None, None]


@dataclass(frozen=True, eq=False)
class Point:
    """A point to start from, with the size of each quantity."""

    # (n_theta,) parameters, in the order of `Theta`; ``theta_scale``: sizes.
    theta: np.ndarray
    # (n_nodes, n_states) states at the nodes; ``x_scale``: (n_states,) sizes.
    x: np.ndarray
    theta_scale: np.ndarray
    x_scale: np.ndarray
    # Lower and upper bounds of ``x``, (2, n_nodes, n_states).
    x_bounds: np.ndarray = field(default_factory=lambda: UNBOUNDED)

    @property
    def scale(self) -> np.ndarray:
        """Sizes of parameters and states in z, the variables of a program, (n,)."""
        return np.concatenate([self.theta_scale, np.tile(self.x_scale, len(self.x))])

    @property
    def scaled(self) -> np.ndarray:
        """Parameters and states over their sizes, (n,), where z begins."""
        return np.concatenate([self.theta, self.x.ravel()]) / self.scale

    def unscaled(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters, and states (n_nodes, n_states), by block, from z (n,)."""
        values = z * self.scale
        x = values[self.of_x].reshape(self.x.shape)
        return {"theta": values[self.of_theta], "x": x}

    @property
    def of_theta(self) -> slice:
        """Where the parameters stand in z, which begins with them."""
        return slice(0, self.theta.size)

    @property
    def of_x(self) -> slice:
        return slice(self.theta.size, self.theta.size + self.x.size)
