"""Gradient descent as the thesis' comparison needs it beside the plain method.

A force network may be trained with the dictionary (the thesis' hybrid, Section 6.4),
and terms may also be pruned by significance, with the solver's own test.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.descent import Adam, Progress
from phsi_opt.baselines.gradient_descent import Descent, DescentRun
from phsi_opt.baselines.result import Baseline
from phsi_opt.baselines.torch_dictionary import DictionaryDynamics
from phsi_opt.baselines.torch_steps import RightHandSide
from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.uncertainty import of_defects
from phsi_opt.initialization.scaling import first_point
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.optimization.torch_threads import one_thread
from problems.peers.joint_force import HybridBaseline, JointForce
from problems.peers.torch_networks import (
    PlacedForce,
    TorchLayers,
    arrays_of,
    as_type,
    parameters_of,
    random_layers,
)

# Share of the epochs before which nothing is tested: the values are still on their way,
# and the L1 term on H is off only from there on (the thesis' code).
TESTED_FROM = 0.5


@interruptible
def joint_descent(
    model: Model,
    data: Measurements,
    settings: Descent,
    seed: int = 0,
    force: JointForce | None = None,
    significance: float | None = None,
    progress: Progress | None = None,
) -> Baseline:
    """`gradient_descent` with a force network, or with the test of significance.

    Args:
        model: with any dictionaries.
        data: every state measured.
        settings: of the descent.
        seed: of the order of the batches, and of random weights.
        force: a force by a network, trained with the rest; the result is then a
            `HybridBaseline`.
        significance: from half of the epochs on, terms go as well while the data do not
            contradict that they are zero: the test of `phsi_opt.Pruning`, with the
            standard errors of the PHSI loss, at every pruning. What L1 still shrinks is
            tested as it is. None: size alone, as the thesis has it.
        progress: called with a line of text every few epochs.

    Raises:
        ModelError: if the force or the significance makes no sense.
    """
    with one_thread():
        if force is None:
            run = _TestedRun(model, data, settings, seed, significance)
        else:
            run = _JointRun(model, data, settings, seed, significance, force)
        return run.result(progress)


class _TestedRun(DescentRun):
    """A descent whose terms go by their significance too."""

    def __init__(
        self,
        model: Model,
        data: Measurements,
        settings: Descent,
        seed: int,
        significance: float | None,
    ) -> None:
        super().__init__(model, data, settings, seed)
        self.pruning = replace(self.pruning, significance=significance)
        self.n_tests = len(self.pruning.candidates(model))

    def weak(self, epoch: int) -> set[str]:
        """Those that are small; then those for which zero explains the data as well."""
        small = super().weak(epoch)
        is_tested = self.pruning.significance is not None
        if not is_tested or epoch < np.ceil(TESTED_FROM * self.settings.epochs):
            return small
        self.remove(small)
        kept = self.kept()
        return self._insignificant(kept) if self.pruning.candidates(kept) else set()

    def _insignificant(self, kept: Model) -> set[str]:
        """By the sandwich covariance of the PHSI loss at the values so far.

        It says nothing of whether they are an optimum.
        """
        scheme = self.settings.integrator
        theta = kept.theta
        scale = first_point(kept, self.grid, theta).theta_scale
        with torch.no_grad():
            f = self.rates(self.dynamics, self.theta)
            d = self.steps.defects(f, self.steps.tables).double().numpy()
        found = of_defects(kept, self.grid, scheme, theta, scale, (), d)
        return self.pruning.insignificant(
            kept, kept.values, found.covariance, self.n_tests
        )


class _JointRun(_TestedRun):
    """A descent with a force network beside the dictionary."""

    def __init__(
        self,
        model: Model,
        data: Measurements,
        settings: Descent,
        seed: int,
        significance: float | None,
        force: JointForce,
    ) -> None:
        self.force = force
        self.placed = PlacedForce.of(force, model)
        super().__init__(model, data, settings, seed, significance)

    def further(self) -> list[Tensor]:
        """The weights."""
        self.layers = random_layers(self.placed.widths, self.generator, self.dtype)
        return parameters_of(self.layers)

    def optimizer(self) -> Adam:
        """Adam, with the learning rate of the weights."""
        relative = 1.0
        if self.force.rate is not None:
            relative = self.force.rate / self.settings.learning_rate
        rates = [1.0] + [relative] * (len(self.parameters) - 1)
        return Adam(self.parameters, self.settings.weight_decay, rates)

    def rates(self, dynamics: DictionaryDynamics, theta: Tensor) -> "_JointRates":
        """The dictionary and the force."""
        layers = as_type(self.layers, theta.dtype)
        return _JointRates(dynamics.at(theta), self.placed, layers, [])

    def loss(self, tables: Sequence[Tensor]) -> Tensor:
        """The loss of a batch, with the penalty of the force at the last stage."""
        f = self.rates(self.dynamics, self.theta)
        value = self.steps.loss(f, tables)
        if self.force.penalty:
            value = value + self.force.penalty * f.forces[-1].abs().mean()
        return value

    def result(self, progress: Progress | None = None) -> HybridBaseline:
        """Descend; the record of both."""
        found = super().result(progress)
        parts = {part.name: getattr(found, part.name) for part in fields(found)}
        parts["method"] = "gradient descent with a neural force"
        layers = arrays_of(self.layers)
        return HybridBaseline(neural=self.force, layers=layers, **parts)


@dataclass(frozen=True)
class _JointRates:
    """A right-hand side with the force; ``forces`` holds what it gave so far."""

    inside: RightHandSide
    placed: PlacedForce
    layers: TorchLayers
    forces: list[Tensor]

    def __call__(self, x: Tensor, z: Tensor) -> Tensor:
        """dx/dt, (n_rows, n_states)."""
        self.forces.append(self.placed.value(self.layers, x, z))
        return self.inside(x, z).index_add(1, self.placed.rows, self.forces[-1])
