"""Adam in shuffled batches over the intervals of the data (thesis Algorithm 6).

It knows a loss of the tables of a batch, and nothing of models.
"""

from collections.abc import Callable, Iterator, Sequence
from math import sqrt
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from phsi_opt.errors import SolveError
from phsi_opt.presentation.summary import printed_table

Progress = Callable[[str], None]
Step = Callable[[Sequence[Tensor], float], None]  # down gradients, at a learning rate


class Adam:
    """Adam (Kingma and Ba 2015), with the steps of torch's.

    Vectors are short here: with torch's own a descent takes 1.4 times as long, and 3 s
    more to load.

    Args:
        parameters: tensors that require a gradient; they are moved in place.
        weight_decay: added to the gradient as weight_decay * parameter.
        relative: learning rates of the tensors, in units of the common one; None: 1.
    """

    def __init__(
        self,
        parameters: Sequence[Tensor],
        weight_decay: float = 0.0,
        relative: Sequence[float] | None = None,
    ) -> None:
        self.raw = list(map(Tensor.detach, parameters))
        self.weight_decay = weight_decay
        self.relative = relative or [1.0] * len(parameters)
        self.means = list(map(torch.zeros_like, self.raw))
        self.squares = list(map(torch.zeros_like, self.raw))
        self.steps = 0

    def step(self, gradients: Sequence[Tensor], rate: float) -> None:
        """One step down the gradients, which are used up."""
        self.steps += 1
        # Decay of the means of the gradient and of its square, as in the paper.
        first = 0.9
        second = 0.999
        towards = -rate / (1 - first**self.steps)
        unbiased = 1 / sqrt(1 - second**self.steps)
        for raw, gradient, mean, square, relative in zip(
            self.raw, gradients, self.means, self.squares, self.relative, strict=True
        ):
            if self.weight_decay:
                gradient.add_(raw, alpha=self.weight_decay)
            mean.lerp_(gradient, 1 - first)
            square.mul_(second)
            square.addcmul_(gradient, gradient, value=1 - second)
            size = square.sqrt().mul_(unbiased).add_(1e-8)
            raw.addcdiv_(mean, size, value=towards * relative)


def batches(
    tables: Sequence[Tensor], size: int, generator: torch.Generator
) -> Iterator[tuple[Tensor, ...]]:
    """The rows of the tables in a new order, ``size`` at a time."""
    order = torch.randperm(len(tables[0]), generator=generator)
    return zip(*(table[order].split(size) for table in tables), strict=True)


def descend(
    parameters: Sequence[Tensor],
    step: Step,
    loss: Callable[[Sequence[Tensor]], Tensor],
    tables: Sequence[Tensor],
    settings: Any,
    generator: torch.Generator,
    *,
    after_epoch: Callable[[int], int] | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Descend in shuffled batches (thesis Algorithm 6).

    Args:
        parameters: of the loss.
        step: such as `Adam.step`; it moves the parameters.
        loss: of the tables of a batch.
        tables: the data, the intervals along the first axis.
        settings: its ``epochs``, the size of a ``batch``, and the learning ``rate`` by
            the number of the epoch, from 1.
        generator: of the order of the intervals.
        after_epoch: such as pruning, by the number of the epoch, from 1; it returns the
            number of terms that are left. None counts all parameters.
        progress: called with a line of text every few epochs.

    Returns:
        The history: a row per epoch with epoch, loss (its mean over the batches) and
        n_terms.

    Raises:
        SolveError: when the loss is no longer finite.
    """
    n_terms = sum(map(Tensor.numel, parameters))
    history = []
    for epoch in range(1, settings.epochs + 1):
        rate = settings.rate(epoch)
        values = []
        for batch in batches(tables, settings.batch, generator):
            value = loss(batch)
            slopes = torch.autograd.grad(value, parameters, materialize_grads=True)
            step(slopes, rate)
            values.append(value.detach())
        mean = float(torch.stack(values).to(torch.float64).mean())
        if not np.isfinite(mean):
            raise SolveError(
                f"the loss is {mean} in epoch {epoch}: the descent has diverged. "
                f"Take a learning_rate below {rate:g}, "
                "or data and start in units of order one."
            )
        n_terms = after_epoch(epoch) if after_epoch is not None else n_terms
        history.append((epoch, mean, n_terms))
        is_reported = epoch % max(1, settings.epochs // 20) == 0
        if progress is not None and (is_reported or epoch == settings.epochs):
            progress(
                f"epoch {epoch} of {settings.epochs}: loss {mean:.4g}, {n_terms} terms"
            )
    return printed_table(history, columns=["epoch", "loss", "n_terms"])
