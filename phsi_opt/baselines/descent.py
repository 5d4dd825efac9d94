"""Settings of a descent in shuffled batches (thesis Algorithm 6), and its result.

The descent knows a loss of the tables of a batch, not of models. Settings are made
without torch, which is imported for the first step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, pi
from typing import TYPE_CHECKING, Any

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
from phsi_opt.errors import SolveError
from phsi_opt.estimation.identified import Identified
from phsi_opt.presentation.summary import printed_table
from phsi_opt.sweeps.sweep import Progress
from phsi_opt.transcription.integrators import integrator
from phsi_opt.transcription.losses import l1_weights

if TYPE_CHECKING:
    from torch import Generator, Tensor
    from torch.optim import Optimizer

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


# ---- its result ----------------------------------------------------------------------


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


# ---- the descent -------------------------------------------------------------------


def descend(
    optimizer: "Optimizer",
    loss: Callable[[Sequence["Tensor"]], "Tensor"],
    tables: Sequence["Tensor"],
    settings: Any,
    generator: "Generator",
    *,
    after_epoch: Callable[[int], int] | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Descend in shuffled batches (thesis Algorithm 6).

    Args:
        optimizer: of the parameters of the loss. A group of them may have its own
            ``rate``, a factor on the learning rate.
        loss: of the tables of a batch.
        tables: the data, the intervals along the first axis.
        settings: its ``epochs``, the size of a ``batch``, and the learning ``rate`` by
            the number of the epoch, from 1.
        generator: of the order of the intervals.
        after_epoch: such as pruning, by the number of the epoch, from 1; it returns the
            number of terms that are left. None counts all parameters.
        progress: called with a line of text every few epochs.

    Returns:
        A row per epoch with epoch, loss (its mean over the batches) and n_terms.

    Raises:
        SolveError: when the loss is no longer finite.
    """
    import torch

    groups = optimizer.param_groups
    n_terms = sum(one.numel() for group in groups for one in group["params"])
    history = []
    for epoch in range(1, settings.epochs + 1):
        rate = settings.rate(epoch)
        for group in groups:
            group["lr"] = rate * group.get("rate", 1.0)
        values = []
        order = torch.randperm(len(tables[0]), generator=generator)
        batches = (table[order].split(settings.batch) for table in tables)
        for batch in zip(*batches, strict=True):
            optimizer.zero_grad()
            value = loss(batch)
            value.backward()
            optimizer.step()
            values.append(value.item())
        mean = float(np.mean(values))
        if not np.isfinite(mean):
            raise SolveError(
                f"the loss is {mean} in epoch {epoch}: gradient descent has diverged. "
                f"Use a learning_rate below {rate:g}, or units in which data and "
                "starting values are of order one."
            )
        if after_epoch is not None:
            n_terms = after_epoch(epoch)
        history.append((epoch, mean, n_terms))
        is_reported = epoch % max(1, settings.epochs // 20) == 0
        if progress is not None and (is_reported or epoch == settings.epochs):
            progress(
                f"epoch {epoch} of {settings.epochs}: loss {mean:.4g}, {n_terms} terms"
            )
    return printed_table(history, columns=["epoch", "loss", "n_terms"])
