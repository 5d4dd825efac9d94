"""Gradient descent as the thesis' comparison needs it beside the plain method.

A force network may be trained with the dictionary (the thesis' hybrid, Section 6.4),
and terms may also be pruned by significance, with the solver's own test.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.descent import Baseline
from phsi_opt.baselines.gradient_descent import Descent, DescentRun
from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.uncertainty import of_defects
from phsi_opt.initialization.scaling import first_point
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.column_function import in_rows
from phsi_opt.simulation.simulate import BufferedFunction
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.sweeps.sweep import Progress
from problems.peers.joint_force import HybridBaseline, JointForce
from problems.peers.torch_networks import (
    PlacedForce,
    TorchLayers,
    arrays_of,
    as_type,
    parameters_of,
    random_layers,
)
from problems.peers.torch_steps import Steps

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
    """`gradient_descent` with a force network, or with the test of significance."""
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
        d = self.defects(kept)
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
        self.steps = Steps(self.grid, settings.integrator, self.dtype)
        self.tables = self.steps.tables
        self.layers = random_layers(self.placed.widths, self.generator, self.dtype)
        rate = force.rate or settings.learning_rate
        weights = parameters_of(self.layers)
        relative = rate / settings.learning_rate
        self.adam.add_param_group({"params": weights, "rate": relative})

    def rates(self, model: Model, theta: Tensor) -> "_JointRates":
        """The model at its free parameters, and the force."""
        layers = as_type(self.layers, theta.dtype)
        return _JointRates(model, theta, self.placed, layers, [])

    def loss(self, tables: Sequence[Tensor]) -> Tensor:
        """The loss of a batch, with the penalty of the force at the last stage."""
        f = self.rates(self.model, self.theta)
        value = self.steps.loss(f, tables)
        if self.force.penalty:
            value = value + self.force.penalty * f.forces[-1].abs().mean()
        return value

    def defects(self, kept: Model) -> np.ndarray:
        """Those of all data by the model that is kept and the force."""
        exact = Steps(self.grid, self.settings.integrator, torch.float64)
        with torch.no_grad():
            f = self.rates(kept, torch.tensor(kept.theta))
            return exact.defects(f, exact.tables).numpy()

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

    model: Model
    theta: Tensor
    placed: PlacedForce
    layers: TorchLayers
    forces: list[Tensor]

    def __call__(self, x: Tensor, z: Tensor) -> Tensor:
        """dx/dt, (n_rows, n_states)."""
        self.forces.append(self.placed.value(self.layers, x, z))
        dx: Tensor = _ModelRates.apply(self.model, x, z, self.theta)
        return dx.index_add(1, self.placed.rows, self.forces[-1])


class _ModelRates(torch.autograd.Function):
    """dx/dt of a model by CasADi, in double precision, and its slopes in x and theta.

    Its arguments are those of `torch_steps.RightHandSide` between the model and theta.
    """

    @staticmethod
    def forward(ctx: Any, model: Model, x: Tensor, z: Tensor, theta: Tensor) -> Tensor:
        ctx.model = model
        ctx.save_for_backward(x, z, theta)
        return _in_rows(model, _rates, [x, z], theta)[0]

    @staticmethod
    def backward(ctx: Any, weight: Tensor) -> tuple[Tensor | None, ...]:
        x, z, theta = ctx.saved_tensors
        of_x, of_theta = _in_rows(ctx.model, _products, [x, z, weight], theta)
        return None, of_x, None, of_theta.sum(0)


def _rates(model: Model) -> ca.Function:
    """CasADi function (x and z, theta) -> dx/dt."""
    x, u, t, theta = argument_symbols(model.rhs())
    row = ca.vertcat(x, u, t, ca.SX.sym("one"))
    return ca.Function("rates", [row, theta], [model.rhs()(x, u, t, theta)])


def _products(model: Model) -> ca.Function:
    """CasADi function (x, z and weights, theta) -> weighted slopes in x and theta."""
    row, theta = argument_symbols(_rates(model))
    weight = ca.SX.sym("weight", model.n_states)
    dx = _rates(model)(row, theta)
    of_row, of_theta = (ca.jtimes(dx, one, weight, True) for one in (row, theta))
    slopes = [ca.densify(of_row[: model.n_states]), ca.densify(of_theta)]
    return ca.Function("products", [ca.vertcat(row, weight), theta], ca.cse(slopes))


def _in_rows(
    model: Model,
    make: Callable[[Model], ca.Function],
    columns: Sequence[Tensor],
    theta: Tensor,
) -> list[Tensor]:
    """The results of a function of the model, a row each for every row of a table."""
    rows = torch.cat(list(columns), 1).numpy()
    key = (make, len(rows))
    of_all = model.built(key, lambda: in_rows(make(model), len(rows)))
    results = BufferedFunction(of_all)(rows.T, theta.numpy())
    return [torch.tensor(one.T, dtype=theta.dtype) for one in results]
