"""The thesis' own method: the PHSI loss minimised by Adam in batches, with pruning.

This is thesis Algorithm 6. The loss is that of
`phsi_opt.transcription.losses.PHSILoss`, with its slopes by CasADi, in double
precision; only the way down differs. torch is imported when a descent begins.
"""

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import cos, pi
from operator import attrgetter
from typing import NamedTuple

import casadi as ca
import numpy as np
import pandas as pd

from phsi_opt.arguments import (
    is_size,
    require,
    require_choice,
    require_count,
    require_positive,
    require_size,
)
from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.estimation.estimate import Pruning
from phsi_opt.estimation.identified import Identified
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.column_function import in_rows
from phsi_opt.presentation.summary import printed_table
from phsi_opt.simulation.simulate import BufferedFunction
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.defects import (
    defect,
    interval_arguments,
    parameter_slopes,
)
from phsi_opt.transcription.grid import Grid, aligned_once, grid_of
from phsi_opt.transcription.integrators import integrator
from phsi_opt.transcription.losses import complete_intervals, l1_weights

__all__ = ["Baseline", "Descent", "gradient_descent"]

CHOICES = {
    "decay": ("none", "cosine"),
    "start": ("thesis", "normal", "model"),
    "dtype": ("float32", "float64"),
}


@dataclass(frozen=True)
class Descent:
    """How to descend (thesis Algorithm 6 and appendix B).

    Args:
        learning_rate: of Adam.
        epochs: passes over the data.
        batch: samples per step.
        decay: "none", or "cosine": the learning rate falls along half a cosine to
            (almost) zero in the last epoch.
        prune_every: after every so many epochs, coefficients below ``threshold`` in
            size, of ``prune_slots``, become zero for good; None never prunes.
        prune_from: epoch before which nothing is pruned (the thesis' code: twice
            ``prune_every``); None begins with the first ``prune_every``.
        threshold: least magnitude of a coefficient that stays.
        prune_slots: slots in which terms are pruned.
        weight_decay: added to the gradient as weight_decay * parameter.
        l1: lambda of ``|xi|`` per slot, such as {"H": 0.1, "F": 0.01}.
        l1_off_after: share of the epochs after which that of H is off (the thesis'
            code: half); None keeps it.
        integrator: a name in ``phsi_opt.transcription.integrators``.
        start: "thesis" (0.2 for polynomials, 1 for other functions and their
            frequencies, 0 for damping: appendix B and the thesis' code), "normal" (N(0,
            0.5^2), thesis Section 5.1) or "model" (the values of the model, zero where
            it has none). Values that a model gives to formulas and to inner parameters
            are kept.
        dtype: "float64", or "float32" as the thesis has it.
        keep_damping_positive: keep the bounds of R; the thesis lets it go negative.
            Other bounds are always kept, by projection after each step.

    Raises:
        ModelError: if a setting is not possible.
    """

    learning_rate: float = 3e-3
    epochs: int = 60
    batch: int = 32
    decay: str = "none"
    prune_every: int | None = 5
    prune_from: int | None = None
    threshold: float = 0.05
    prune_slots: tuple[str, ...] = ("H", "F")
    weight_decay: float = 0.0
    l1: Mapping[str, float] = field(default_factory=dict)
    l1_off_after: float | None = 0.5
    integrator: str = "srk4"
    start: str = "thesis"
    dtype: str = "float64"
    keep_damping_positive: bool = False

    def __post_init__(self) -> None:
        require_positive("learning_rate", self.learning_rate)
        for name in ("epochs", "batch", "prune_every", "prune_from"):
            if not (name.startswith("prune") and getattr(self, name) is None):
                require_count(name, getattr(self, name))
        for name in ("weight_decay", "threshold"):
            require_size(name, getattr(self, name))
        for name, choices in CHOICES.items():
            require_choice(name, getattr(self, name), choices)
        integrator(self.integrator)
        known = set(self.prune_slots) <= {"H", "R", "F"}
        expected = "slots among 'H', 'R' and 'F'"
        require(known, "prune_slots", self.prune_slots, expected)
        share = self.l1_off_after
        fine = share is None or (is_size(share) and share <= 1)
        expected = "a share of the epochs between 0 and 1, or None"
        require(fine, "l1_off_after", share, expected)
        object.__setattr__(self, "l1", l1_weights(self.l1))
        object.__setattr__(self, "prune_slots", tuple(self.prune_slots))

    def rate(self, epoch: int) -> float:
        """Learning rate in an epoch, counted from 1."""
        if self.decay == "none":
            return self.learning_rate
        return self.learning_rate * (1 + cos(pi * ((epoch - 1) / self.epochs))) / 2

    def prunes(self, epoch: int) -> bool:
        """Whether terms go after an epoch, counted from 1."""
        if self.prune_every is None or epoch < (self.prune_from or 1):
            return False
        return epoch % self.prune_every == 0

    def l1_in(self, epoch: int) -> dict[str, float]:
        """Weights of ``|xi|`` per slot in an epoch, counted from 1."""
        weights = dict(self.l1)
        if self.l1_off_after is not None and epoch > self.l1_off_after * self.epochs:
            weights.pop("H", None)
        return weights


