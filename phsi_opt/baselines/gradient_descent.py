"""The thesis' own method: the PHSI loss minimised by Adam in batches, with pruning (thesis Algorithm 6).

The loss is that of `phsi_opt.losses.PHSILoss`; only the way down differs. Monomials are one matrix product: the
gradient of a polynomial energy is B(x) W(xi) with B the monomials of lower degree and W linear in the coefficients.
Where a scheme evaluates the right-hand side at the data alone, B is computed once for the whole data set. Other terms
are evaluated from their text. `ssinn` and `phnn` train with the parts of this file.
"""

import ast
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import sqrt
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import pandas as pd

try:
    import torch
except ModuleNotFoundError as error:  # pragma: no cover
    raise ModuleNotFoundError("torch is missing; install the extra: pip install 'phsi_opt[baselines]'.") from error
from scipy.integrate import solve_ivp
from torch import Tensor
from torch.autograd.function import once_differentiable

from phsi_opt.baselines.result import Baseline
from phsi_opt.errors import DataError, ModelError, SolveError, did_you_mean
from phsi_opt.expressions import evaluate, names_of, parse
from phsi_opt.grid import Grid, grid_of
from phsi_opt.identify import matched
from phsi_opt.integrators import RightHandSide, integrator
from phsi_opt.losses import complete, l1_weights
from phsi_opt.measurements import Measurements
from phsi_opt.model import FirstOrder, Model, PseudoHamiltonian, place_of
from phsi_opt.simulate import ATOL, RTOL
from phsi_opt.terms import Dictionary, Term

Progress = Callable[[str], None]
DTYPES = {"float32": torch.float32, "float64": torch.float64}
STARTS = ("thesis", "normal", "model")
BETAS, EPSILON = (0.9, 0.999), 1e-8  # of Adam
POLYNOMIAL_START, FUNCTION_START, NORMAL_START = 0.2, 1.0, 0.5


