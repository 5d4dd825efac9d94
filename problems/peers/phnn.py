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

from phsi_opt.arguments import require
from phsi_opt.baselines.descent import descend
from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.losses import complete_intervals
from problems.peers.joint_force import JointForce
from problems.peers.phnn_model import PHNN, hidden_values, input_gradient
from problems.peers.torch_networks import (
    PlacedForce,
    arrays_of,
    as_type,
    parameters_of,
    random_layers,
)
from problems.peers.torch_steps import Steps

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

    def rate(self, epoch: int) -> float:
        """The learning rate, in every epoch the same."""
        return self.learning_rate


@interruptible
def phnn(
    data: Measurements,
    S: Any,
    settings: NetworkDescent | None = None,
    damping: Sequence[str] = (),
    force: tuple[Sequence[str], Sequence[str]] | None = None,
    seed: int = 0,
) -> PHNN:
    """Train H, R and F of dx/dt = (S - R) grad H + F (Eidnes et al. 2023).

    They minimise::

        (1/m) sum |(x1 - x0)/h - Psi|^2
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
        dtype: torch.dtype = getattr(torch, settings.dtype)
        generator = torch.Generator().manual_seed(seed)
        networks = _Networks(model, damping, settings, neural, generator)
        steps = Steps(grid, settings.integrator, dtype)
        decay = settings.weight_decay
        history = descend(
            torch.optim.Adam(networks.parameters, weight_decay=decay),
            lambda tables: networks.loss(steps, tables, settings.penalty),
            steps.tables,
            settings,
            generator,
        )
        exact = Steps(grid, settings.integrator, torch.float64)
        loss_value = float(networks.loss(exact, exact.tables).detach())
    return PHNN(
        states=data.states,
        inputs=data.inputs,
        S=np.array(model.S),
        neural=neural,
        hold=checked_hold(data.hold, data.inputs),
        damping=dict(zip(damping, networks.damping.tolist(), strict=True)),
        energy_layers=arrays_of(networks.energy),
        force_layers=arrays_of(networks.force),
        seconds=time.perf_counter() - began,
        loss_value=loss_value,
        history=history,
        settings=str(settings),
    )


class _Networks:
    """The diagonal of R, the layers of H and those of F, and their right-hand side."""

    def __init__(
        self,
        model: Model,
        damping: Sequence[str],
        settings: NetworkDescent,
        neural: JointForce | None,
        generator: torch.Generator,
    ) -> None:
        dtype: torch.dtype = getattr(torch, settings.dtype)
        distinct = len(set(damping)) == len(damping)
        require(distinct, "damping", tuple(damping), "each state only once")
        n = model.n_states
        damped = [model.index(name, "damping of") * (n + 1) for name in damping]
        self.damped = torch.tensor(damped, dtype=torch.long)
        self.damping = torch.zeros(len(damped), dtype=dtype, requires_grad=True)
        self.structure = torch.tensor(np.array(model.S).T.copy())
        self.energy = random_layers([n, *settings.hidden, 1], generator, dtype)
        self.placed = PlacedForce.of(neural, model) if neural else None
        widths = self.placed.widths if self.placed else ()
        self.force = random_layers(widths, generator, dtype)
        layers = parameters_of(self.energy) + parameters_of(self.force)
        self.parameters = [self.damping, *layers] if damped else layers

    def loss(
        self, steps: Steps, tables: Sequence[Tensor], penalty: float = 0.0
    ) -> Tensor:
        """The loss of a batch in the precision of its tables.

        The penalty is on the mean of ``|F|`` at the last stage.
        """
        dtype = tables[0].dtype
        energy = as_type(self.energy, dtype)
        force = as_type(self.force, dtype)
        structure = self._structure(dtype)
        forces: list[Tensor] = []

        def rates(x: Tensor, z: Tensor) -> Tensor:
            hidden = hidden_values(energy, x)
            dx: Tensor = input_gradient(energy, hidden) @ structure
            if self.placed is None:
                return dx
            forces.append(self.placed.value(force, x, z))
            return dx.index_add(1, self.placed.rows, forces[-1])

        value = steps.loss(rates, tables)
        if penalty and forces:
            value = value + penalty * forces[-1].abs().mean()
        return value

    def _structure(self, dtype: torch.dtype) -> Tensor:
        """(S - R)'."""
        structure = self.structure.to(dtype)
        damping = self.damping.to(dtype)
        flat = structure.reshape(-1).index_add(0, self.damped, damping, alpha=-1)
        return flat.view_as(structure)
