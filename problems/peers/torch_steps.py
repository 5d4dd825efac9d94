"""Defects of a scheme in torch, for any right-hand side, and the PHSI loss of them.

The loss is that of `phsi_opt.transcription.losses.PHSILoss`. How it is brought down is
in `phsi_opt.baselines.descent`.
"""

from collections.abc import Callable, Sequence
from math import sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import FIRST_NODE, SECOND_NODE, integrator
from phsi_opt.transcription.integrators import RightHandSide as Stage

# dx/dt (n_rows, n_states) at states x (n_rows, n_states) and at z, the inputs, the time
# and a one (n_rows, n_inputs + 2).
RightHandSide = Callable[[Tensor, Tensor], Tensor]


class Steps:
    """Defects (x1 - x0)/h - Psi of intervals, for any scheme of the package.

    SRK4 is the mean of `srk4_one_way` over both directions of time: both go through as
    rows of one batch.

    Args:
        grid: the intervals.
        scheme: a name in ``phsi_opt.transcription.integrators``.
        dtype: of the tables.

    Attributes:
        tables: what a batch needs of its intervals, along the first axis: the rates
            (x1 - x0)/h; x0, x1 and h, forth and back; inputs, time and a one at both
            ends.
    """

    def __init__(self, grid: Grid, scheme: str, dtype: torch.dtype) -> None:
        is_mean = scheme == "srk4"
        self.psi = srk4_one_way if is_mean else integrator(scheme).psi
        ways = 2 if is_mean else 1
        h = grid.h[:, None]
        t0 = grid.t[grid.begin]
        one = np.ones_like(t0)
        x = np.stack((grid.y[grid.begin], grid.y[grid.begin + 1]), 1)
        begin = np.column_stack((grid.u0, t0, one))
        end = np.column_stack((grid.u1, t0 + grid.h, one))
        z = np.stack((begin, end), 1)
        self.tables = [torch.tensor(grid.rates(grid.y), dtype=dtype)]
        for both in (x, x[:, ::-1], np.stack((h, -h), 1), z, z[:, ::-1]):
            self.tables.append(torch.tensor(both[:, :ways].copy(), dtype=dtype))

    def defects(self, f: RightHandSide, tables: Sequence[Tensor]) -> Tensor:
        """Defects of a batch, (n_intervals, n_states)."""
        rates = tables[0]
        x0, x1, h, z0, z1 = [table.flatten(0, 1) for table in tables[1:]]
        psi = self.psi(lambda x, c: f(x, torch.lerp(z0, z1, c)), x0, x1, h)
        return rates - psi.view(len(rates), -1, rates.shape[1]).mean(1)

    def loss(self, f: RightHandSide, tables: Sequence[Tensor]) -> Tensor:
        """``(1/b) sum |defect|^2`` over the b intervals of a batch, as `defects`."""
        return self.defects(f, tables).square().sum() / len(tables[0])


def srk4_one_way(g: Stage, x0: Any, x1: Any, h: Any) -> Any:
    """Half of SRK4: its Psi is the mean of this from x0 to x1 and from x1 to x0."""
    inner = FIRST_NODE * x0 + SECOND_NODE * x1
    first = (x0 + x1) / 2 - sqrt(3) / 6 * h * g(inner, SECOND_NODE)
    return g(first, FIRST_NODE)
