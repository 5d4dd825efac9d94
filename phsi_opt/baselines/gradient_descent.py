"""The thesis' own method: the PHSI loss minimised by Adam in batches, with pruning.

This is thesis Algorithm 6. The loss is that of
`phsi_opt.transcription.losses.PHSILoss`; only the way down differs. `torch_dictionary`
has the model in torch, `torch_defects` the loss, `descent` the steps.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from phsi_opt.baselines.descent import Adam, Batches, Hooks, Progress, descend
from phsi_opt.baselines.descent_settings import Descent
from phsi_opt.baselines.descent_significance import SignificanceTest
from phsi_opt.baselines.joint_force import HybridBaseline, JointForce
from phsi_opt.baselines.result import Baseline
from phsi_opt.baselines.starting_values import starting_values
from phsi_opt.baselines.torch_defects import Steps
from phsi_opt.baselines.torch_dictionary import DictionaryDynamics
from phsi_opt.baselines.torch_networks import DTYPE_OF, arrays_of
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.optimization.torch_threads import one_thread
from phsi_opt.transcription.alignment import aligned_once
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import complete_intervals

__all__ = ["Descent", "HybridBaseline", "JointForce", "gradient_descent"]


@interruptible
def gradient_descent(
    model: Model,
    data: Measurements,
    settings: Descent | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    force: JointForce | None = None,
) -> Baseline:
    """Minimise the PHSI loss by Adam with pruning (thesis Algorithm 6).

    The loss is (thesis Eq. 5.6)::

        (1/m) sum |(x1 - x0)/h - Psi|^2 + sum lambda |xi|

    Args:
        model: `PseudoHamiltonian` (PHSI) or `FirstOrder` (the thesis' BSI), with any
            dictionaries.
        data: every state measured; an interval with a missing end is left out.
        settings: see `Descent`; None takes its defaults.
        seed: of the order of the batches and of a random start.
        progress: called with a line of text every few epochs.
        force: a force by a network, trained with the rest.

    Returns:
        The model without the terms that were pruned; ``removed`` names them and
        ``loss_value`` is the loss over all data without penalties. With ``force`` a
        `HybridBaseline`.

    Raises:
        DataError: if data and model do not match.
        ModelError: for a model without parameters.
        SolveError: if the loss diverges or if the whole energy was pruned.
    """
    began = time.perf_counter()
    settings = settings or Descent()
    if not model.free and force is None:
        raise ModelError(
            "the model has no free parameter, so there is nothing to identify."
        )
    record = aligned_once(model, data)
    grid = complete_intervals(model, grid_of(record))
    with one_thread():
        run = _Run(model, grid, settings, seed, force)
        history = run.descended(progress)
        result = run.result(record.hold, history)
        return replace(result, seconds=time.perf_counter() - began)


class _Run:
    """One descent: the parameters, what is held, and what was pruned."""

    def __init__(
        self,
        model: Model,
        grid: Grid,
        settings: Descent,
        seed: int,
        force: JointForce | None,
    ) -> None:
        self.model = model
        self.grid = grid
        self.settings = settings
        self.force = force
        self.dtype = DTYPE_OF[settings.dtype]
        self.dynamics = DictionaryDynamics(model, self.dtype, force)
        self.steps = Steps(grid, settings.integrator, self.dynamics, self.dtype)
        self.generator = torch.Generator().manual_seed(seed)
        self.entries = list(model.entries.values())
        self.adam = self._adam(seed)
        self.theta = self.adam.raw[: len(self.entries)]
        self.held = np.array([e.parameter.fixed for e in self.entries], dtype=bool)
        self.removed: list[str] = []
        self.test = SignificanceTest.of(model, grid, settings)
        self._set_bounds()
        self._hold()

    def _adam(self, seed: int) -> Adam:
        """Adam on the starting values and the random weights of the network."""
        start = starting_values(self.model, self.settings, seed)
        flat = torch.tensor(start, dtype=self.dtype)
        relative = None
        if self.dynamics.network is not None:
            weights = self.dynamics.network.start(self.generator, self.dtype)
            flat = torch.cat([flat, weights])
            relative = self._relative_rates(flat, len(start))
        return Adam(flat.requires_grad_(), self.settings.weight_decay, relative)

    def _relative_rates(self, flat: Tensor, n_theta: int) -> Tensor | None:
        """Learning rates in units of the common one; None if all are the same."""
        if self.settings.force_rate is None:
            return None
        relative = torch.ones_like(flat, requires_grad=False)
        relative[n_theta:] = self.settings.force_rate / self.settings.learning_rate
        return relative

    def _set_bounds(self) -> None:
        """The bounds of the parameters that keep theirs."""
        lower = []
        upper = []
        for entry in self.entries:
            kept = entry.slot != "R" or self.settings.keep_damping_positive
            lower.append(entry.parameter.lower if kept else -np.inf)
            upper.append(entry.parameter.upper if kept else np.inf)
        self.lower = torch.tensor(lower, dtype=self.dtype)
        self.upper = torch.tensor(upper, dtype=self.dtype)

    def _hold(self) -> None:
        held = torch.zeros(len(self.adam.raw), dtype=torch.bool)
        held[: len(self.held)] = torch.tensor(self.held)
        self.adam.hold(held)
        bounded = np.isfinite(self.lower.numpy()) | np.isfinite(self.upper.numpy())
        self.projects = bool(np.any(bounded & ~self.held))

    def descended(self, progress: Progress | None) -> pd.DataFrame:
        """Descend; the history."""
        penalty = self.force.penalty if self.force else 0.0
        batches = Batches(
            self.steps.tables,
            self.steps.n_intervals,
            self.settings.batch,
            self.generator,
        )
        hooks = Hooks(
            rate=self.settings.rate,
            l1=self._l1,
            after_step=self._project,
            after_epoch=self._prune,
        )
        return descend(
            self.adam,
            lambda flat, tables: self.steps.loss(flat, tables, penalty),
            batches,
            self.settings.epochs,
            hooks,
            progress,
        )

    def _l1(self, epoch: int) -> Tensor | None:
        """Weights of ``|parameter|`` in an epoch; None if all are zero."""
        weights = dict(self.settings.l1)
        off_after = self.settings.l1_off_after
        if off_after is not None and epoch > off_after * self.settings.epochs:
            weights.pop("H", None)
        if not any(weights.values()):
            return None
        of_theta = [weights.get(e.slot, 0.0) * e.prunable for e in self.entries]
        result = torch.zeros_like(self.adam.raw)
        result[: len(self.entries)] = torch.tensor(of_theta)
        return result

    def _project(self) -> None:
        """Back into the bounds."""
        if self.projects:
            self.theta.clamp_(self.lower, self.upper)

    def _prune(self, epoch: int) -> int:
        """Hold small coefficients at zero; the number of terms that are left."""
        every = self.settings.prune_every
        first = self.settings.prune_from or 1
        if every is not None and epoch % every == 0 and epoch >= first:
            for i in range(len(self.entries)):
                if self._is_pruned(i):
                    self._remove(i)
            if self.test is not None and epoch >= self.test.first_epoch:
                self._remove_insignificant(self.test)
            self._hold()
        n_terms = sum(entry.prunable for entry in self.entries)
        return n_terms - len(self.removed)

    def _is_pruned(self, i: int) -> bool:
        entry = self.entries[i]
        may_go = entry.prunable and entry.slot in self.settings.prune_slots
        small = abs(float(self.theta[i])) < self.settings.threshold
        return may_go and small and not self.held[i]

    def _remove_insignificant(self, test: SignificanceTest) -> None:
        kept = self._kept_model()
        if not test.pruning.candidates(kept):
            return
        with torch.no_grad():
            found = self.steps.defects(self.adam.raw, self.steps.all_tables())
        weak = test.insignificant(kept, found.to(torch.float64).numpy())
        for i, entry in enumerate(self.entries):
            if entry.name in weak:
                self._remove(i)

    def _kept_model(self) -> Model:
        """The model at the values so far, without the terms that were pruned."""
        values = dict(zip(self.dynamics.names, self.theta.tolist(), strict=True))
        kept = _released(self.model, values).without(set(self.removed))
        left = {name: values[name] for name in values if name in kept.entries}
        return kept.with_values(left)

    def _remove(self, i: int) -> None:
        self.removed.append(self.entries[i].name)
        self.held[i] = True
        self.theta[i] = 0.0
        self.lower[i] = -np.inf
        self.upper[i] = np.inf

    def result(self, hold: str, history: pd.DataFrame) -> Baseline:
        """The record of what was found.

        Raises:
            SolveError: if the whole energy was pruned.
        """
        self._check_energy()
        kept = self._kept_model()
        weights = self.adam.raw[len(self.entries) :].to(torch.float64)
        scheme = self.settings.integrator
        common: dict[str, Any] = {
            "model": kept,
            "hold": hold,
            "removed": tuple(self.removed),
            "settings": str(self.settings),
            "loss_value": phsi_loss(kept, self.grid, scheme, self.force, weights),
            "history": history,
        }
        network = self.dynamics.network
        if self.force is None or network is None:
            return Baseline(method="gradient descent", **common)
        return HybridBaseline(
            method="gradient descent with a neural force",
            neural=self.force,
            layers=arrays_of(network.layers(weights.split(network.sizes))),
            **common,
        )

    def _check_energy(self) -> None:
        energy = self.model.H.terms
        if not energy:
            return
        for term in energy:
            if term.is_formula or term.coefficient_name("H") not in self.removed:
                return
        raise SolveError(
            "pruning removed every term of H: "
            f"all fell below threshold={self.settings.threshold:g}. "
            "Take a smaller threshold, prune later (prune_every) or train longer."
        )


def phsi_loss(
    model: Model,
    grid: Grid,
    scheme: str,
    force: JointForce | None = None,
    weights: Tensor | None = None,
) -> float:
    """``(1/m) sum |(x1 - x0)/h - Psi|^2`` over all intervals (thesis Eq. 5.6).

    Args:
        model: with its values.
        grid: the m intervals.
        scheme: of Psi, a name in ``phsi_opt.transcription.integrators``.
        force: a force network beside the model.
        weights: those of the network, (n_weights,), in double precision.
    """
    dynamics = DictionaryDynamics(model, torch.float64, force)
    steps = Steps(grid, scheme, dynamics, torch.float64)
    values = [model.values[name] for name in dynamics.names]
    theta = torch.tensor(values, dtype=torch.float64)
    flat = theta if weights is None else torch.cat((theta, weights))
    return float(steps.loss(flat, steps.all_tables()).detach())


def _released(model: Model, values: Mapping[str, float]) -> Model:
    """The model without the bounds of a damping that has left them.

    Otherwise the record could not hold its value.
    """
    changed = {}
    for name, terms in model.R.items():
        place = place_of("R", name)
        opened = [_opened(term, place, values) for term in terms]
        changed[name] = Dictionary(tuple(opened))
    return replace(model, R=changed)


def _opened(term: Term, place: str, values: Mapping[str, float]) -> Term:
    coefficient = term.coefficient
    if coefficient is None or coefficient.fixed:
        return term
    value = values[term.coefficient_name(place)]
    if coefficient.lower <= value <= coefficient.upper:
        return term
    free = replace(coefficient, lower=-np.inf, upper=np.inf)
    return replace(term, coefficient=free)
