"""The thesis' own method: the PHSI loss minimised by Adam in batches, with pruning
(thesis Algorithm 6).

The loss is that of `phsi_opt.losses.PHSILoss`; only the way down differs.
`torch_dictionary` has the model in torch, `torch_steps` the defects and the descent.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from phsi_opt.baselines.descent_settings import DTYPES, Descent, JointForce
from phsi_opt.baselines.network_simulation import input_of, integrated, network_values
from phsi_opt.baselines.result import Baseline
from phsi_opt.baselines.torch_dictionary import DictionaryDynamics, monomial
from phsi_opt.baselines.torch_steps import Adam, Progress, Steps, descend
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError, SolveError
from phsi_opt.model.model import Model
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.optimization.torch_threads import one_thread
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import complete_intervals

__all__ = ["Descent", "HybridBaseline", "JointForce", "gradient_descent"]
POLYNOMIAL_START, FUNCTION_START, NORMAL_START = 0.2, 1.0, 0.5


def gradient_descent(
    model: Model,
    data: Measurements,
    settings: Descent | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    force: JointForce | None = None,
) -> Baseline:
    """Minimise (1/m) sum |(x1 - x0)/h - Psi|^2 + sum lambda |xi| by Adam with pruning
    (thesis Eq. 5.6, Algorithm 6).

    Args:
        model: `PseudoHamiltonian` (PHSI) or `FirstOrder` (the thesis' BSI), with any
            dictionaries.
        data: every state measured; an interval with a missing end is left out.
        settings: see `Descent`; None takes its defaults. seed: of the order of the
            batches and of a random start.
        progress: called with a line of text every few epochs.
        force: a force by a network, trained with the rest; the result is then a
            `HybridBaseline`.

    Terms that were pruned are not in the model of the result; ``removed`` names them.
    Its ``loss_value`` is the loss over all data without penalties. Raises `DataError`
    if data and model do not match, `ModelError` for a model without parameters,
    `SolveError` if the loss diverges or if the whole energy was pruned.
    """
    began = time.perf_counter()
    settings = settings or Descent()
    if not model.free and force is None:
        raise ModelError(
            "the model has no free parameter, so there is nothing to identify."
        )
    record = aligned(model, data)
    grid = complete_intervals(model, grid_of(record))
    with one_thread():
        task = _Task(model, grid, settings, seed, force)
        history = task.run(progress)
        result = task.result(record.hold, history)
        return replace(result, seconds=time.perf_counter() - began)


class _Task:
    """One descent: the parameters, what is held, and what was pruned."""

    def __init__(
        self,
        model: Model,
        grid: Grid,
        settings: Descent,
        seed: int,
        force: JointForce | None,
    ) -> None:
        self.model, self.grid, self.settings, self.force = model, grid, settings, force
        self.dtype = DTYPES[settings.dtype]
        self.dynamics = DictionaryDynamics(model, self.dtype, force)
        self.steps = Steps(grid, settings.integrator, self.dynamics, self.dtype)
        self.generator = torch.Generator().manual_seed(seed)
        self.entries = list(model.entries.values())
        theta = torch.tensor(starting_values(model, settings, seed), dtype=self.dtype)
        network = self.dynamics.network
        weights: list[Tensor] = (
            [network.start(self.generator, self.dtype)] if network else []
        )
        flat = torch.cat([theta, *weights]).requires_grad_()
        relative = None
        if network and settings.force_rate is not None:
            relative = torch.ones_like(flat, requires_grad=False)
            relative[len(theta) :] = settings.force_rate / settings.learning_rate
        self.adam = Adam(flat, settings.weight_decay, relative)
        self.theta = self.adam.raw[: len(self.entries)]
        self.held = np.array([e.parameter.fixed for e in self.entries], dtype=bool)
        self.removed: list[str] = []
        self._bound()
        self._hold()

    def _bound(self) -> None:
        kept = [
            e.slot != "R" or self.settings.keep_damping_positive for e in self.entries
        ]
        bounds = [(e.parameter.lower, e.parameter.upper) for e in self.entries]
        self.lower, self.upper = (
            torch.tensor(
                [b[i] if k else free for b, k in zip(bounds, kept, strict=True)],
                dtype=self.dtype,
            )
            for i, free in ((0, -np.inf), (1, np.inf))
        )

    def _hold(self) -> None:
        held = torch.zeros(len(self.adam.raw), dtype=torch.bool)
        held[: len(self.held)] = torch.tensor(self.held)
        self.adam.hold(held)
        bounded = np.isfinite(self.lower.numpy()) | np.isfinite(self.upper.numpy())
        self.projects = bool(np.any(bounded & ~self.held))

    def run(self, progress: Progress | None) -> pd.DataFrame:
        penalty = self.force.penalty if self.force else 0.0
        return descend(
            self.adam,
            lambda flat, tables: self.steps.loss(flat, tables, penalty),
            self.steps.arrays,
            self.steps.n_intervals,
            self.settings,
            self.generator,
            rate=self.settings.rate,
            l1=self._l1,
            after_step=self._project,
            after_epoch=self._prune,
            progress=progress,
        )

    def _l1(self, epoch: int) -> Tensor | None:
        weights, off = dict(self.settings.l1), self.settings.l1_off_after
        if off is not None and epoch > off * self.settings.epochs:
            weights.pop("H", None)
        if not any(weights.values()):
            return None
        result = torch.zeros_like(self.adam.raw)
        result[: len(self.entries)] = torch.tensor(
            [weights.get(e.slot, 0.0) * e.prunable for e in self.entries]
        )
        return result

    def _project(self) -> None:
        if self.projects:
            self.theta.clamp_(self.lower, self.upper)

    def _prune(self, epoch: int) -> int:
        every, first = self.settings.prune_every, self.settings.prune_from or 1
        if every is not None and epoch % every == 0 and epoch >= first:
            for i, entry in enumerate(self.entries):
                small = abs(float(self.theta[i])) < self.settings.threshold
                if (
                    entry.prunable
                    and entry.slot in self.settings.prune_slots
                    and small
                    and not self.held[i]
                ):
                    self.removed.append(entry.name)
                    self.held[i], self.theta[i], self.lower[i], self.upper[i] = (
                        True,
                        0.0,
                        -np.inf,
                        np.inf,
                    )
            self._hold()
        return sum(e.prunable for e in self.entries) - len(self.removed)

    def result(self, hold: str, history: pd.DataFrame) -> Baseline:
        values = dict(zip(self.dynamics.names, self.theta.tolist(), strict=True))
        if self.model.H.terms and all(
            not t.is_formula and t.coefficient_name("H") in self.removed
            for t in self.model.H
        ):
            raise SolveError(
                f"pruning removed every term of H: all fell below threshold={self.settings.threshold:g}. Take a "
                "smaller threshold, prune later (prune_every) or train longer."
            )
        kept = _released(self.model, values).without(set(self.removed))
        kept = kept.with_values(
            {name: value for name, value in values.items() if name in kept.entries}
        )
        network = self.adam.raw[len(self.entries) :].to(torch.float64)
        common: dict[str, Any] = {
            "model": kept,
            "hold": hold,
            "removed": tuple(self.removed),
            "settings": str(self.settings),
            "loss_value": phsi_loss(
                kept, self.grid, self.settings.integrator, self.force, network
            ),
            "history": history,
        }
        if self.force is None:
            return Baseline(method="gradient descent", **common)
        assert self.dynamics.network is not None
        layers = self.dynamics.network.layers(
            network.split(self.dynamics.network.sizes)
        )
        arrays = tuple(
            (weight.numpy().copy(), bias.numpy().copy()) for weight, bias in layers
        )
        return HybridBaseline(
            method="gradient descent with a neural force",
            neural=self.force,
            layers=arrays,
            **common,
        )


def phsi_loss(
    model: Model,
    grid: Grid,
    scheme: str,
    force: JointForce | None = None,
    network: Tensor | None = None,
) -> float:
    """(1/m) sum |(x1 - x0)/h - Psi|^2 over all intervals at the model's values, in
    double precision (Eq. 5.6).
    """
    dynamics = DictionaryDynamics(model, torch.float64, force)
    steps = Steps(grid, scheme, dynamics, torch.float64)
    theta = torch.tensor(
        [model.values[name] for name in dynamics.names], dtype=torch.float64
    )
    flat = theta if network is None else torch.cat((theta, network))
    return float(steps.loss(flat, steps.all_tables()).detach())


def starting_values(model: Model, settings: Descent, seed: int) -> np.ndarray:
    """Where the descent starts, a value per parameter in the order of
    ``model.entries``; see `Descent`.
    """
    rng, entries = np.random.default_rng(seed), model.entries
    variables = (*model.states, *model.inputs, "t")
    kind: dict[str, float] = {}
    for slot, equation, term in model.placed():
        if not term.is_formula:
            polynomial = not term.inner and monomial(term.body, variables) is not None
            value = (
                0.0
                if slot == "R"
                else POLYNOMIAL_START
                if polynomial
                else FUNCTION_START
            )
            kind[term.coefficient_name(place_of(slot, equation))] = value
    values = []
    for name, entry in entries.items():
        parameter, draw = entry.parameter, NORMAL_START * rng.normal()
        given = parameter.fixed or (parameter.value is not None and not entry.prunable)
        if given or settings.start == "model":
            values.append(parameter.start)
            continue
        # A number that may not be negative starts at the size of the draw: at its bound
        # of zero nothing would move.
        drawn = abs(draw) if parameter.lower == 0 and entry.slot != "R" else draw
        value = drawn if settings.start == "normal" else kind.get(name, FUNCTION_START)
        free = entry.slot == "R" and not settings.keep_damping_positive
        values.append(
            value if free else float(np.clip(value, parameter.lower, parameter.upper))
        )
    return np.array(values)


def _released(model: Model, values: Mapping[str, float]) -> Model:
    """The model without the bounds of a damping that has left them, or the record could
    not hold its value.
    """

    def opened(term: Term, place: str) -> Term:
        coefficient = term.coefficient
        if coefficient is None:
            return term
        value = values[term.coefficient_name(place)]
        if (
            not coefficient.lower <= value <= coefficient.upper
            and not coefficient.fixed
        ):
            coefficient = replace(coefficient, lower=-np.inf, upper=np.inf)
        return replace(term, coefficient=coefficient)

    changed = {
        name: Dictionary(tuple(opened(term, place_of("R", name)) for term in terms))
        for name, terms in model.R.items()
    }
    return replace(model, R=changed)


# ---- the hybrid's result ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class HybridBaseline(Baseline):
    """dx/dt = dictionary model + force network in the equations of ``neural`` (the
    thesis' hybrid, Section 6.4).

    ``model``, its tables and `sympy` hold the dictionary part alone; `simulate` and
    `equations` know both.
    """

    neural: JointForce
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    def force(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """The network's force (n, n_equations) at states x (n, n_states), times t (n,)
        and inputs u (n, n_inputs).
        """
        states = np.atleast_2d(np.asarray(x, dtype=float))
        if states.ndim != 2 or states.shape[1] != self.model.n_states:
            raise DataError(
                f"x has shape {np.shape(x)}; expected (n, {self.model.n_states}), a column per state."
            )
        known: dict[str, Any] = dict(zip(self.model.states, states.T, strict=True))
        known["t"] = t
        known.update(
            zip(
                self.model.inputs,
                [None] * self.model.n_inputs if u is None else np.atleast_2d(u).T,
                strict=True,
            )
        )
        for name in self.neural.variables:
            if known[name] is None:
                raise DataError(
                    f"the force depends on {name!r}; give {'t' if name == 't' else 'u'} beside x."
                )
        v = np.stack(
            [
                np.broadcast_to(known[name], len(states))
                for name in self.neural.variables
            ],
            1,
        )
        return network_values(self.layers, v, self.neural.first)

    def without_force(self) -> Baseline:
        """The dictionary model alone; its loss is not that of the training and is left
        NaN.
        """
        return Baseline(
            model=self.model,
            hold=self.hold,
            seconds=self.seconds,
            removed=self.removed,
            history=self.history,
            settings=self.settings,
            method=f"{self.method}, left out",
        )

    def equations(self) -> list[str]:
        """The right-hand sides, the network by the name ``network``."""
        inside = ", ".join(self.neural.variables)
        return [
            f"{text} + network_{name}({inside})"
            if name in self.neural.equations
            else text
            for name, text in zip(self.model.states, super().equations(), strict=True)
        ]

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0] with the network's force; u is
        (n_samples, n_inputs).
        """
        f, rows = (
            self.casadi(),
            [self.model.index(name) for name in self.neural.equations],
        )
        at = input_of(np.asarray(t, dtype=float), u, self.model.n_inputs, self.hold)

        def rhs(time: float, x: np.ndarray) -> np.ndarray:
            now = at(time)
            dx = np.array(f(x, now, time)).ravel()
            dx[rows] += self.force(x[None, :], time, now[None, :])[0]
            return dx

        return integrated(rhs, t, x0, self.model.states)
