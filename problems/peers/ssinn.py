"""SSINN: a separable Hamiltonian by a symplectic scheme and gradient descent.

H = T(p) + V(q), both polynomials with coefficients to learn (DiPietro, Xiong, Zhu
2020). An interval is integrated from its first sample by the fourth-order scheme of
Forest and Ruth (1990), also found by Yoshida (1990); the loss compares where it ends
with the next sample. So, unlike in the PHSI loss, the right-hand side is never
evaluated at the second sample.
"""

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.descent import Baseline, descend
from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import PseudoHamiltonian
from phsi_opt.model.terms import Dictionary, polynomials
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import complete_intervals

# The scheme of Forest and Ruth (1990): shares of the step of its drifts (of q) and of
# its kicks (of p), in turns.
CUBE_ROOT = 2.0 ** (1 / 3)
OUTER_DRIFT = 0.5 / (2 - CUBE_ROOT)
INNER_DRIFT = 0.5 * (1 - CUBE_ROOT) / (2 - CUBE_ROOT)
OUTER_KICK = 1.0 / (2 - CUBE_ROOT)
INNER_KICK = -CUBE_ROOT / (2 - CUBE_ROOT)
KICKS = (OUTER_KICK, INNER_KICK, OUTER_KICK)


@dataclass(frozen=True)
class SymplecticDescent:
    """How SSINN descends.

    Args:
        learning_rate: of Adam.
        epochs: passes over the data.
        batch: samples per step.
        decay: pairs (share of the epochs, factor): after that share the learning rate
            is multiplied by the factor. The authors' schedule for Henon-Heiles, 0.1,
            0.01 and 0.001 from the third to the fifth of six epochs, is the default; ()
            keeps the rate.
        steps: steps of the scheme per interval; two is what the authors' tolerance
            gives for a step of 0.1.
    """

    learning_rate: float = 1e-2
    epochs: int = 60
    batch: int = 32
    decay: tuple[tuple[float, float], ...] = (
        (1 / 3, 0.1),
        (1 / 2, 0.01),
        (2 / 3, 0.001),
    )
    steps: int = 2
    weight_decay: float = 0.0  # of Adam
    dtype: str = "float64"

    def rate(self, epoch: int) -> float:
        """Learning rate of an epoch, counted from one."""
        factor = 1.0
        for share, reduced in self.decay:
            if epoch > share * self.epochs:
                factor = reduced
        return self.learning_rate * factor


@interruptible
def ssinn(
    data: Measurements,
    positions: Sequence[str],
    momenta: Sequence[str],
    degree: int,
    settings: SymplecticDescent | None = None,
    seed: int = 0,
) -> Baseline:
    """Learn the coefficients of H = T(p) + V(q) (thesis Section 6.1).

    They minimise::

        mean |q1 - q(h)| + mean |p1 - p(h)|

    (q(h), p(h)) is where the fourth-order symplectic scheme ends after the interval,
    started at the sample (q0, p0): for i = 1..4, q += c_i h dT/dp(p), then
    p -= d_i h dV/dq(q).
    """
    began = time.perf_counter()
    settings = settings or SymplecticDescent()
    model = separable(data.states, positions, momenta, degree)
    grid = complete_intervals(model, grid_of(data))
    with one_thread():
        dtype: torch.dtype = getattr(torch, settings.dtype)
        flow = _Flow(model, positions, momenta, settings, dtype)
        tables = flow.tables(grid)
        generator = torch.Generator().manual_seed(seed)
        theta = _random_start(len(model.H), generator).to(dtype).requires_grad_()
        history = descend(
            torch.optim.Adam([theta], weight_decay=settings.weight_decay),
            lambda batch: flow.loss(theta, batch),
            tables,
            settings,
            generator,
        )
        values = dict(zip(model.entries, theta.tolist(), strict=True))
        loss_value = float(flow.loss(theta, tables).detach())
    return Baseline(
        model=model.with_values(values),
        hold=checked_hold(data.hold, data.inputs),
        seconds=time.perf_counter() - began,
        method="SSINN",
        loss_value=loss_value,
        history=history,
        settings=str(settings),
    )


def _random_start(n_terms: int, generator: torch.Generator) -> Tensor:
    draw = torch.rand(n_terms, generator=generator, dtype=torch.float64)
    return (2 * draw - 1) / np.sqrt(n_terms)


def separable(
    states: Sequence[str], positions: Sequence[str], momenta: Sequence[str], degree: int
) -> PseudoHamiltonian:
    """H = V(q) + T(p) with dq_i/dt = dH/dp_i, dp_i/dt = -dH/dq_i."""
    S = np.zeros((len(states), len(states)))
    for position, momentum in zip(positions, momenta, strict=True):
        i = list(states).index(position)
        j = list(states).index(momentum)
        S[i, j] = 1.0
        S[j, i] = -1.0
    potential: Dictionary = polynomials(positions, degree=degree)
    kinetic: Dictionary = polynomials(momenta, degree=degree)
    return PseudoHamiltonian(states=states, S=S, H=potential + kinetic)