def _tensors(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    # Numbers of a formula in double precision: they do not change the type of the columns they meet.
    return lambda *arguments: function(
        *(a if isinstance(a, Tensor) else torch.tensor(a, dtype=torch.float64) for a in arguments)
    )


FUNCTIONS = {
    "sin": _tensors(torch.sin), "cos": _tensors(torch.cos), "tan": _tensors(torch.tan), "atan": _tensors(torch.atan),
    "exp": _tensors(torch.exp), "log": _tensors(torch.log), "sqrt": _tensors(torch.sqrt), "tanh": _tensors(torch.tanh),
    "abs": _tensors(torch.abs), "sign": _tensors(torch.sign), "min": _tensors(torch.minimum),
    "max": _tensors(torch.maximum),
}  # fmt: skip


# ---- settings --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Descent:
    """How to descend (thesis Algorithm 6 and appendix B).

    Args:
        learning_rate: of Adam. epochs: passes over the data. batch: samples per step.
        prune_every: after every so many epochs, coefficients with |xi| < ``threshold`` in ``prune_slots`` become zero
            for good; None never prunes.
        weight_decay: added to the gradient as weight_decay * parameter, as Adam of torch does.
        l1: lambda of |xi| per slot, such as {"H": 0.1, "F": 0.01}; that of H is off after the share ``l1_off_after`` of
            the epochs (the thesis' code: half), None keeps it.
        integrator: a name in `phsi_opt.integrators`.
        start: "thesis" (0.2 for polynomials, 1 for other functions and their frequencies, 0 for damping: appendix B
            and the thesis' code), "normal" (N(0, 0.5^2), thesis Section 5.1) or "model" (the values of
            the model, zero where it has none). Values that a model gives to formulas and to inner parameters are kept.
        dtype: "float64", or "float32" as the thesis has it.
        keep_damping_positive: keep the bounds of R; the thesis lets it go negative. Other bounds are always kept, by
            projection after each step.
    """

    learning_rate: float = 3e-3
    epochs: int = 60
    batch: int = 32
    prune_every: int | None = 5
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
        check_descent(self)
        if self.prune_every is not None:
            require(
                is_count(self.prune_every), "prune_every", self.prune_every, "a whole number of at least 1, or None"
            )
        require(is_size(self.threshold), "threshold", self.threshold, "a finite number of at least 0")
        for slot in self.prune_slots:
            require(slot in ("H", "R", "F"), "prune_slots", self.prune_slots, "slots among 'H', 'R' and 'F'")
        if self.l1_off_after is not None:
            share = is_size(self.l1_off_after) and self.l1_off_after <= 1
            require(share, "l1_off_after", self.l1_off_after, "a share of the epochs between 0 and 1, or None")
        require(
            self.start in STARTS, "start", self.start, f"one of {', '.join(STARTS)}", did_you_mean(self.start, STARTS)
        )
        object.__setattr__(self, "l1", MappingProxyType(l1_weights(self.l1)))
        object.__setattr__(self, "prune_slots", tuple(self.prune_slots))

    def __reduce__(self) -> tuple[Any, ...]:  # a mappingproxy cannot be pickled
        return _descent, ({**vars(self), "l1": dict(self.l1)},)


def _descent(parts: dict[str, Any]) -> Descent:
    return Descent(**parts)


@dataclass(frozen=True)
class NeuralForce:
    """A force by a network beside the dictionary (the thesis' hybrid, Section 6.4): F_i = net(variables).

    Args:
        equations: states in whose equations it acts. variables: states, inputs or "t" that it sees.
        hidden: widths of the hidden layers, with ReLU. penalty: weight of the mean of |F| over the batch.
        first: function of the first hidden layer, "relu" (the text of the thesis) or "tanh" (its code, which has two
            hidden layers); with a large learning rate, a narrow input and only ReLU, units die.
    """

    equations: tuple[str, ...]
    variables: tuple[str, ...]
    hidden: tuple[int, ...] = (100, 100, 100)
    penalty: float = 0.0
    first: str = "relu"

    def __post_init__(self) -> None:
        require(self.first in ("relu", "tanh"), "first", self.first, "'relu' or 'tanh'")
        for name in ("equations", "variables"):
            given = getattr(self, name)
            listed = (given,) if isinstance(given, str) else tuple(given)
            require(len(set(listed)) == len(listed) > 0, name, given, "at least one name, and each only once")
            object.__setattr__(self, name, listed)
        require(all(is_count(width) for width in self.hidden), "hidden", self.hidden, "widths of at least 1")
        object.__setattr__(self, "hidden", tuple(self.hidden))
        require(is_size(self.penalty), "penalty", self.penalty, "a finite number of at least 0")


def check_descent(settings: Any) -> None:
    """Check what all descents have in common; raises `ModelError`."""
    require(is_size(settings.learning_rate, positive=True), "learning_rate", settings.learning_rate, "a number above 0")
    for name in ("epochs", "batch"):
        require(is_count(getattr(settings, name)), name, getattr(settings, name), "a whole number of at least 1")
    require(is_size(settings.weight_decay), "weight_decay", settings.weight_decay, "a finite number of at least 0")
    require(settings.dtype in DTYPES, "dtype", settings.dtype, f"one of {', '.join(DTYPES)}")
    if hasattr(settings, "integrator"):
        integrator(settings.integrator)


def require(fine: bool, name: str, value: Any, expected: str, hint: str = "") -> None:
    """Raise `ModelError` that names the setting, its value and what is expected."""
    if not fine:
        raise ModelError(f"{name}={value!r} is not possible; expected {expected}.{hint}")


def is_count(value: Any) -> bool:
    """Whether the value is a whole number of at least 1."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 1)


def is_size(value: Any, positive: bool = False) -> bool:
    """Whether the value is a finite number of at least (or above) zero."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return bool(np.isfinite(value) and (value > 0 if positive else value >= 0))


# ---- monomials -------------------------------------------------------------------------------------------------------


def monomial(body: str, variables: Sequence[str]) -> tuple[int, ...] | None:
    """Exponents of a body that is a product of powers of the variables (or 1), else None."""
    powers = _powers(parse(body))
    if powers is None or not set(powers) <= set(variables):
        return None
    return tuple(powers.get(name, 0) for name in variables)


def _powers(node: ast.expr) -> dict[str, int] | None:
    if isinstance(node, ast.Constant):
        return {} if node.value == 1 else None
    if isinstance(node, ast.Name):
        return {node.id: 1}
    if not isinstance(node, ast.BinOp):
        return None
    if isinstance(node.op, ast.Pow) and isinstance(node.left, ast.Name) and isinstance(node.right, ast.Constant):
        return {node.left.id: node.right.value} if is_count(node.right.value) else None  # type: ignore[dict-item]
    left, right = (_powers(part) if isinstance(node.op, ast.Mult) else None for part in (node.left, node.right))
    if left is None or right is None:
        return None
    return {name: left.get(name, 0) + right.get(name, 0) for name in {**left, **right}}


def lowered(exponents: tuple[int, ...], k: int) -> tuple[int, ...]:
    """The monomial divided by its variable k."""
    return tuple(e - (i == k) for i, e in enumerate(exponents))


class Basis:
    """Monomials of variables v, closed under division by a variable, so that each is a product of two others.

    ``features(v)``: (n_rows, n_variables) -> (n_rows, n_monomials). Only the first ``n_states`` variables have a
    derivative.
    """

    def __init__(
        self, exponents: Iterable[tuple[int, ...]], n_variables: int, n_states: int, dtype: torch.dtype
    ) -> None:
        closed, left = {(0,) * n_variables}, list(exponents)
        while left:
            one = left.pop()
            if one not in closed:
                closed.add(one)
                left += [lowered(one, k) for k in range(n_variables) if one[k]]
        by_degree = [
            sorted((e for e in closed if sum(e) == degree), reverse=True) for degree in range(max(map(sum, closed)) + 1)
        ]
        self.position = {e: i for i, e in enumerate(e for level in by_degree for e in level)}
        self.levels = []
        for before, level in pairwise(by_degree):
            variable = [next(k for k, power in enumerate(e) if power) for e in level]
            parent = [before.index(lowered(e, k)) for e, k in zip(level, variable, strict=True)]
            self.levels.append((torch.tensor(parent), torch.tensor(variable)))
        self.all_linear = bool(self.levels) and self.levels[0][1].tolist() == list(range(n_variables))
        pairs = [(e, k) for e in self.position for k in range(n_states) if e[k]]
        self.upper = torch.tensor([self.position[e] for e, _ in pairs], dtype=torch.long)
        self.lower = torch.tensor([self.position[lowered(e, k)] for e, k in pairs], dtype=torch.long)
        self.slope = torch.zeros((len(pairs), n_states), dtype=dtype)
        for i, (e, k) in enumerate(pairs):
            self.slope[i, k] = e[k]

    def __len__(self) -> int:
        return len(self.position)

    def features(self, v: Tensor) -> Tensor:
        """All monomials of v, degree by degree."""
        parts = [torch.ones((v.shape[0], 1), dtype=v.dtype)]
        for degree, (parent, variable) in enumerate(self.levels):
            if degree == 0:
                parts.append(v if self.all_linear else v.index_select(1, variable))
            else:
                parts.append(parts[-1].index_select(1, parent) * v.index_select(1, variable))
        return torch.cat(parts, 1)

    def pulled_back(self, gradient: Tensor, features: Tensor) -> Tensor:
        """Gradient with respect to the states from that with respect to the monomials."""
        return (gradient.index_select(1, self.upper) * features.index_select(1, self.lower)) @ self.slope


class Combination(torch.autograd.Function):
    """``basis.features([x, z]) @ C`` with its derivative by x and C written out: two nodes instead of a dozen."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, z: Tensor | None, C: Tensor, basis: Basis) -> Tensor:
        """The value, (n_rows, n_columns of C)."""
        features = basis.features(x if z is None else torch.cat((x, z), 1))
        ctx.save_for_backward(features, C)
        ctx.basis = basis
        return features @ C

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, Tensor, None]:
        """The derivative by x and C."""
        features, C = ctx.saved_tensors
        return ctx.basis.pulled_back(gradient @ C.t(), features), None, features.t() @ gradient, None


def combination(x: Tensor, z: Tensor | None, C: Tensor, basis: Basis) -> Tensor:
    """``basis.features([x, z]) @ C``, differentiable by x and C."""
    value: Tensor = Combination.apply(x, z, C, basis)
    return value


# ---- networks --------------------------------------------------------------------------------------------------------


class Network:
    """Where the weights of a fully connected network stand in a flat vector of parameters."""

    def __init__(self, widths: Sequence[int]) -> None:
        self.shapes = [s for n, m in pairwise(widths) for s in ((n, m), (m,))]
        self.sizes = [int(np.prod(shape)) for shape in self.shapes]

    def start(self, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
        """Uniform within +-1/sqrt(number of inputs), weights and biases alike (torch's own start of a linear layer)."""
        parts = []
        for i, size in enumerate(self.sizes):
            bound = 1 / sqrt(self.shapes[i - i % 2][0])
            parts.append((2 * torch.rand(size, generator=generator, dtype=torch.float64) - 1) * bound)
        return torch.cat(parts).to(dtype)

    def layers(self, parts: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
        """(weight (n_in, n_out), bias) of every layer from the pieces of the flat vector."""
        shaped = [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return list(zip(shaped[::2], shaped[1::2], strict=True))


def relu_network(layers: Sequence[tuple[Any, Any]], v: Tensor, first: str = "relu") -> Tensor:
    """Value of a network with ReLU between its layers, or tanh after the first, (n_rows, n_outputs)."""
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = torch.addmm(bias, v, weight)
        v = v.tanh() if i == 0 and first == "tanh" else v.relu()
    return torch.addmm(layers[-1][1], v, layers[-1][0])


# ---- the right-hand side ---------------------------------------------------------------------------------------------


class Evaluation(Protocol):
    """A right-hand side at given parameters."""

    @property
    def forces(self) -> list[Tensor]:
        """What the force network gave so far."""

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        """dx/dt, (n_rows, n_states)."""


class Dynamics(Protocol):
    """What `Steps` needs of a right-hand side; z are the columns ``outside`` of (inputs, t)."""

    outside: list[int]

    def features(self, x: Tensor, z: Tensor | None) -> Tensor | None:
        """What can be computed once where x is data."""

    def at(self, flat: Tensor) -> Evaluation:
        """The right-hand side at the parameters."""


class DictionaryDynamics:
    """A model of the package in torch: dx/dt = (S - R) grad H + F, all parameters in one flat vector.

    The vector holds every parameter of ``model.entries`` in their order, then the weights of the force network.
    """

    def __init__(self, model: Model, dtype: torch.dtype, force: NeuralForce | None = None) -> None:
        self.model, self.dtype, self.force = model, dtype, force
        self.names = list(model.entries)
        used = set().union(*(names_of(term.body) for _, _, term in model.placed()), force.variables if force else ())
        around = (*model.inputs, "t")
        self.outside = [i for i, name in enumerate(around) if name in used]
        self.variables = (*model.states, *(around[i] for i in self.outside))
        self.others: list[tuple[str, str, Term]] = []
        self._sort_terms()
        self.network: Network | None = None
        if force is not None:
            self._place_force(force)

    def _sort_terms(self) -> None:
        """Monomials go into matrices, constant damping onto a diagonal, the rest is evaluated from its text."""
        n, index = self.model.n_states, {name: i for i, name in enumerate(self.names)}
        energy, force, diagonal = [], [], []
        for slot, equation, term in self.model.placed():
            exponents = None if term.is_formula or term.inner else monomial(term.body, self.variables)
            where = None if exponents is None else index[term.coefficient_name(place_of(slot, equation))]
            if exponents is None or (slot == "R" and any(exponents)):
                self.others.append((slot, equation, term))
            elif slot == "H":
                energy += [(lowered(exponents, k), k, where, float(exponents[k])) for k in range(n) if exponents[k]]
            elif slot == "F":
                force.append((exponents, self.model.index(equation), where, 1.0))
            else:
                diagonal.append((self.model.index(equation), where))
        self.needs_efforts = any(
            slot == "R" or names_of(term.body) & set(self.model.efforts) for slot, _, term in self.others
        )
        placed = [(place_of(slot, equation), term) for slot, equation, term in self.others]
        read = [term.inner_name(name, place) for place, term in placed for name in term.inner]
        read += [term.coefficient_name(place) for place, term in placed if not term.is_formula]
        self.read = list(dict.fromkeys(read))  # parameters of the terms that are evaluated from their text
        self.read_at = torch.tensor([index[name] for name in self.read], dtype=torch.long)
        self.reads_states = any(
            slot == "R" or names_of(term.body) & set(self.model.states) for slot, _, term in self.others if slot != "H"
        )
        self.has_energy = isinstance(self.model, PseudoHamiltonian) or bool(diagonal) or self.needs_efforts
        self._place_matrices(energy, force, diagonal)

    def _place_matrices(self, energy: list[Any], force: list[Any], diagonal: list[Any]) -> None:
        n = self.model.n_states
        units = [tuple(int(i == k) for i in range(len(self.variables))) for k in range(n)]
        identity = isinstance(self.model, FirstOrder) and self.has_energy  # its efforts are the states
        self.basis = Basis(
            [e for e, *_ in energy + force] + (units if identity else []), len(self.variables), n, self.dtype
        )
        size, position = len(self.basis) * n, self.basis.position
        self.fixed = torch.zeros(2 * size, dtype=self.dtype)
        if identity:
            self.fixed[[position[unit] * n + k for k, unit in enumerate(units)]] = 1.0
        cells = [position[e] * n + k for e, k, _, _ in energy] + [size + position[e] * n + k for e, k, _, _ in force]
        self.cells = torch.tensor(cells, dtype=torch.long)
        self.sources = torch.tensor([row[2] for row in energy + force], dtype=torch.long)
        self.factors = torch.tensor([row[3] for row in energy + force], dtype=self.dtype)
        self.structure = torch.tensor(np.array(self.model.S).T.copy(), dtype=self.dtype)
        self.damped = torch.tensor([i * n + i for i, _ in diagonal], dtype=torch.long)
        self.damping = torch.tensor([where for _, where in diagonal], dtype=torch.long)

    def _place_force(self, force: NeuralForce) -> None:
        for name in force.variables:
            if name not in self.variables:
                known = (*self.model.states, *self.model.inputs, "t")
                raise ModelError(
                    f"variable {name!r} of the neural force is unknown; expected names among {', '.join(known)}."
                    f"{did_you_mean(name, known)}"
                )
        self.seen = torch.tensor([self.variables.index(name) for name in force.variables])
        self.rows = torch.tensor([self.model.index(name, "equation of the neural force") for name in force.equations])
        self.network = Network([len(force.variables), *force.hidden, len(force.equations)])

    def features(self, x: Tensor, z: Tensor | None) -> Tensor:
        """The monomials, (n_rows, n_monomials)."""
        return self.basis.features(x if z is None else torch.cat((x, z), 1))

    def at(self, flat: Tensor) -> "DictionaryEvaluation":
        """The right-hand side at the parameters."""
        theta, *parts = flat.split([len(self.names), *self.network.sizes]) if self.network else [flat]
        return DictionaryEvaluation(self, theta, self.network.layers(parts) if self.network else [])


class DictionaryEvaluation:
    """`DictionaryDynamics` at given parameters; the matrices are made once per step of training."""

    def __init__(self, dynamics: DictionaryDynamics, theta: Tensor, layers: list[tuple[Tensor, Tensor]]) -> None:
        self.d, self.theta, self.layers, self.forces = dynamics, theta, layers, list[Tensor]()
        d, n = dynamics, dynamics.model.n_states
        filled = d.fixed.index_add(0, d.cells, theta.index_select(0, d.sources) * d.factors)
        gradient, force = filled.view(2, -1, n).unbind(0)
        self.structure = d.structure
        if len(d.damped):
            diagonal = theta.index_select(0, d.damping)
            self.structure = d.structure.reshape(-1).index_add(0, d.damped, diagonal, alpha=-1).view(n, n)
        self.C = torch.addmm(force, gradient, self.structure) if d.has_energy else force
        if d.needs_efforts:
            self.C = torch.cat((self.C, gradient), 1)
        self.values = dict(zip(d.read, theta.index_select(0, d.read_at).unbind(0), strict=True)) if d.read else {}

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        d = self.d
        both = combination(x, z, self.C, d.basis) if features is None else features @ self.C
        dx, efforts = both.split(d.model.n_states, 1) if d.needs_efforts else (both, None)
        if d.others:
            dx = self._with_others(x, z, dx, efforts)
        if self.layers:
            dx = self._with_network(x, z, dx)
        return dx

    def _with_others(self, x: Tensor, z: Tensor | None, dx: Tensor, efforts: Tensor | None) -> Tensor:
        d, slots = self.d, {slot for slot, _, _ in self.d.others}
        if "H" in slots:
            extra = self._other_efforts(x)
            dx, efforts = dx + extra @ self.structure, None if efforts is None else efforts + extra
        if slots == {"H"}:
            return dx
        n = d.model.n_states
        known = dict(zip(d.variables[n:], () if z is None else z.unbind(1), strict=True))
        if d.reads_states:
            known.update(zip(d.model.states, x.unbind(1), strict=True))
        if efforts is not None:
            known.update(zip(d.model.efforts, efforts.unbind(1), strict=True))
        columns: dict[int, Tensor] = {}
        for slot, equation, term in d.others:
            if slot != "H":
                i = d.model.index(equation)
                value = self._value(term, place_of(slot, equation), known)
                value = -value * known[d.model.efforts[i]] if slot == "R" else value
                columns[i] = columns[i] + value if i in columns else value
        added = torch.stack([torch.as_tensor(column).expand(len(x)) for column in columns.values()], 1)
        return dx.index_add(1, torch.tensor(list(columns)), added.to(dx.dtype))

    def _other_efforts(self, x: Tensor) -> Tensor:
        """Gradient of the terms of the energy that are not monomials, by torch."""
        with torch.enable_grad():
            x = x if x.requires_grad else x.detach().requires_grad_()
            known = dict(zip(self.d.model.states, x.unbind(1), strict=True))
            energy = sum(
                (self._value(t, "H", known) for slot, _, t in self.d.others if slot == "H"), start=0.0 * x[:, 0]
            )
            (gradient,) = torch.autograd.grad(energy.sum(), x, create_graph=True)
        return gradient

    def _value(self, term: Term, place: str, known: Mapping[str, Any]) -> Any:
        inner = {name: self.values[term.inner_name(name, place)] for name in term.inner}
        body = evaluate(term.body, {**known, **inner}, FUNCTIONS)
        return body if term.is_formula else self.values[term.coefficient_name(place)] * body

    def _with_network(self, x: Tensor, z: Tensor | None, dx: Tensor) -> Tensor:
        seen = (x if z is None else torch.cat((x, z), 1)).index_select(1, self.d.seen)
        assert self.d.force is not None
        self.forces.append(relu_network(self.layers, seen, self.d.force.first))
        return dx.index_add(1, self.d.rows, self.forces[-1])


# ---- the defects of a batch ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Call:
    """One evaluation of the right-hand side by a scheme: where its inputs and its features are kept, if they are."""

    outside: int | None
    features: int | None


def _one_way(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
    # SRK4 is the mean of this over both directions of time: both go through as rows of one batch.
    c1, c2 = 0.5 - sqrt(3) / 6, 0.5 + sqrt(3) / 6
    return g((x0 + x1) / 2 - sqrt(3) / 6 * h * g(c1 * x0 + c2 * x1, c2), c1)


class Steps:
    """Defects (x1 - x0)/h - Psi of intervals, for any scheme of `phsi_opt.integrators`.

    ``arrays`` are pairs of a table and its rows per interval; ``defects(flat, tables)`` are those of a batch,
    (n_intervals, n_states). A first run of the scheme over all data finds the evaluations at the data alone.
    """

    def __init__(self, grid: Grid, scheme: str, dynamics: Dynamics, dtype: torch.dtype) -> None:
        self.dynamics, self.n_intervals, self.n_states = dynamics, grid.n_intervals, grid.y.shape[1]
        self.both_ways = scheme == "srk4"
        self.psi = _one_way if self.both_ways else integrator(scheme).psi
        rows = 2 if self.both_ways else 1
        end = grid.begin + 1
        x0, x1, h, t0 = grid.y[grid.begin], grid.y[end], grid.h[:, None], grid.t[grid.begin][:, None]

        def table(forth: np.ndarray, back: np.ndarray) -> np.ndarray:
            return np.stack((forth, back), 1).reshape(len(forth) * 2, -1) if self.both_ways else forth

        self._x0, self._x1, self._h = table(x0, x1), table(x1, x0), table(h, -h)
        ends = (np.hstack((grid.u0, t0)), np.hstack((grid.u1, t0 + h)))
        self._z0, self._z1 = table(*ends)[:, dynamics.outside], table(*ends[::-1])[:, dynamics.outside]
        made = [torch.tensor(a, dtype=dtype) for a in (grid.rates(grid.y), self._x0, self._x1, self._h)]
        self.arrays: list[tuple[Tensor, int]] = [(made[0], 1), *((table, rows) for table in made[1:])]
        self.calls: list[_Call] = []
        self.psi(self._record, *made[1:])

    def _record(self, x: Tensor, c: float) -> Tensor:
        rows = self.arrays[1][1]
        z, outside, kept = None, None, None
        if self.dynamics.outside:
            outside, z = len(self.arrays), torch.tensor(self._z0 + c * (self._z1 - self._z0), dtype=x.dtype)
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

    def defects(self, flat: Tensor, tables: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Defects of a batch (n_intervals, n_states), and what the force network gave."""
        calls, f = iter(self.calls), self.dynamics.at(flat)

        def g(x: Tensor, c: float) -> Tensor:
            call = next(calls)
            z = None if call.outside is None else tables[call.outside]
            return f(x, z, None if call.features is None else tables[call.features])

        rate, x0, x1, h = tables[:4]
        psi = self.psi(g, x0, x1, h)
        return rate - (psi.view(-1, 2, self.n_states).mean(1) if self.both_ways else psi), f.forces

    def loss(self, flat: Tensor, tables: Sequence[Tensor], penalty: float = 0.0) -> Tensor:
        """(1/b) sum |defect|^2, plus ``penalty`` times the mean of |F| of the force network."""
        d, forces = self.defects(flat, tables)
        value = d.square().sum() / d.shape[0]
        return value + penalty * forces[-1].abs().mean() if penalty and forces else value


# ---- descent ---------------------------------------------------------------------------------------------------------


class Adam:
    """Adam (Kingma and Ba 2015) on one flat vector: few operations per step, whatever the number of parameters.

    ``moving`` is one where a parameter may move, zero where it is held.
    """

    def __init__(self, flat: Tensor, weight_decay: float = 0.0) -> None:
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
        """One step down; ``l1`` are the weights of |parameter|. The gradient is used up."""
        self.steps += 1
        if self.weight_decay:
            gradient.add_(self.raw, alpha=self.weight_decay)
        if l1 is not None:
            gradient.addcmul_(l1, self.raw.sign())
        if self.moving is not None:
            gradient.mul_(self.moving)
        self.mean.lerp_(gradient, 1 - BETAS[0])
        self.square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
        size = self.square.sqrt().mul_(1 / sqrt(1 - BETAS[1] ** self.steps)).add_(EPSILON)
        self.raw.addcdiv_(self.mean, size, value=-rate / (1 - BETAS[0] ** self.steps))


def batches(
    arrays: Sequence[tuple[Tensor, int]], n: int, size: int, generator: torch.Generator
) -> Iterator[list[Tensor]]:
    """One epoch: the intervals in a new order, ``size`` at a time; tables are shuffled once, then sliced."""
    order = torch.randperm(n, generator=generator)
    shuffled = [(table.view(n, -1).index_select(0, order).view(table.shape), rows) for table, rows in arrays]
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
    """Adam over shuffled batches (thesis Algorithm 6); returns the history (epoch, loss, n_terms).

    Args:
        loss: of the parameters and the tables of a batch. n: number of intervals.
        settings: with learning_rate, epochs and batch. rate, l1: learning rate and L1 weights of an epoch.
        after_step, after_epoch: projection; pruning, which returns the number of terms that are left.

    Raises `SolveError` when the loss is no longer finite.
    """
    history = []
    for epoch in range(1, settings.epochs + 1):
        speed, weights = settings.learning_rate if rate is None else rate(epoch), None if l1 is None else l1(epoch)
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
        if progress is not None and (epoch % max(1, settings.epochs // 20) == 0 or epoch == settings.epochs):
            progress(f"epoch {epoch} of {settings.epochs}: loss {mean:.4g}, {n_terms} terms")
    return pd.DataFrame(history, columns=["epoch", "loss", "n_terms"])


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch inside: small batches are slower with more, and the order of sums is always the same."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# ---- the method ------------------------------------------------------------------------------------------------------


def gradient_descent(
    model: Model,
    data: Measurements,
    settings: Descent | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    force: NeuralForce | None = None,
) -> Baseline:
    """Minimise (1/m) sum |(x1 - x0)/h - Psi|^2 + sum lambda |xi| by Adam with pruning (thesis Eq. 5.6, Algorithm 6).

    Args:
        model: `PseudoHamiltonian` (PHSI) or `FirstOrder` (the thesis' BSI), with any dictionaries.
        data: every state measured; an interval with a missing end is left out.
        settings: see `Descent`; None takes its defaults. seed: of the order of the batches and of a random start.
        progress: called with a line of text every few epochs.
        force: a force by a network, trained with the rest; the result is then a `HybridBaseline`.

    Terms that were pruned are not in the model of the result; ``removed`` names them. Its ``loss_value`` is the loss
    over all data without penalties. Raises `DataError` if data and model do not match, `ModelError` for a model without
    parameters, `SolveError` if the loss diverges or if the whole energy was pruned.
    """
    began = time.perf_counter()
    settings = settings or Descent()
    if not model.free and force is None:
        raise ModelError("the model has no free parameter, so there is nothing to identify.")
    record = matched(model, data)
    grid = complete(model, grid_of(record))
    with one_thread():
        task = _Task(model, grid, settings, seed, force)
        history = task.run(progress)
        result = task.result(record.hold, history)
        return replace(result, seconds=time.perf_counter() - began)


class _Task:
    """One descent: the parameters, what is held, and what was pruned."""

    def __init__(self, model: Model, grid: Grid, settings: Descent, seed: int, force: NeuralForce | None) -> None:
        self.model, self.grid, self.settings, self.force = model, grid, settings, force
        self.dtype = DTYPES[settings.dtype]
        self.dynamics = DictionaryDynamics(model, self.dtype, force)
        self.steps = Steps(grid, settings.integrator, self.dynamics, self.dtype)
        self.generator = torch.Generator().manual_seed(seed)
        self.entries = list(model.entries.values())
        theta = torch.tensor(starting_values(model, settings, seed), dtype=self.dtype)
        network = self.dynamics.network
        weights: list[Tensor] = [network.start(self.generator, self.dtype)] if network else []
        self.adam = Adam(torch.cat([theta, *weights]).requires_grad_(), settings.weight_decay)
        self.theta = self.adam.raw[: len(self.entries)]
        self.held = np.array([e.parameter.fixed for e in self.entries], dtype=bool)
        self.removed: list[str] = []
        self._bound()
        self._hold()

    def _bound(self) -> None:
        kept = [e.slot != "R" or self.settings.keep_damping_positive for e in self.entries]
        bounds = [(e.parameter.lower, e.parameter.upper) for e in self.entries]
        self.lower, self.upper = (
            torch.tensor([b[i] if k else free for b, k in zip(bounds, kept, strict=True)], dtype=self.dtype)
            for i, free in ((0, -np.inf), (1, np.inf))
        )

    def _hold(self) -> None:
        held = torch.zeros(len(self.adam.raw), dtype=torch.bool)
        held[: len(self.held)] = torch.tensor(self.held)
        self.adam.hold(held)
        bounded = np.isfinite(self.lower.numpy()) | np.isfinite(self.upper.numpy())
        self.projects = bool(np.any(bounded & ~self.held))

    def run(self, progress: Progress | None) -> pd.DataFrame:
        penalty = self.force.penalty if self.force else 0.0
        return descend(
            self.adam, lambda flat, tables: self.steps.loss(flat, tables, penalty), self.steps.arrays,
            self.steps.n_intervals, self.settings, self.generator,
            l1=self._l1, after_step=self._project, after_epoch=self._prune, progress=progress,
        )  # fmt: skip

    def _l1(self, epoch: int) -> Tensor | None:
        weights, off = dict(self.settings.l1), self.settings.l1_off_after
        if off is not None and epoch > off * self.settings.epochs:
            weights.pop("H", None)
        if not any(weights.values()):
            return None
        result = torch.zeros_like(self.adam.raw)
        result[: len(self.entries)] = torch.tensor([weights.get(e.slot, 0.0) * e.prunable for e in self.entries])
        return result

    def _project(self) -> None:
        if self.projects:
            self.theta.clamp_(self.lower, self.upper)

    def _prune(self, epoch: int) -> int:
        if self.settings.prune_every is not None and epoch % self.settings.prune_every == 0:
            for i, entry in enumerate(self.entries):
                small = abs(float(self.theta[i])) < self.settings.threshold
                if entry.prunable and entry.slot in self.settings.prune_slots and small and not self.held[i]:
                    self.removed.append(entry.name)
                    self.held[i], self.theta[i], self.lower[i], self.upper[i] = True, 0.0, -np.inf, np.inf
            self._hold()
        return sum(e.prunable for e in self.entries) - len(self.removed)

    def result(self, hold: str, history: pd.DataFrame) -> Baseline:
        values = dict(zip(self.dynamics.names, self.theta.tolist(), strict=True))
        if self.model.H.terms and all(
            not t.is_formula and t.coefficient_name("H") in self.removed for t in self.model.H
        ):
            raise SolveError(
                f"pruning removed every term of H: all fell below threshold={self.settings.threshold:g}. Take a "
                "smaller threshold, prune later (prune_every) or train longer."
            )
        kept = _released(self.model, values).without(set(self.removed))
        kept = kept.with_values({name: value for name, value in values.items() if name in kept.entries})
        network = self.adam.raw[len(self.entries) :].to(torch.float64)
        common: dict[str, Any] = {
            "model": kept, "hold": hold, "removed": tuple(self.removed), "settings": str(self.settings),
            "loss_value": phsi_loss(kept, self.grid, self.settings.integrator, self.force, network), "history": history,
        }  # fmt: skip
        if self.force is None:
            return Baseline(method="gradient descent", **common)
        assert self.dynamics.network is not None
        layers = self.dynamics.network.layers(network.split(self.dynamics.network.sizes))
        arrays = tuple((weight.numpy().copy(), bias.numpy().copy()) for weight, bias in layers)
        return HybridBaseline(method="gradient descent with a neural force", neural=self.force, layers=arrays, **common)


def phsi_loss(
    model: Model, grid: Grid, scheme: str, force: NeuralForce | None = None, network: Tensor | None = None
) -> float:
    """(1/m) sum |(x1 - x0)/h - Psi|^2 over all intervals at the model's values, in double precision (Eq. 5.6)."""
    dynamics = DictionaryDynamics(model, torch.float64, force)
    steps = Steps(grid, scheme, dynamics, torch.float64)
    theta = torch.tensor([model.values[name] for name in dynamics.names], dtype=torch.float64)
    flat = theta if network is None else torch.cat((theta, network))
    return float(steps.loss(flat, steps.all_tables()).detach())


def starting_values(model: Model, settings: Descent, seed: int) -> np.ndarray:
    """Where the descent starts, a value per parameter in the order of ``model.entries``; see `Descent`."""
    rng, entries = np.random.default_rng(seed), model.entries
    variables = (*model.states, *model.inputs, "t")
    kind: dict[str, float] = {}
    for slot, equation, term in model.placed():
        if not term.is_formula:
            polynomial = not term.inner and monomial(term.body, variables) is not None
            value = 0.0 if slot == "R" else POLYNOMIAL_START if polynomial else FUNCTION_START
            kind[term.coefficient_name(place_of(slot, equation))] = value
    values = []
    for name, entry in entries.items():
        parameter, draw = entry.parameter, NORMAL_START * rng.normal()
        given = parameter.fixed or (parameter.value is not None and not entry.prunable)
        if given or settings.start == "model":
            values.append(parameter.start)
            continue
        # A number that may not be negative starts at the size of the draw: at its bound of zero nothing would move.
        drawn = abs(draw) if parameter.lower == 0 and entry.slot != "R" else draw
        value = drawn if settings.start == "normal" else kind.get(name, FUNCTION_START)
        free = entry.slot == "R" and not settings.keep_damping_positive
        values.append(value if free else float(np.clip(value, parameter.lower, parameter.upper)))
    return np.array(values)


def _released(model: Model, values: Mapping[str, float]) -> Model:
    """The model without the bounds of a damping that has left them, or the record could not hold its value."""

    def opened(term: Term, place: str) -> Term:
        coefficient = term.coefficient
        if coefficient is None:
            return term
        value = values[term.coefficient_name(place)]
        if not coefficient.lower <= value <= coefficient.upper and not coefficient.fixed:
            coefficient = replace(coefficient, lower=-np.inf, upper=np.inf)
        return replace(term, coefficient=coefficient)

    changed = {
        name: Dictionary(tuple(opened(term, place_of("R", name)) for term in terms)) for name, terms in model.R.items()
    }
    return replace(model, R=changed)


# ---- the hybrid's result ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class HybridBaseline(Baseline):
    """dx/dt = dictionary model + force network in the equations of ``neural`` (the thesis' hybrid, Section 6.4).

    ``model``, its tables and `sympy` hold the dictionary part alone; `simulate` and `equations` know both.
    """

    neural: NeuralForce
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    def force(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """The network's force (n, n_equations) at states x (n, n_states), times t (n,) and inputs u (n, n_inputs)."""
        states = np.atleast_2d(np.asarray(x, dtype=float))
        if states.ndim != 2 or states.shape[1] != self.model.n_states:
            raise DataError(f"x has shape {np.shape(x)}; expected (n, {self.model.n_states}), a column per state.")
        known: dict[str, Any] = dict(zip(self.model.states, states.T, strict=True))
        known["t"] = t
        known.update(
            zip(self.model.inputs, [None] * self.model.n_inputs if u is None else np.atleast_2d(u).T, strict=True)
        )
        for name in self.neural.variables:
            if known[name] is None:
                raise DataError(f"the force depends on {name!r}; give {'t' if name == 't' else 'u'} beside x.")
        v = np.stack([np.broadcast_to(known[name], len(states)) for name in self.neural.variables], 1)
        return network_values(self.layers, v, self.neural.first)

    def without_force(self) -> Baseline:
        """The dictionary model alone; its loss is not that of the training and is left NaN."""
        return Baseline(
            model=self.model, hold=self.hold, seconds=self.seconds, removed=self.removed, history=self.history,
            settings=self.settings, method=f"{self.method}, left out",
        )  # fmt: skip

    def equations(self) -> list[str]:
        """The right-hand sides, the network by the name ``network``."""
        inside = ", ".join(self.neural.variables)
        return [
            f"{text} + network_{name}({inside})" if name in self.neural.equations else text
            for name, text in zip(self.model.states, super().equations(), strict=True)
        ]

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0] with the network's force; u is (n_samples, n_inputs)."""
        f, rows = self.casadi(), [self.model.index(name) for name in self.neural.equations]
        at = input_of(np.asarray(t, dtype=float), u, self.model.n_inputs, self.hold)

        def rhs(time: float, x: np.ndarray) -> np.ndarray:
            now = at(time)
            dx = np.array(f(x, now, time)).ravel()
            dx[rows] += self.force(x[None, :], time, now[None, :])[0]
            return dx

        return integrated(rhs, t, x0, self.model.states)


def network_values(layers: Sequence[tuple[np.ndarray, np.ndarray]], v: np.ndarray, first: str = "relu") -> np.ndarray:
    """The same as `relu_network` in NumPy, (n_rows, n_outputs)."""
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = v @ weight + bias
        v = np.tanh(v) if i == 0 and first == "tanh" else np.maximum(v, 0.0)
    result: np.ndarray = v @ layers[-1][0] + layers[-1][1]
    return result


def input_of(t: np.ndarray, u: Any, n_inputs: int, hold: str) -> Callable[[float], np.ndarray]:
    """The inputs (n_samples, n_inputs) at t as a function of time, held as the measurements declared."""
    values = np.zeros((len(t), 0)) if u is None else np.asarray(u, dtype=float)
    if values.shape != (len(t), n_inputs):
        raise DataError(f"u has shape {values.shape}; expected ({len(t)}, {n_inputs}), a row per time.")
    if hold == "zero":
        return lambda at: np.asarray(values[np.clip(np.searchsorted(t, at, "right") - 1, 0, len(t) - 1)])
    return lambda at: np.array([np.interp(at, t, column) for column in values.T])


def integrated(rhs: Callable[[float, np.ndarray], np.ndarray], t: Any, x0: Any, states: Sequence[str]) -> np.ndarray:
    """Solve dx/dt = rhs(t, x) by SciPy's LSODA; (n_samples, n_states). Raises `DataError` and `SolveError`."""
    times, start = np.asarray(t, dtype=float), np.asarray(x0, dtype=float)
    if times.ndim != 1 or len(times) < 2 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise DataError(f"t of shape {times.shape} must be at least two finite, strictly increasing times.")
    if start.shape != (len(states),) or not np.all(np.isfinite(start)):
        raise DataError(f"x0={x0!r} must be {len(states)} finite numbers, one per state ({', '.join(states)}).")
    atol = ATOL * max(float(np.max(np.abs(start))), 1e-3)
    longest = float(np.max(np.diff(times)))
    with np.errstate(all="ignore"):
        solved = solve_ivp(
            rhs, (times[0], times[-1]), start, "LSODA", t_eval=times, rtol=RTOL, atol=atol, max_step=longest
        )
    if not solved.success or not np.all(np.isfinite(solved.y)) or solved.y.shape[1] < len(times):
        reached = solved.t[-1] if len(solved.t) else times[0]
        raise SolveError(f"the simulation cannot be continued beyond t={reached:g}: {solved.message}")
    result: np.ndarray = solved.y.T
    return result
