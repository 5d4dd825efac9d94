"""Defects of a scheme in torch, and the PHSI loss of a batch of them.

The loss is that of `phsi_opt.transcription.losses.PHSILoss`. Where a scheme evaluates
the right-hand side at the data alone, its monomials are computed once for the whole
data set. How the loss is brought down is in `descent`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import integrator, srk4_one_way


class Evaluation(Protocol):
    """A right-hand side at given parameters."""

    @property
    def forces(self) -> list[Tensor]:
        """What the force network gave so far."""

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        """dx/dt, (n_rows, n_states).

        Args:
            x: states (n_rows, n_states).
            z: the columns ``outside`` of (inputs, t); None if there are none.
            features: what `Dynamics.features` gave for x and z, or None.
        """


class Dynamics(Protocol):
    """What `Steps` needs of a right-hand side.

    Attributes:
        outside: the columns of (inputs, t) that it reads.
    """

    outside: list[int]

    def features(self, x: Tensor, z: Tensor | None) -> Tensor | None:
        """What can be computed once where x is data; None if nothing can."""

    def at(self, flat: Tensor) -> Evaluation:
        """The right-hand side at the parameters."""


@dataclass(frozen=True)
class Table:
    """Numbers that belong to the intervals: ``rows`` rows of ``values`` to each."""

    values: Tensor
    rows: int


@dataclass(frozen=True)
class _Call:
    """One evaluation of the right-hand side by a scheme.

    Attributes:
        outside: number of the table of its inputs and times; None if it reads none.
        features: number of the table of its features; None where they are not kept.
    """

    outside: int | None
    features: int | None


class Steps:
    """Defects (x1 - x0)/h - Psi of intervals, for any scheme of the package.

    A first run of the scheme over all data finds the evaluations at the data alone.
    SRK4 is the mean of `srk4_one_way` over both directions of time: both go through as
    rows of one batch.

    Args:
        grid: the intervals.
        scheme: a name in ``phsi_opt.transcription.integrators``.
        dynamics: the right-hand side.
        dtype: of the tables.

    Attributes:
        tables: all that a batch needs of its intervals: the rates (x1 - x0)/h, x0, x1,
            h, then the inputs and features of the evaluations.
    """

    def __init__(
        self, grid: Grid, scheme: str, dynamics: Dynamics, dtype: torch.dtype
    ) -> None:
        self.dynamics = dynamics
        self.n_intervals = grid.n_intervals
        self.n_states = grid.y.shape[1]
        self.both_ways = scheme == "srk4"
        self.psi = srk4_one_way if self.both_ways else integrator(scheme).psi
        self._rows = 2 if self.both_ways else 1
        self._place_ends_outside(grid)
        y0 = grid.y[grid.begin]
        y1 = grid.y[grid.begin + 1]
        h = grid.h[:, None]
        x0 = torch.tensor(self._ways(y0, y1), dtype=dtype)
        x1 = torch.tensor(self._ways(y1, y0), dtype=dtype)
        steps = torch.tensor(self._ways(h, -h), dtype=dtype)
        rates = torch.tensor(grid.rates(grid.y), dtype=dtype)
        self.tables = [Table(rates, 1)]
        self.tables += [Table(values, self._rows) for values in (x0, x1, steps)]
        self._calls: list[_Call] = []
        self.psi(self._recorded, x0, x1, steps)

    def _ways(self, forth: np.ndarray, back: np.ndarray) -> np.ndarray:
        """The rows of the intervals; for SRK4 each is followed by its way back."""
        if not self.both_ways:
            return forth
        return np.stack((forth, back), 1).reshape(len(forth) * 2, -1)

    def _place_ends_outside(self, grid: Grid) -> None:
        """Inputs and times at both ends of the rows."""
        h = grid.h[:, None]
        t0 = grid.t[grid.begin][:, None]
        begin = np.hstack((grid.u0, t0))
        end = np.hstack((grid.u1, t0 + h))
        self._z0 = self._ways(begin, end)[:, self.dynamics.outside]
        self._z1 = self._ways(end, begin)[:, self.dynamics.outside]

    def _recorded(self, x: Tensor, c: float) -> Tensor:
        """In place of a right-hand side: keep what its evaluation needs."""
        z = None
        outside = None
        if self.dynamics.outside:
            at_c = self._z0 + c * (self._z1 - self._z0)
            z = torch.tensor(at_c, dtype=x.dtype)
            outside = self._kept(z)
        features = None
        # What comes out of a right-hand side, below, requires a gradient: data do not.
        if not x.requires_grad:
            computed = self.dynamics.features(x, z)
            if computed is not None:
                features = self._kept(computed)
        self._calls.append(_Call(outside, features))
        return torch.zeros_like(x).requires_grad_()

    def _kept(self, values: Tensor) -> int:
        """Add a table; its number."""
        self.tables.append(Table(values, self._rows))
        return len(self.tables) - 1

    def all_tables(self) -> list[Tensor]:
        """The tables of all intervals."""
        return [table.values for table in self.tables]

    def defects(self, flat: Tensor, tables: Sequence[Tensor]) -> Tensor:
        """Defects of a batch, (n_intervals, n_states).

        Args:
            flat: the parameters.
            tables: the rows of ``self.tables`` that belong to the batch.
        """
        return self._defects(self.dynamics.at(flat), tables)

    def _defects(self, f: Evaluation, tables: Sequence[Tensor]) -> Tensor:
        calls = iter(self._calls)

        def g(x: Tensor, c: float) -> Tensor:
            call = next(calls)
            z = None if call.outside is None else tables[call.outside]
            features = None if call.features is None else tables[call.features]
            return f(x, z, features)

        rate, x0, x1, h = tables[:4]
        psi = self.psi(g, x0, x1, h)
        if self.both_ways:
            psi = psi.view(-1, 2, self.n_states).mean(1)
        return rate - psi

    def loss(
        self, flat: Tensor, tables: Sequence[Tensor], penalty: float = 0.0
    ) -> Tensor:
        """``(1/b) sum |defect|^2`` over the b intervals of a batch.

        Args:
            flat: the parameters.
            tables: the rows of ``self.tables`` that belong to the batch.
            penalty: weight of the mean of ``|F|`` of the force network, which is
                added.
        """
        f = self.dynamics.at(flat)
        defects = self._defects(f, tables)
        value = defects.square().sum() / defects.shape[0]
        if penalty and f.forces:
            value = value + penalty * f.forces[-1].abs().mean()
        return value