class Gradient:
    """Gradient of T or V by its variables v, B(v) C with B the monomials and C linear
    in the coefficients.

    Args:
        bodies: terms of the whole energy, products of powers; those of other variables
            do not count.
        variables: names of v.
        dtype: of the values.
    """

    def __init__(
        self, bodies: Sequence[str], variables: Sequence[str], dtype: torch.dtype
    ) -> None:
        n = len(variables)
        # Monomial as the numbers of its factors, column, parameter, factor.
        cells: list[tuple[tuple[int, ...], int, int, float]] = []
        for parameter, body in enumerate(bodies):
            powers = re.findall(r"([a-zA-Z]\w*)(?:\*\*(\d+))?", body)
            if {name for name, _ in powers} <= set(variables):
                factors = sorted(
                    list(variables).index(name)
                    for name, power in powers
                    for _ in range(int(power or 1))
                )
                for k in sorted(set(factors)):
                    lower = factors.copy()
                    lower.remove(k)
                    count = float(factors.count(k))
                    cells.append((tuple(lower), k, parameter, count))
        monomials = sorted({cell[0] for cell in cells} | {()})
        degree = max(1, *map(len, monomials))
        # Behind the variables v has a column of ones, which fills what is short.
        padded = [body + (n,) * (degree - len(body)) for body in monomials]
        self.factors = torch.tensor(padded).T.contiguous()  # (degree, n_monomials)
        places = [monomials.index(body) * n + column for body, column, _, _ in cells]
        self.places = torch.tensor(places)
        self.parameters = torch.tensor([parameter for *_, parameter, _ in cells])
        self.scales = torch.tensor([scale for *_, scale in cells], dtype=dtype)
        self.empty = torch.zeros(len(monomials) * n, dtype=dtype)
        self.n_columns = n

    def matrix(self, theta: Tensor) -> Tensor:
        """C at the coefficients, (n_monomials, n_variables)."""
        values = theta.index_select(0, self.parameters) * self.scales
        return self.empty.index_add(0, self.places, values).view(-1, self.n_columns)

    def at(self, v: Tensor, matrix: Tensor) -> Tensor:
        """The gradient (n_rows, n_variables) at v, as many."""
        v = torch.cat((v, v.new_ones(len(v), 1)), 1)
        product = v.index_select(1, self.factors[0])
        for factor in self.factors[1:]:
            product = product * v.index_select(1, factor)
        return product @ matrix


class _Flow:
    """The scheme over a batch of intervals, and the loss."""

    def __init__(
        self,
        model: PseudoHamiltonian,
        positions: Sequence[str],
        momenta: Sequence[str],
        settings: SymplecticDescent,
        dtype: torch.dtype,
    ) -> None:
        self.dtype = dtype
        self.positions = [model.states.index(name) for name in positions]
        self.momenta = [model.states.index(name) for name in momenta]
        bodies = [term.body for term in model.H]
        self.potential = Gradient(bodies, positions, dtype)
        self.kinetic = Gradient(bodies, momenta, dtype)
        self.n_steps = settings.steps

    def tables(self, grid: Grid) -> list[Tensor]:
        """What the loss needs of all intervals: p0, q0, q1, p1, h."""
        x0 = grid.y[grid.begin]
        x1 = grid.y[grid.begin + 1]
        p0 = torch.tensor(x0[:, self.momenta], dtype=self.dtype)
        q0 = torch.tensor(x0[:, self.positions], dtype=self.dtype)
        q1 = torch.tensor(x1[:, self.positions], dtype=self.dtype)
        p1 = torch.tensor(x1[:, self.momenta], dtype=self.dtype)
        h = torch.tensor(grid.h[:, None], dtype=self.dtype)
        return [p0, q0, q1, p1, h]

    def loss(self, theta: Tensor, tables: Sequence[Tensor]) -> Tensor:
        """Mean distance of the ends of the intervals, of q and of p."""
        p, q, q1, p1, h = tables
        T = self.kinetic.matrix(theta)
        V = self.potential.matrix(theta)
        h = h / self.n_steps
        for drift, kick in self._stages():
            q = q + drift * h * self.kinetic.at(p, T)
            if kick:
                p = p - kick * h * self.potential.at(q, V)
        return (q1 - q).abs().mean() + (p1 - p).abs().mean()

    def _stages(self) -> Iterator[tuple[float, float]]:
        """Drifts and kicks of all steps.

        The last drift of a step and the first of the next are one.
        """
        for step in range(self.n_steps):
            begin = OUTER_DRIFT if step == 0 else OUTER_DRIFT + OUTER_DRIFT
            drifts = (begin, INNER_DRIFT, INNER_DRIFT)
            yield from zip(drifts, KICKS, strict=True)
        yield OUTER_DRIFT, 0.0
