"""Adam in batches over the defects of a scheme (thesis Algorithm 6).

The loss is that of `phsi_opt.losses.PHSILoss`; only the way down differs. Where a
scheme evaluates the right-hand side at the data alone, its monomials are computed once
for the whole data set.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, Protocol

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from phsi_opt.errors import SolveError
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import integrator, srk4_one_way

Progress = Callable[[str], None]
BETAS, EPSILON = (0.9, 0.999), 1e-8  # of Adam


class Evaluation(Protocol):
    """A right-hand side at given parameters."""

    @property
    def forces(self) -> list[Tensor]:
        """What the force network gave so far."""

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        """dx/dt, (n_rows, n_states)."""


class Dynamics(Protocol):
    """What `Steps` needs of a right-hand side; z are the columns ``outside`` of
    (inputs, t).
    """

    outside: list[int]

    def features(self, x: Tensor, z: Tensor | None) -> Tensor | None:
        """What can be computed once where x is data."""

    def at(self, flat: Tensor) -> Evaluation:
        """The right-hand side at the parameters."""


# ---- the defects of a batch ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Call:
    """One evaluation of the right-hand side by a scheme: where its inputs and its
    features are kept, if they are.
    """

    outside: int | None
    features: int | None


class Steps:
    """Defects (x1 - x0)/h - Psi of intervals, for any scheme of `phsi_opt.integrators`.

    ``arrays`` are pairs of a table and its rows per interval; ``defects(flat, tables)``
    are those of a batch, (n_intervals, n_states). A first run of the scheme over all
    data finds the evaluations at the data alone.
    """

    def __init__(
        self, grid: Grid, scheme: str, dynamics: Dynamics, dtype: torch.dtype
    ) -> None:
        self.dynamics, self.n_intervals, self.n_states = (
            dynamics,
            grid.n_intervals,
            grid.y.shape[1],
        )
        self.both_ways = scheme == "srk4"
        self.psi = srk4_one_way if self.both_ways else integrator(scheme).psi
        rows = 2 if self.both_ways else 1
        end = grid.begin + 1
        x0, x1, h, t0 = (
            grid.y[grid.begin],
            grid.y[end],
            grid.h[:, None],
            grid.t[grid.begin][:, None],
        )

        def table(forth: np.ndarray, back: np.ndarray) -> np.ndarray:
            return (
                np.stack((forth, back), 1).reshape(len(forth) * 2, -1)
                if self.both_ways
                else forth
            )

        self._x0, self._x1, self._h = table(x0, x1), table(x1, x0), table(h, -h)
        ends = (np.hstack((grid.u0, t0)), np.hstack((grid.u1, t0 + h)))
        self._z0, self._z1 = (
            table(*ends)[:, dynamics.outside],
            table(*ends[::-1])[:, dynamics.outside],
        )
        made = [
            torch.tensor(a, dtype=dtype)
            for a in (grid.rates(grid.y), self._x0, self._x1, self._h)
        ]
        self.arrays: list[tuple[Tensor, int]] = [
            (made[0], 1),
            *((table, rows) for table in made[1:]),
        ]
        self.calls: list[_Call] = []
        self.psi(self._record, *made[1:])

    def _record(self, x: Tensor, c: float) -> Tensor:
        rows = self.arrays[1][1]
        z, outside, kept = None, None, None
        if self.dynamics.outside:
            outside, z = (
                len(self.arrays),
                torch.tensor(self._z0 + c * (self._z1 - self._z0), dtype=x.dtype),
            )
            self.arrays.append((z, rows))
        if not x.requires_grad:
            features = self.dynamics.features(x, z)
            if features is not None:
                kept = len(self.arrays)
                self.arrays.append((features, rows))
        self.calls.append(_Call(outside, kept))
        return torch.zeros_like(x).requires_grad_()

    def all_tables(self) -> list[Tensor]:
        """The tables of all intervals."""
        return [table for table, _ in self.arrays]

    def defects(
        self, flat: Tensor, tables: Sequence[Tensor]
    ) -> tuple[Tensor, list[Tensor]]:
        """Defects of a batch (n_intervals, n_states), and what the force network gave."""
        calls, f = iter(self.calls), self.dynamics.at(flat)

        def g(x: Tensor, c: float) -> Tensor:
            call = next(calls)
            z = None if call.outside is None else tables[call.outside]
            return f(x, z, None if call.features is None else tables[call.features])

        rate, x0, x1, h = tables[:4]
        psi = self.psi(g, x0, x1, h)
        return rate - (
            psi.view(-1, 2, self.n_states).mean(1) if self.both_ways else psi
        ), f.forces

    def loss(
        self, flat: Tensor, tables: Sequence[Tensor], penalty: float = 0.0
    ) -> Tensor:
        """(1/b) sum |defect|^2, plus ``penalty`` times the mean of |F| of the force
        network.
        """
        d, forces = self.defects(flat, tables)
        value = d.square().sum() / d.shape[0]
        return (
            value + penalty * forces[-1].abs().mean() if penalty and forces else value
        )


# ---- descent ---------------------------------------------------------------------------------------------------------


class Adam:
    """Adam (Kingma and Ba 2015) on one flat vector: few operations per step, whatever
    the number of parameters.

    ``moving`` is one where a parameter may move, zero where it is held. ``relative``
    are learning rates of the parameters in units of the common one.
    """

    def __init__(
        self, flat: Tensor, weight_decay: float = 0.0, relative: Tensor | None = None
    ) -> None:
        self.relative = relative
        self.flat, self.raw, self.weight_decay = flat, flat.detach(), weight_decay
        self.mean, self.square = torch.zeros_like(self.raw), torch.zeros_like(self.raw)
        self.moving: Tensor | None = None
        self.steps = 0

    def hold(self, held: Tensor) -> None:
        """Hold the parameters where ``held`` is true at what they are."""
        if bool(held.any()):
            self.moving = (~held).to(self.raw.dtype)
            self.mean.mul_(self.moving)

    def step(self, gradient: Tensor, rate: float, l1: Tensor | None = None) -> None:
        """One step down; ``l1`` are the weights of |parameter|. The gradient is used
        up.
        """
        self.steps += 1
        if self.weight_decay:
            gradient.add_(self.raw, alpha=self.weight_decay)
        if l1 is not None:
            gradient.addcmul_(l1, self.raw.sign())
        if self.moving is not None:
            gradient.mul_(self.moving)
        self.mean.lerp_(gradient, 1 - BETAS[0])
        self.square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
        size = (
            self.square.sqrt().mul_(1 / sqrt(1 - BETAS[1] ** self.steps)).add_(EPSILON)
        )
        if self.relative is not None:
            size.div_(self.relative)
        self.raw.addcdiv_(self.mean, size, value=-rate / (1 - BETAS[0] ** self.steps))


def batches(
    arrays: Sequence[tuple[Tensor, int]], n: int, size: int, generator: torch.Generator
) -> Iterator[list[Tensor]]:
    """One epoch: the intervals in a new order, ``size`` at a time; tables are shuffled
    once, then sliced.
    """
    order = torch.randperm(n, generator=generator)
    shuffled = [
        (table.reshape(n, -1).index_select(0, order).view(table.shape), rows)
        for table, rows in arrays
    ]
    for first in range(0, n, size):
        yield [table[first * rows : (first + size) * rows] for table, rows in shuffled]


def descend(
    adam: Adam,
    loss: Callable[[Tensor, Sequence[Tensor]], Tensor],
    arrays: Sequence[tuple[Tensor, int]],
    n: int,
    settings: Any,
    generator: torch.Generator,
    *,
    rate: Callable[[int], float] | None = None,
    l1: Callable[[int], Tensor | None] | None = None,
    after_step: Callable[[], object] | None = None,
    after_epoch: Callable[[int], int] | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Adam over shuffled batches (thesis Algorithm 6); returns the history (epoch,
    loss, n_terms).

    Args:
        loss: of the parameters and the tables of a batch. n: number of intervals.
        settings: with learning_rate, epochs and batch. rate, l1: learning rate and L1
            weights of an epoch.
        after_step, after_epoch: projection; pruning, which returns the number of terms
            that are left.

    Raises `SolveError` when the loss is no longer finite.
    """
    history = []
    for epoch in range(1, settings.epochs + 1):
        speed, weights = (
            settings.learning_rate if rate is None else rate(epoch),
            None if l1 is None else l1(epoch),
        )
        total = torch.zeros((), dtype=torch.float64)
        for tables in batches(arrays, n, settings.batch, generator):
            value = loss(adam.flat, tables)
            (gradient,) = torch.autograd.grad(value, adam.flat)
            adam.step(gradient, speed, weights)
            if after_step is not None:
                after_step()
            total += value.detach()
        mean = float(total) / -(-n // settings.batch)
        if not np.isfinite(mean):
            raise SolveError(
                f"the loss is {mean} in epoch {epoch}: the descent has diverged. Take a learning_rate below {speed:g}, "
                "or data and start in units of order one."
            )
        n_terms = len(adam.flat) if after_epoch is None else after_epoch(epoch)
        history.append((epoch, mean, n_terms))
        if progress is not None and (
            epoch % max(1, settings.epochs // 20) == 0 or epoch == settings.epochs
        ):
            progress(
                f"epoch {epoch} of {settings.epochs}: loss {mean:.4g}, {n_terms} terms"
            )
    return pd.DataFrame(history, columns=["epoch", "loss", "n_terms"])