@dataclass(frozen=True, eq=False, kw_only=True)
class Baseline(Identified):
    """A model found by another method, with everything that `Identified` can do.

    Attributes:
        method: name of the method, such as "gradient descent".
        loss_value: the method's own loss over all its data at the result, without its
            penalties; NaN if it has none.
        history: a row per epoch with at least epoch, loss and n_terms; empty for a
            method without epochs.
        settings: the settings that were used, as text.
    """

    method: str
    loss_value: float = float("nan")
    history: pd.DataFrame = field(default_factory=pd.DataFrame)
    settings: str = ""

    def __str__(self) -> str:
        head = f"{self.method}: loss {self.loss_value:.6g}, {self.seconds:.3g} s"
        lines = [head, *self.equations()]
        if self.removed:
            lines.append(f"removed: {', '.join(self.removed)}")
        return "\n".join(lines)


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
    import torch  # noqa: F401, before the clock starts

    began = time.perf_counter()
    settings = settings or Descent()
    record = aligned_once(model, data)
    complete = complete_intervals(model, grid_of(record))
    grid = complete.driven(model, model.theta)
    with one_thread():
        found = _descended(model, grid, settings, seed, progress or silent)
    names = {term.parameter_name("H") for term in model.H}
    if names and names <= set(found.removed):
        raise SolveError(
            "pruning removed every term of H: all fell below "
            f"threshold={settings.threshold:g}. Use a smaller threshold, "
            "prune later (prune_every) or train longer."
        )
    kept = _kept(model, found)
    d = parameter_slopes(kept, grid, settings.integrator, kept.theta, only=[]).d
    return Baseline(
        model=kept,
        hold=checked_hold(record.hold, record.inputs),
        loss_value=float(np.sum(d**2)) / grid.n_intervals,
        seconds=time.perf_counter() - began,
        removed=tuple(found.removed),
        method="gradient descent",
        history=found.history,
        settings=str(settings),
    )


class _Descended(NamedTuple):
    """Where a descent ended."""

    values: dict[str, float]  # of every parameter, zero of what was pruned
    removed: list[str]  # names of the terms that were pruned, in order
    history: pd.DataFrame  # as that of a `Baseline`


