"""SSINN: a separable Hamiltonian by a symplectic scheme and gradient descent (DiPietro,
Xiong, Zhu 2020).

H = T(p) + V(q), both polynomials with coefficients to learn. An interval is integrated
from its first sample by the fourth-order scheme of Forest and Ruth (1990), also found
by Yoshida (1990); the loss compares where it ends with the next sample. So, unlike in
the PHSI loss, the right-hand side is never evaluated at the second sample.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.descent_settings import (
    DTYPES,
    check_descent,
    is_count,
    is_size,
    require,
)
from phsi_opt.baselines.result import Baseline
from phsi_opt.baselines.torch_dictionary import Basis, combination, lowered, monomial
from phsi_opt.baselines.torch_steps import Adam, Progress, descend
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.model import PseudoHamiltonian
from phsi_opt.model.terms import Dictionary, polynomials
from phsi_opt.optimization.torch_threads import one_thread
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.losses import complete_intervals

LOSSES = ("absolute", "squared")
CUBE_ROOT = 2.0 ** (1 / 3)
DRIFTS = tuple(
    v / (2 - CUBE_ROOT)
    for v in (0.5, 0.5 * (1 - CUBE_ROOT), 0.5 * (1 - CUBE_ROOT), 0.5)
)
KICKS = tuple(v / (2 - CUBE_ROOT) for v in (1.0, -CUBE_ROOT, 1.0))


@dataclass(frozen=True)
class SymplecticDescent:
    """How SSINN descends.

    Args:
        learning_rate: of Adam. epochs: passes over the data. batch: samples per step.
        decay: pairs (share of the epochs, factor): after that share the learning rate
            is multiplied by the factor. The authors' schedule for Henon-Heiles, 0.1,
            0.01 and 0.001 from the third to the fifth of six epochs, is the default; ()
            keeps the rate.
        l1: weight of the sum of |coefficient|. The authors take 1e-3; the default is
            none, as for the other methods.
        loss: "absolute" (the authors' choice) or "squared".
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
    l1: float = 0.0
    loss: str = "absolute"
    steps: int = 2
    weight_decay: float = 0.0
    dtype: str = "float64"

    def __post_init__(self) -> None:
        check_descent(self)
        require(is_size(self.l1), "l1", self.l1, "a finite number of at least 0")
        require(
            is_count(self.steps), "steps", self.steps, "a whole number of at least 1"
        )
        require(
            self.loss in LOSSES,
            "loss",
            self.loss,
            f"one of {', '.join(LOSSES)}",
            did_you_mean(self.loss, LOSSES),
        )
        shares = [share for share, _ in self.decay]
        fine = all(is_size(v) for pair in self.decay for v in pair) and all(
            a < b for a, b in pairwise(shares)
        )
        require(
            fine,
            "decay",
            self.decay,
            "pairs (share of the epochs, factor) with increasing shares",
        )

    def rate(self, epoch: int) -> float:
        """Learning rate of an epoch, counted from one."""
        factor = 1.0
        for share, reduced in self.decay:
            factor = reduced if epoch > share * self.epochs else factor
        return self.learning_rate * factor


def ssinn(
    data: Measurements,
    positions: Sequence[str],
    momenta: Sequence[str],
    degree: int,
    settings: SymplecticDescent | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Baseline:
    """Minimise mean |q1 - q(h)| + mean |p1 - p(h)| over the coefficients of H = T(p) +
    V(q) (thesis Section 6.1).

    (q(h), p(h)) is where the fourth-order symplectic scheme ends after the interval,
    started at the sample (q0, p0): for i = 1..4, q += c_i h dT/dp(p), then p -= d_i h
    dV/dq(q).

    Args:
        data: every state measured. positions, momenta: its states in pairs. degree: of
            both polynomials.
        settings: see `SymplecticDescent`. seed: of the start, uniform within
            +-1/sqrt(terms), and of the batches.

    The result's model is a `PseudoHamiltonian` with coefficients such as H[q1**2].
    Raises `DataError` and `ModelError` for states that do not pair up, `SolveError` if
    the loss diverges.
    """
    began = time.perf_counter()
    settings = settings or SymplecticDescent()
    model = separable(data.states, positions, momenta, degree)
    grid = complete_intervals(model, grid_of(data))
    with one_thread():
        dtype = DTYPES[settings.dtype]
        q, p = (
            [model.states.index(name) for name in names]
            for names in (positions, momenta)
        )
        flow = _Flow(model, positions, momenta, settings, dtype)
        p0 = torch.tensor(grid.y[grid.begin][:, p], dtype=dtype)
        ends = [
            torch.tensor(grid.y[grid.begin + k][:, i], dtype=dtype)
            for k, i in ((0, q), (1, q), (1, p))
        ]
        tables = [
            p0,
            *ends,
            torch.tensor(grid.h[:, None], dtype=dtype),
            flow.kinetic.basis.features(p0),
        ]
        generator = torch.Generator().manual_seed(seed)
        n_terms = len(model.H)
        start = (
            2 * torch.rand(n_terms, generator=generator, dtype=torch.float64) - 1
        ) / np.sqrt(n_terms)
        adam = Adam(start.to(dtype).requires_grad_(), settings.weight_decay)
        penalty = torch.full_like(adam.raw, settings.l1) if settings.l1 else None
        history = descend(
            adam,
            flow.loss,
            [(table, 1) for table in tables],
            grid.n_intervals,
            settings,
            generator,
            rate=settings.rate,
            l1=lambda epoch: penalty,
            after_epoch=lambda epoch: n_terms,
            progress=progress,
        )
        found = model.with_values(
            dict(zip(model.entries, adam.raw.tolist(), strict=True))
        )
        value = float(flow.loss(adam.raw, tables))
    return Baseline(
        model=found,
        hold=data.hold,
        seconds=time.perf_counter() - began,
        method="SSINN",
        loss_value=value,
        history=history,
        settings=str(settings),
    )


def separable(
    states: Sequence[str], positions: Sequence[str], momenta: Sequence[str], degree: int
) -> PseudoHamiltonian:
    """H = V(q) + T(p) with dq_i/dt = dH/dp_i, dp_i/dt = -dH/dq_i; raises `ModelError`
    if the states do not pair up.
    """
    named = [*positions, *momenta]
    if len(positions) != len(momenta) or sorted(named) != sorted(states):
        raise ModelError(
            f"positions={list(positions)!r} and momenta={list(momenta)!r} do not pair up the states "
            f"({', '.join(states)}); expected every state once, and as many momenta as positions."
        )
    S = np.zeros((len(states), len(states)))
    for q, p in zip(positions, momenta, strict=True):
        i, j = list(states).index(q), list(states).index(p)
        S[i, j], S[j, i] = 1.0, -1.0
    H: Dictionary = polynomials(positions, degree=degree) + polynomials(
        momenta, degree=degree
    )
    return PseudoHamiltonian(states=states, S=S, H=H)


class _Part:
    """Gradient of T or V: the monomials of lower degree times a matrix that is linear
    in the coefficients.
    """

    def __init__(
        self, model: PseudoHamiltonian, variables: Sequence[str], dtype: torch.dtype
    ) -> None:
        n, self.size = len(variables), len(variables)
        rows = [(j, monomial(term.body, variables)) for j, term in enumerate(model.H)]
        cells = [(j, e, k) for j, e in rows if e is not None for k in range(n) if e[k]]
        self.basis = Basis([lowered(e, k) for _, e, k in cells], n, n, dtype)
        self.cells = torch.tensor(
            [self.basis.position[lowered(e, k)] * n + k for _, e, k in cells]
        )
        self.sources = torch.tensor([j for j, _, _ in cells])
        self.factors = torch.tensor([float(e[k]) for _, e, k in cells], dtype=dtype)
        self.zero = torch.zeros(len(self.basis) * n, dtype=dtype)

    def matrix(self, theta: Tensor) -> Tensor:
        values = theta.index_select(0, self.sources) * self.factors
        return self.zero.index_add(0, self.cells, values).view(-1, self.size)


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
        self.potential, self.kinetic = (
            _Part(model, positions, dtype),
            _Part(model, momenta, dtype),
        )
        self.n_steps, self.absolute = settings.steps, settings.loss == "absolute"

    def loss(self, theta: Tensor, tables: Sequence[Tensor]) -> Tensor:
        p, q, q1, p1, h, features = tables
        T, V, h = (
            self.kinetic.matrix(theta),
            self.potential.matrix(theta),
            h / self.n_steps,
        )
        first: Tensor | None = features @ T  # of the data alone
        for drift, kick in self._stages():
            slope = (
                combination(p, None, T, self.kinetic.basis) if first is None else first
            )
            q, first = q + drift * h * slope, None
            if kick:
                p = p - kick * h * combination(q, None, V, self.potential.basis)
        if self.absolute:
            return (q1 - q).abs().mean() + (p1 - p).abs().mean()
        return (q1 - q).square().mean() + (p1 - p).square().mean()

    def _stages(self) -> Iterator[tuple[float, float]]:
        """Drifts and kicks of all steps; the last drift of a step and the first of the
        next are one.
        """
        for step in range(self.n_steps):
            begin = DRIFTS[0] if step == 0 else DRIFTS[0] + DRIFTS[3]
            yield from zip((begin, DRIFTS[1], DRIFTS[2]), KICKS, strict=True)
        yield DRIFTS[3], 0.0
