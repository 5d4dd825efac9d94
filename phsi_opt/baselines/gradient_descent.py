"""The thesis' own method: the PHSI loss minimised by Adam in batches, with pruning.

This is thesis Algorithm 6. The loss is that of
`phsi_opt.transcription.losses.PHSILoss`, with its slopes by CasADi, in double
precision; only the way down differs, whose steps are in `descent`.
"""

import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.descent import Baseline, Descent, descend
from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.estimation.estimate import Pruning
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.column_function import in_rows
from phsi_opt.simulation.simulate import BufferedFunction
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.sweeps.sweep import Progress
from phsi_opt.transcription.defects import (
    defect,
    interval_arguments,
    parameter_slopes,
)
from phsi_opt.transcription.grid import aligned_once, grid_of
from phsi_opt.transcription.losses import complete_intervals

__all__ = ["Descent", "DescentRun", "gradient_descent"]


@interruptible
def gradient_descent(
    model: Model,
    data: Measurements,
    settings: Descent | None = None,
    seed: int = 0,
    progress: Progress | None = None,
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

    Returns:
        The model without the terms that were pruned; ``removed`` names them and
        ``loss_value`` is the loss over all data without penalties.

    Raises:
        DataError: if data and model do not match.
        ModelError: for a model without parameters.
        SolveError: if the loss diverges or if the whole energy was pruned.
    """
    if not model.free:
        raise ModelError(
            "the model has no free parameter, so there is nothing to identify."
        )
    with one_thread():
        return DescentRun(model, data, settings or Descent(), seed).result(progress)


class DescentRun:
    """One descent: its parameters, their bounds, and what was pruned.

    Args:
        model: whose parameters are sought.
        data: every state measured.
        settings: of the descent.
        seed: of the order of the batches and of a random start.

    Attributes:
        theta: the parameters in the order of ``model.free``.
        tables: what the loss of a batch needs of its intervals, along the first axis.
        removed: names of the terms that were pruned, in order.
    """

    def __init__(
        self, model: Model, data: Measurements, settings: Descent, seed: int
    ) -> None:
        self.began = time.perf_counter()
        self.model = model
        self.settings = settings
        record = aligned_once(model, data)
        self.hold = checked_hold(record.hold, record.inputs)
        complete = complete_intervals(model, grid_of(record))
        self.grid = complete.driven(model, model.theta)
        self.dtype: torch.dtype = getattr(torch, settings.dtype)
        columns = interval_arguments(self.grid, self.grid.y.T)
        self.tables = [torch.tensor(np.concatenate(columns).T)]
        self.generator = torch.Generator().manual_seed(seed)
        self.pruning = Pruning(settings.threshold, settings.prune_slots)
        self.removed: list[str] = []
        start = starting_values(model, settings, seed)
        self.theta = torch.tensor(start, dtype=self.dtype, requires_grad=True)
        bounds = []
        for entry in self.entries:
            bounded = entry.slot != "R" or settings.keep_damping_positive
            of_model = (entry.parameter.lower, entry.parameter.upper)
            bounds.append(of_model if bounded else (-np.inf, np.inf))
        self.lower, self.upper = torch.tensor(bounds, dtype=self.dtype).T.contiguous()
        self._keep_bounds()
        self.l1 = self._l1(epoch=1)
        self.theta.register_hook(self._with_l1)
        self.adam = torch.optim.Adam([self.theta], weight_decay=settings.weight_decay)
        self.adam.register_step_post_hook(lambda *_: self._keep_bounds())

    def loss(self, tables: Sequence[Tensor]) -> Tensor:
        """The loss of a batch, without L1."""
        rows = tables[0].numpy()
        scheme = self.settings.integrator
        theta = self.theta.detach()
        function = self.model.built(
            ("batch", scheme, len(rows)),
            lambda: in_rows(loss_and_slopes(self.model, scheme), len(rows)),
        )
        (found,) = BufferedFunction(function)(rows.T, theta.numpy())
        both = torch.tensor(found.mean(1), dtype=self.dtype)
        # The value, and for torch's derivative the slopes.
        return both[0] + both[1:] @ (self.theta - theta)

    def defects(self, kept: Model) -> np.ndarray:
        """Those of all data by the model that is kept, (n_intervals, n_states)."""
        scheme = self.settings.integrator
        return parameter_slopes(kept, self.grid, scheme, kept.theta, only=[]).d

    def weak(self, epoch: int) -> set[str]:
        """Names of the terms that pruning removes after an epoch, by their size."""
        return self.pruning.small(self.model, self.values) - set(self.removed)

    @property
    def values(self) -> dict[str, float]:
        """Every parameter by name."""
        found = zip(self.model.free, self.theta.tolist(), strict=True)
        return self.model.values | dict(found)

    @property
    def entries(self) -> list[Entry]:
        """What theta is made of."""
        return [self.model.entries[name] for name in self.model.free]

    def _l1(self, epoch: int) -> Tensor:
        """Weights of ``|parameter|`` in an epoch."""
        weights = dict(self.settings.l1)
        off_after = self.settings.l1_off_after
        if off_after is not None and epoch > off_after * self.settings.epochs:
            weights.pop("H", None)
        of_theta = [weights.get(one.slot, 0.0) * one.prunable for one in self.entries]
        return torch.tensor(of_theta, dtype=self.dtype)

    def _with_l1(self, slopes: Tensor) -> Tensor:
        return slopes.addcmul(self.l1, self.theta.detach().sign())

    def _keep_bounds(self) -> None:
        self.theta.detach().clamp_(self.lower, self.upper)

    def after_epoch(self, epoch: int) -> int:
        """Prune, if it is time; the number of terms that are left."""
        every = self.settings.prune_every
        first = self.settings.prune_from or 1
        if every is not None and epoch % every == 0 and epoch >= first:
            self.remove(self.weak(epoch))
        self.l1 = self._l1(epoch + 1)
        n_terms = sum(entry.prunable for entry in self.model.entries.values())
        return n_terms - len(self.removed)

    def remove(self, names: Iterable[str]) -> None:
        """Hold these terms at zero for good."""
        places = sorted(map(self.model.free.index, names))
        self.removed += [self.model.free[i] for i in places]
        for values in (self.theta.detach(), self.lower, self.upper):
            values[places] = 0.0

    def kept(self) -> Model:
        """The model at the values so far, without the terms that were pruned."""
        values = self.values
        outside = []  # damping that left its bounds
        for one in self.entries:
            is_within = one.parameter.lower <= values[one.name] <= one.parameter.upper
            if one.slot == "R" and not is_within:
                outside.append(one.name)
        released = self.model.with_parameters(
            lambda _, one: replace(one, lower=-np.inf, upper=np.inf), outside
        )
        kept = released.without(set(self.removed))
        return kept.with_values({name: values[name] for name in kept.entries})

    def result(self, progress: Progress | None = None) -> Baseline:
        """Descend; the record of what was found.

        Raises:
            SolveError: if the loss diverges or if the whole energy was pruned.
        """
        history = descend(
            self.adam,
            self.loss,
            self.tables,
            self.settings,
            self.generator,
            after_epoch=self.after_epoch,
            progress=progress,
        )
        names = {term.parameter_name("H") for term in self.model.H}
        if names and names <= set(self.removed):
            raise SolveError(
                "pruning removed every term of H: all fell below "
                f"threshold={self.settings.threshold:g}. Use a smaller threshold, "
                "prune later (prune_every) or train longer."
            )
        kept = self.kept()
        return Baseline(
            model=kept,
            hold=self.hold,
            loss_value=float(np.sum(self.defects(kept) ** 2)) / self.grid.n_intervals,
            seconds=time.perf_counter() - self.began,
            removed=tuple(self.removed),
            method="gradient descent",
            history=history,
            settings=str(self.settings),
        )


def loss_and_slopes(model: Model, scheme: str) -> ca.Function:
    """CasADi function (interval, theta) -> loss and its slopes, (1 + n_free,)."""
    function = defect(model, scheme)
    *interval, theta = argument_symbols(function)
    loss = ca.sumsqr(function(*interval, theta))
    (both,) = ca.cse([ca.vertcat(loss, ca.gradient(loss, theta))])
    return ca.Function("one", [ca.vertcat(*interval), theta], [ca.densify(both)])


# ---- where it starts (thesis appendix B, Section 5.1) -------------------------------

# Of coefficients (appendix B, the thesis' code); frequencies as those of functions.
THESIS_STARTS = {"polynomial": 0.2, "function": 1.0, "damping": 0.0}


def starting_values(model: Model, settings: Descent, seed: int) -> np.ndarray:
    """Where the descent starts, (n_free,), in the order of ``model.free``."""
    rng = np.random.default_rng(seed)
    of_thesis = _thesis_starts(model)
    values = []
    for name, entry in model.entries.items():
        # Thesis Section 5.1; drawn for given values too.
        draw = rng.normal(scale=0.5)
        parameter = entry.parameter
        # Of a formula or inside a term.
        is_known = parameter.value is not None and not entry.prunable
        value = of_thesis.get(name, THESIS_STARTS["function"])
        if settings.start == "model" or is_known:
            value = parameter.start
        elif settings.start == "normal":
            # At a bound of zero nothing would move.
            is_size = parameter.lower == 0 and entry.slot != "R"
            value = abs(draw) if is_size else draw
        if not parameter.fixed:
            values.append(value)
    return np.array(values)


def _thesis_starts(model: Model) -> dict[str, float]:
    """Start of every coefficient by the kind of its term."""
    factors = {*model.states, *model.inputs, "t", "1"}
    starts = {}
    for placed in model.placed():
        without_powers = re.sub(r"\s|\*\*[1-9]\d*", "", placed.term.body)
        is_monomial = set(without_powers.split("*")) <= factors
        kind = "polynomial" if is_monomial else "function"
        if placed.slot == "R":
            kind = "damping"
        if not placed.term.is_formula:
            starts[placed.parameter_name()] = THESIS_STARTS[kind]
    return starts
