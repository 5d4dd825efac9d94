"""Adam in shuffled batches over the intervals of the data (thesis Algorithm 6).

It knows a loss of a flat vector of parameters and of the tables of a batch, and nothing
of models.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from phsi_opt.baselines.torch_defects import Table
from phsi_opt.errors import SolveError
from phsi_opt.presentation.table_making import printed_table

Progress = Callable[[str], None]
# Defaults of Adam (Kingma and Ba 2015): decay of the means of the gradient and of its
# square, and what keeps the quotient of the two finite.
MEAN_DECAY = 0.9
SQUARE_DECAY = 0.999
EPSILON = 1e-8
N_REPORTS = 20  # lines of progress in a descent


class Adam:
    """Adam (Kingma and Ba 2015) on one flat vector.

    It takes few operations per step, whatever the number of parameters.

    Args:
        flat: the parameters, which require a gradient.
        weight_decay: added to the gradient as weight_decay * parameter.
        relative: learning rates of the parameters in units of the common one; None: 1.

    Attributes:
        raw: the parameters without the graph of torch; writing here moves them.
    """

    def __init__(
        self, flat: Tensor, weight_decay: float = 0.0, relative: Tensor | None = None
    ) -> None:
        self.flat = flat
        self.raw = flat.detach()
        self.weight_decay = weight_decay
        self.relative = relative
        self.mean = torch.zeros_like(self.raw)
        self.square = torch.zeros_like(self.raw)
        # One where a parameter may move, zero where it is held; None: all may.
        self.moving: Tensor | None = None
        self.steps = 0

    def hold(self, held: Tensor) -> None:
        """Hold the parameters where ``held`` is true at what they are."""
        if bool(held.any()):
            self.moving = (~held).to(self.raw.dtype)
            self.mean.mul_(self.moving)

    def step(self, gradient: Tensor, rate: float, l1: Tensor | None = None) -> None:
        """One step down.

        Args:
            gradient: of the loss; it is used up.
            rate: the learning rate.
            l1: weights of ``|parameter|``, or None.
        """
        self.steps += 1
        if self.weight_decay:
            gradient.add_(self.raw, alpha=self.weight_decay)
        if l1 is not None:
            gradient.addcmul_(l1, self.raw.sign())
        if self.moving is not None:
            gradient.mul_(self.moving)
        self.mean.lerp_(gradient, 1 - MEAN_DECAY)
        self.square.mul_(SQUARE_DECAY)
        self.square.addcmul_(gradient, gradient, value=1 - SQUARE_DECAY)
        unbiased = 1 / sqrt(1 - SQUARE_DECAY**self.steps)
        size = self.square.sqrt().mul_(unbiased).add_(EPSILON)
        if self.relative is not None:
            size.div_(self.relative)
        towards = -rate / (1 - MEAN_DECAY**self.steps)
        self.raw.addcdiv_(self.mean, size, value=towards)


def _nothing() -> None:
    """After a step nothing needs to be done."""


def _no_weights(epoch: int) -> None:
    """L1 weights of an epoch: none."""


@dataclass(frozen=True)
class Hooks:
    """What one method of descent does otherwise than another.

    Attributes:
        rate: learning rate of an epoch, counted from 1.
        l1: L1 weights of an epoch, or None.
        after_step: such as a projection onto bounds.
        after_epoch: such as pruning; it returns the number of terms that are left.
            None counts all parameters.
    """

    rate: Callable[[int], float]
    l1: Callable[[int], Tensor | None] = _no_weights
    after_step: Callable[[], object] = _nothing
    after_epoch: Callable[[int], int] | None = None


@dataclass(frozen=True, eq=False)
class Batches:
    """The data, in batches.

    Attributes:
        tables: with the rows of every interval.
        n_intervals: number of intervals.
        size: intervals per batch.
        generator: of the order of the intervals.
    """

    tables: Sequence[Table]
    n_intervals: int
    size: int
    generator: torch.Generator

    def __len__(self) -> int:
        return -(-self.n_intervals // self.size)

    def epoch(self) -> Iterator[list[Tensor]]:
        """The intervals in a new order, ``size`` at a time.

        Tables are shuffled once, then sliced.
        """
        n = self.n_intervals
        order = torch.randperm(n, generator=self.generator)
        shuffled = []
        for table in self.tables:
            by_interval = table.values.reshape(n, -1).index_select(0, order)
            shuffled.append(by_interval.view(table.values.shape))
        for first in range(0, n, self.size):
            last = first + self.size
            batch = []
            for values, table in zip(shuffled, self.tables, strict=True):
                batch.append(values[first * table.rows : last * table.rows])
            yield batch


def descend(
    adam: Adam,
    loss: Callable[[Tensor, Sequence[Tensor]], Tensor],
    batches: Batches,
    epochs: int,
    hooks: Hooks,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Adam over shuffled batches (thesis Algorithm 6).

    Args:
        adam: the parameters and the steps.
        loss: of the parameters and the tables of a batch.
        batches: the data.
        epochs: passes over all intervals.
        hooks: learning rates, and what else happens.
        progress: called with a line of text every few epochs.

    Returns:
        The history: a row per epoch with epoch, loss (its mean over the batches) and
        n_terms.

    Raises:
        SolveError: when the loss is no longer finite.
    """
    history = []
    for epoch in range(1, epochs + 1):
        rate = hooks.rate(epoch)
        mean = _epoch(adam, loss, batches, rate, hooks.l1(epoch), hooks.after_step)
        if not np.isfinite(mean):
            raise SolveError(
                f"the loss is {mean} in epoch {epoch}: the descent has diverged. "
                f"Take a learning_rate below {rate:g}, "
                "or data and start in units of order one."
            )
        n_terms = hooks.after_epoch(epoch) if hooks.after_epoch else len(adam.flat)
        history.append((epoch, mean, n_terms))
        if progress is not None and _is_reported(epoch, epochs):
            progress(f"epoch {epoch} of {epochs}: loss {mean:.4g}, {n_terms} terms")
    return printed_table(history, columns=["epoch", "loss", "n_terms"])


def _is_reported(epoch: int, n_epochs: int) -> bool:
    return epoch % max(1, n_epochs // N_REPORTS) == 0 or epoch == n_epochs


def _epoch(
    adam: Adam,
    loss: Callable[[Tensor, Sequence[Tensor]], Tensor],
    batches: Batches,
    rate: float,
    l1: Tensor | None,
    after_step: Callable[[], object],
) -> float:
    """A step per batch; the mean of their losses."""
    total = torch.zeros((), dtype=torch.float64)
    for tables in batches.epoch():
        value = loss(adam.flat, tables)
        (gradient,) = torch.autograd.grad(value, adam.flat)
        adam.step(gradient, rate, l1)
        after_step()
        total += value.detach()
    return float(total) / len(batches)
