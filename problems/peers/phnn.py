"""PHNN: a pseudo-Hamiltonian model whose energy and force are networks.

dx/dt = (S - R) grad H(x) + F(x, t, u) with S known, a diagonal R to learn, H a network
with tanh and F a network with ReLU or nothing (Eidnes et al. 2023). Trained like the
PHSI model, on the same loss. It predicts; it gives no equations.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.descent import Adam, Batches, Hooks, Progress, descend
from phsi_opt.baselines.descent_settings import (
    check_descent,
    is_count,
    require,
    require_size,
)
from phsi_opt.baselines.joint_force import JointForce
from phsi_opt.baselines.torch_defects import Steps
from phsi_opt.baselines.torch_networks import (
    DTYPE_OF,
    Network,
    PlacedForce,
    arrays_of,
)
from phsi_opt.data.measurements import Measurements
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.optimization.torch_threads import one_thread
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import complete_intervals
from problems.peers.phnn_model import PHNN, hidden_values, input_gradient

__all__ = ["PHNN", "NetworkDescent", "phnn"]


@dataclass(frozen=True)
class NetworkDescent:
    """How the PHNN is built and how it descends.

    Args:
        learning_rate: of Adam.
        epochs: passes over the data.
        batch: samples per step.
        hidden: widths of the layers of H, with tanh.
        force_hidden: widths of the layers of F, with ReLU.
        penalty: weight of the mean of ``|F|`` over the batch (the thesis: 0.1 for the
            mass-spring).
        weight_decay: of Adam.
        integrator: a name in ``phsi_opt.transcription.integrators``.
        dtype: "float32" (as the thesis) or "float64".

    Raises:
        ModelError: if a setting is not possible.
    """

    learning_rate: float = 3e-3
    epochs: int = 150
    batch: int = 32
    hidden: tuple[int, ...] = (100, 100)
    force_hidden: tuple[int, ...] = (100, 100)
    penalty: float = 0.0
    weight_decay: float = 0.0
    integrator: str = "srk4"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        check_descent(self)
        require_size("penalty", self.penalty)
        for name in ("hidden", "force_hidden"):
            widths = tuple(getattr(self, name))
            possible = all(is_count(width) for width in widths) and len(widths) > 0
            require(possible, name, widths, "at least one width of 1 or more")
            object.__setattr__(self, name, widths)


@interruptible
def phnn(
    data: Measurements,
    S: Any,
    settings: NetworkDescent | None = None,
    damping: Sequence[str] = (),
    force: tuple[Sequence[str], Sequence[str]] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> PHNN:
    """Train H, R and F of dx/dt = (S - R) grad H + F (Eidnes et al. 2023).

    They minimise::

        (1/m) sum |(x1 - x0)/h - Psi|^2

    Args:
        data: every state measured.
        S: (n_states, n_states), skew-symmetric, in the order of the data's states.
        settings: see `NetworkDescent`.
        damping: states with an entry of R; it starts at zero and may change its sign.
        force: (equations, variables) of the force network, such as (["p"], ["t"]); None
            has no force.
        seed: of the weights and of the order of the batches.
        progress: called with a line of text every few epochs.

    Raises:
        DataError: for data that do not suit.
        ModelError: for unknown names.
        SolveError: if the loss diverges.
    """
    began = time.perf_counter()
    settings = settings or NetworkDescent()
    model = Model(states=data.states, inputs=data.inputs, S=S)
    neural = None
    if force is not None:
        equations, variables = force
        neural = JointForce(tuple(equations), tuple(variables), settings.force_hidden)
    grid = complete_intervals(model, grid_of(data))
    with one_thread():
        dtype = DTYPE_OF[settings.dtype]
        dynamics = _NetworkDynamics(model, tuple(damping), settings, neural, dtype)
        generator = torch.Generator().manual_seed(seed)
        start = dynamics.start(generator).requires_grad_()
        adam = Adam(start, settings.weight_decay)
        steps = Steps(grid, settings.integrator, dynamics, dtype)
        history = descend(
            adam,
            lambda flat, tables: steps.loss(flat, tables, settings.penalty),
            Batches(steps.tables, steps.n_intervals, settings.batch, generator),
            settings.epochs,
            Hooks(rate=lambda epoch: settings.learning_rate),
            progress,
        )
        flat = adam.raw.to(torch.float64)
        exact = _NetworkDynamics(model, tuple(damping), settings, neural, torch.float64)
        loss_value = _loss(exact, flat, grid, settings.integrator)
        parts = exact.parts(flat)
    return PHNN(
        states=data.states,
        inputs=data.inputs,
        S=np.array(model.S),
        neural=neural,
        hold=data.hold,
        damping=dict(zip(damping, parts.damping.tolist(), strict=True)),
        energy_layers=arrays_of(parts.energy),
        force_layers=arrays_of(parts.force),
        seconds=time.perf_counter() - began,
        loss_value=loss_value,
        history=history,
        settings=str(settings),
    )


def _loss(dynamics: "_NetworkDynamics", flat: Tensor, grid: Grid, scheme: str) -> float:
    """The loss over all data in double precision, without penalty."""
    steps = Steps(grid, scheme, dynamics, torch.float64)
    return float(steps.loss(flat, steps.all_tables()))


@dataclass(frozen=True)
class _Parts:
    """The flat vector taken apart: diagonal of R, layers of H, layers of F."""

    damping: Tensor
    energy: list[tuple[Tensor, Tensor]]
    force: list[tuple[Tensor, Tensor]]


class _NetworkDynamics:
    """The right-hand side in torch.

    The flat vector holds the diagonal of R, the weights of H, then those of F.
    """

    def __init__(
        self,
        model: Model,
        damping: tuple[str, ...],
        settings: NetworkDescent,
        neural: JointForce | None,
        dtype: torch.dtype,
    ) -> None:
        self.dtype = dtype
        distinct = len(set(damping)) == len(damping)
        require(distinct, "damping", damping, "each state only once")
        n = model.n_states
        damped = [model.index(name, "damping of") for name in damping]
        on_diagonal = [i * n + i for i in damped]
        self.damped = torch.tensor(on_diagonal, dtype=torch.long)
        self.structure = torch.tensor(np.array(model.S).T.copy(), dtype=dtype)
        self.energy = Network([n, *settings.hidden, 1])
        self.force: PlacedForce | None = None
        self.outside: list[int] = []
        if neural is not None:
            self._place(model, neural)

    def _place(self, model: Model, neural: JointForce) -> None:
        around = (*model.inputs, "t")
        self.outside = [i for i, name in enumerate(around) if name in neural.variables]
        variables = (*model.states, *(around[i] for i in self.outside))
        self.force = PlacedForce.of(neural, model, variables)

    def start(self, generator: torch.Generator) -> Tensor:
        """Zero damping, random weights."""
        damping = torch.zeros(len(self.damped), dtype=self.dtype)
        parts = [damping, self.energy.start(generator, self.dtype)]
        if self.force is not None:
            parts.append(self.force.network.start(generator, self.dtype))
        return torch.cat(parts)

    def parts(self, flat: Tensor) -> _Parts:
        """The flat vector taken apart."""
        n_energy = len(self.energy.sizes)
        force_sizes = self.force.network.sizes if self.force else []
        sizes = [len(self.damped), *self.energy.sizes, *force_sizes]
        damping, *weights = flat.split(sizes)
        energy = self.energy.layers(weights[:n_energy])
        if self.force is None:
            return _Parts(damping, energy, [])
        return _Parts(damping, energy, self.force.network.layers(weights[n_energy:]))

    def features(self, x: Tensor, z: Tensor | None) -> None:
        """Nothing can be computed ahead: all weights move."""

    def at(self, flat: Tensor) -> "_NetworkEvaluation":
        """The right-hand side at the parameters."""
        return _NetworkEvaluation(self, self.parts(flat))


class _NetworkEvaluation:
    """`_NetworkDynamics` at given parameters."""

    def __init__(self, dynamics: _NetworkDynamics, parts: _Parts) -> None:
        self.parts = parts
        self.force = dynamics.force
        self.forces: list[Tensor] = []
        self.structure = dynamics.structure
        if len(parts.damping):
            flat = self.structure.reshape(-1)
            damped = flat.index_add(0, dynamics.damped, parts.damping, alpha=-1)
            self.structure = damped.view_as(self.structure)

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        """dx/dt, (n_rows, n_states); see `torch_defects.Evaluation`."""
        hidden = hidden_values(self.parts.energy, x)
        dx: Tensor = input_gradient(self.parts.energy, hidden) @ self.structure
        if self.force is None:
            return dx
        self.forces.append(self.force.value(self.parts.force, x, z))
        return dx.index_add(1, self.force.rows, self.forces[-1])