def _descended(
    model: Model, grid: Grid, settings: Descent, seed: int, say: Progress
) -> _Descended:
    """Descend in shuffled batches of intervals.

    Raises:
        SolveError: when the loss is no longer finite.
    """
    import torch

    dtype: torch.dtype = getattr(torch, settings.dtype)
    rows = np.concatenate(interval_arguments(grid, grid.y.T)).T
    entries = list(map(model.entries.__getitem__, model.free))
    bounds = []
    for entry in entries:
        bounded = entry.slot != "R" or settings.keep_damping_positive
        of_model = (entry.parameter.lower, entry.parameter.upper)
        bounds.append(of_model if bounded else (-np.inf, np.inf))
    lower, upper = torch.tensor(bounds, dtype=dtype).T.contiguous()
    theta = torch.tensor(starting_values(model, settings, seed), dtype=dtype)
    theta.clamp_(lower, upper)
    adam = torch.optim.Adam([theta], weight_decay=settings.weight_decay)
    generator = torch.Generator().manual_seed(seed)
    pruning = Pruning(settings.threshold, settings.prune_slots)
    n_terms = sum(map(attrgetter("prunable"), model.entries.values()))
    found = model.values
    removed: list[str] = []
    history = []
    for epoch in range(1, settings.epochs + 1):
        adam.param_groups[0]["lr"] = settings.rate(epoch)
        by_slot = settings.l1_in(epoch)
        weights = [by_slot.get(one.slot, 0.0) * one.prunable for one in entries]
        l1 = torch.tensor(weights, dtype=dtype)
        losses = []
        order = torch.randperm(len(rows), generator=generator)
        for batch in order.split(settings.batch):
            known = (model, settings.integrator, rows[batch.numpy()], theta.numpy())
            loss_and_slopes = torch.tensor(mean_loss(*known), dtype=dtype)
            theta.grad = loss_and_slopes[1:].addcmul(l1, theta.sign())
            adam.step()
            theta.clamp_(lower, upper)
            losses.append(loss_and_slopes[0].item())
        mean = float(np.mean(losses))
        if not np.isfinite(mean):
            raise SolveError(
                f"the loss is {mean} in epoch {epoch}: gradient descent has diverged. "
                f"Use a learning_rate below {settings.rate(epoch):g}, or units in "
                "which data and starting values are of order one."
            )
        found |= zip(model.free, theta.tolist(), strict=True)
        if settings.prunes(epoch):
            small = pruning.small(model, found).difference(removed)
            for place in sorted(map(model.free.index, small)):
                removed.append(model.free[place])
                found[model.free[place]] = 0.0
                for one in (theta, lower, upper):  # for good
                    one[place] = 0.0
        n_left = n_terms - len(removed)
        history.append((epoch, mean, n_left))
        if epoch % max(1, settings.epochs // 20) == 0 or epoch == settings.epochs:
            say(f"epoch {epoch} of {settings.epochs}: loss {mean:.4g}, {n_left} terms")
    table = printed_table(history, columns=["epoch", "loss", "n_terms"])
    return _Descended(found, removed, table)


def _kept(model: Model, found: _Descended) -> Model:
    """The model with the values that were found, without the terms that were pruned."""
    outside = []  # damping that left its bounds
    for name in model.free:
        entry = model.entries[name]
        one = entry.parameter
        if entry.slot == "R" and not one.lower <= found.values[name] <= one.upper:
            outside.append(name)
    released = model.with_parameters(
        lambda _, one: replace(one, lower=-np.inf, upper=np.inf), outside
    )
    kept = released.without(set(found.removed))
    return kept.with_values({name: found.values[name] for name in kept.entries})


def mean_loss(
    model: Model, scheme: str, rows: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Mean of the loss and of its slopes over a batch of intervals, (1 + n_free,).

    Args:
        model: whose parameters are sought.
        scheme: the integrator.
        rows: (n_intervals, n) what the loss needs of each interval.
        theta: (n_free,) the parameters.
    """
    n = len(rows)
    function = model.built(
        ("batch", scheme, n), lambda: in_rows(_loss_and_slopes(model, scheme), n)
    )
    (found,) = BufferedFunction(function)(rows.T, theta)
    return np.asarray(found.mean(1))


def _loss_and_slopes(model: Model, scheme: str) -> ca.Function:
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
