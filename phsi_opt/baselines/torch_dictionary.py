"""Models of the package in torch: dx/dt = (S - R) grad H + F with all parameters in one
flat vector.

Monomials are one matrix product: the gradient of a polynomial energy is B(x) W(xi) with
B the monomials of lower degree and W linear in the coefficients. Other terms are
evaluated from their text.
"""

import ast
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from phsi_opt.baselines.descent_settings import JointForce, is_count
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.expressions import evaluate, names_of, parse
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Term


def _tensors(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    # Numbers of a formula in double precision: they do not change the type of the
    # columns they meet.
    return lambda *arguments: function(
        *(
            a if isinstance(a, Tensor) else torch.tensor(a, dtype=torch.float64)
            for a in arguments
        )
    )


FUNCTIONS = {
    "sin": _tensors(torch.sin),
    "cos": _tensors(torch.cos),
    "tan": _tensors(torch.tan),
    "atan": _tensors(torch.atan),
    "exp": _tensors(torch.exp),
    "log": _tensors(torch.log),
    "sqrt": _tensors(torch.sqrt),
    "tanh": _tensors(torch.tanh),
    "abs": _tensors(torch.abs),
    "sign": _tensors(torch.sign),
    "min": _tensors(torch.minimum),
    "max": _tensors(torch.maximum),
}


# ---- monomials -------------------------------------------------------------------------------------------------------


def monomial(body: str, variables: Sequence[str]) -> tuple[int, ...] | None:
    """Exponents of a body that is a product of powers of the variables (or 1), else
    None.
    """
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
    if (
        isinstance(node.op, ast.Pow)
        and isinstance(node.left, ast.Name)
        and isinstance(node.right, ast.Constant)
    ):
        return {node.left.id: node.right.value} if is_count(node.right.value) else None  # type: ignore[dict-item]
    left, right = (
        _powers(part) if isinstance(node.op, ast.Mult) else None
        for part in (node.left, node.right)
    )
    if left is None or right is None:
        return None
    return {name: left.get(name, 0) + right.get(name, 0) for name in {**left, **right}}


def lowered(exponents: tuple[int, ...], k: int) -> tuple[int, ...]:
    """The monomial divided by its variable k."""
    return tuple(e - (i == k) for i, e in enumerate(exponents))


class Basis:
    """Monomials of variables v, closed under division by a variable, so that each is a
    product of two others.

    ``features(v)``: (n_rows, n_variables) -> (n_rows, n_monomials). Only the first
    ``n_states`` variables have a derivative.
    """

    def __init__(
        self,
        exponents: Iterable[tuple[int, ...]],
        n_variables: int,
        n_states: int,
        dtype: torch.dtype,
    ) -> None:
        closed, left = {(0,) * n_variables}, list(exponents)
        while left:
            one = left.pop()
            if one not in closed:
                closed.add(one)
                left += [lowered(one, k) for k in range(n_variables) if one[k]]
        by_degree = [
            sorted((e for e in closed if sum(e) == degree), reverse=True)
            for degree in range(max(map(sum, closed)) + 1)
        ]
        self.position = {
            e: i for i, e in enumerate(e for level in by_degree for e in level)
        }
        self.levels = []
        for before, level in pairwise(by_degree):
            variable = [next(k for k, power in enumerate(e) if power) for e in level]
            parent = [
                before.index(lowered(e, k))
                for e, k in zip(level, variable, strict=True)
            ]
            self.levels.append((torch.tensor(parent), torch.tensor(variable)))
        self.all_linear = bool(self.levels) and self.levels[0][1].tolist() == list(
            range(n_variables)
        )
        pairs = [(e, k) for e in self.position for k in range(n_states) if e[k]]
        self.upper = torch.tensor(
            [self.position[e] for e, _ in pairs], dtype=torch.long
        )
        self.lower = torch.tensor(
            [self.position[lowered(e, k)] for e, k in pairs], dtype=torch.long
        )
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
                parts.append(
                    parts[-1].index_select(1, parent) * v.index_select(1, variable)
                )
        return torch.cat(parts, 1)

    def pulled_back(self, gradient: Tensor, features: Tensor) -> Tensor:
        """Gradient with respect to the states from that with respect to the monomials."""
        return (
            gradient.index_select(1, self.upper) * features.index_select(1, self.lower)
        ) @ self.slope


class Combination(torch.autograd.Function):
    """``basis.features([x, z]) @ C`` with its derivative by x and C written out: two
    nodes instead of a dozen.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, z: Tensor | None, C: Tensor, basis: Basis
    ) -> Tensor:
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
        return (
            ctx.basis.pulled_back(gradient @ C.t(), features),
            None,
            features.t() @ gradient,
            None,
        )


def combination(x: Tensor, z: Tensor | None, C: Tensor, basis: Basis) -> Tensor:
    """``basis.features([x, z]) @ C``, differentiable by x and C."""
    value: Tensor = Combination.apply(x, z, C, basis)
    return value


# ---- networks --------------------------------------------------------------------------------------------------------


class Network:
    """Where the weights of a fully connected network stand in a flat vector of
    parameters.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        self.shapes = [s for n, m in pairwise(widths) for s in ((n, m), (m,))]
        self.sizes = [int(np.prod(shape)) for shape in self.shapes]

    def start(self, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
        """Uniform within +-1/sqrt(number of inputs), weights and biases alike (torch's
        own start of a linear layer).
        """
        parts = []
        for i, size in enumerate(self.sizes):
            bound = 1 / sqrt(self.shapes[i - i % 2][0])
            parts.append(
                (2 * torch.rand(size, generator=generator, dtype=torch.float64) - 1)
                * bound
            )
        return torch.cat(parts).to(dtype)

    def layers(self, parts: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
        """(weight (n_in, n_out), bias) of every layer from the pieces of the flat
        vector.
        """
        shaped = [
            part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)
        ]
        return list(zip(shaped[::2], shaped[1::2], strict=True))


def relu_network(
    layers: Sequence[tuple[Any, Any]], v: Tensor, first: str = "relu"
) -> Tensor:
    """Value of a network with ReLU between its layers, or tanh after the first,
    (n_rows, n_outputs).
    """
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = torch.addmm(bias, v, weight)
        v = v.tanh() if i == 0 and first == "tanh" else v.relu()
    return torch.addmm(layers[-1][1], v, layers[-1][0])


# ---- the right-hand side ---------------------------------------------------------------------------------------------


class DictionaryDynamics:
    """A model of the package in torch: dx/dt = (S - R) grad H + F, all parameters in
    one flat vector.

    The vector holds every parameter of ``model.entries`` in their order, then the
    weights of the force network.
    """

    def __init__(
        self, model: Model, dtype: torch.dtype, force: JointForce | None = None
    ) -> None:
        self.model, self.dtype, self.force = model, dtype, force
        self.names = list(model.entries)
        used = set().union(
            *(names_of(term.body) for _, _, term in model.placed()),
            force.variables if force else (),
        )
        around = (*model.inputs, "t")
        self.outside = [i for i, name in enumerate(around) if name in used]
        self.variables = (*model.states, *(around[i] for i in self.outside))
        self.others: list[tuple[str, str, Term]] = []
        self._sort_terms()
        self.network: Network | None = None
        if force is not None:
            self._place_force(force)

    def _sort_terms(self) -> None:
        """Monomials go into matrices, constant damping onto a diagonal, the rest is
        evaluated from its text.
        """
        n, index = self.model.n_states, {name: i for i, name in enumerate(self.names)}
        energy, force, diagonal = [], [], []
        for slot, equation, term in self.model.placed():
            exponents = (
                None
                if term.is_formula or term.inner
                else monomial(term.body, self.variables)
            )
            where = (
                None
                if exponents is None
                else index[term.coefficient_name(place_of(slot, equation))]
            )
            if exponents is None or (slot == "R" and any(exponents)):
                self.others.append((slot, equation, term))
            elif slot == "H":
                energy += [
                    (lowered(exponents, k), k, where, float(exponents[k]))
                    for k in range(n)
                    if exponents[k]
                ]
            elif slot == "F":
                force.append((exponents, self.model.index(equation), where, 1.0))
            else:
                diagonal.append((self.model.index(equation), where))
        self.needs_efforts = any(
            slot == "R" or names_of(term.body) & set(self.model.efforts)
            for slot, _, term in self.others
        )
        placed = [
            (place_of(slot, equation), term) for slot, equation, term in self.others
        ]
        read = [
            term.inner_name(name, place)
            for place, term in placed
            for name in term.inner
        ]
        read += [
            term.coefficient_name(place)
            for place, term in placed
            if not term.is_formula
        ]
        self.read = list(
            dict.fromkeys(read)
        )  # parameters of the terms that are evaluated from their text
        self.read_at = torch.tensor(
            [index[name] for name in self.read], dtype=torch.long
        )
        self.reads_states = any(
            slot == "R" or names_of(term.body) & set(self.model.states)
            for slot, _, term in self.others
            if slot != "H"
        )
        self.has_energy = (
            isinstance(self.model, PseudoHamiltonian)
            or bool(diagonal)
            or self.needs_efforts
        )
        self._place_matrices(energy, force, diagonal)

    def _place_matrices(
        self, energy: list[Any], force: list[Any], diagonal: list[Any]
    ) -> None:
        n = self.model.n_states
        units = [
            tuple(int(i == k) for i in range(len(self.variables))) for k in range(n)
        ]
        identity = (
            isinstance(self.model, FirstOrder) and self.has_energy
        )  # its efforts are the states
        self.basis = Basis(
            [e for e, *_ in energy + force] + (units if identity else []),
            len(self.variables),
            n,
            self.dtype,
        )
        size, position = len(self.basis) * n, self.basis.position
        self.fixed = torch.zeros(2 * size, dtype=self.dtype)
        if identity:
            self.fixed[[position[unit] * n + k for k, unit in enumerate(units)]] = 1.0
        cells = [position[e] * n + k for e, k, _, _ in energy] + [
            size + position[e] * n + k for e, k, _, _ in force
        ]
        self.cells = torch.tensor(cells, dtype=torch.long)
        self.sources = torch.tensor(
            [row[2] for row in energy + force], dtype=torch.long
        )
        self.factors = torch.tensor(
            [row[3] for row in energy + force], dtype=self.dtype
        )
        self.structure = torch.tensor(np.array(self.model.S).T.copy(), dtype=self.dtype)
        self.damped = torch.tensor([i * n + i for i, _ in diagonal], dtype=torch.long)
        self.damping = torch.tensor([where for _, where in diagonal], dtype=torch.long)

    def _place_force(self, force: JointForce) -> None:
        for name in force.variables:
            if name not in self.variables:
                known = (*self.model.states, *self.model.inputs, "t")
                raise ModelError(
                    f"variable {name!r} of the neural force is unknown; expected names among {', '.join(known)}."
                    f"{did_you_mean(name, known)}"
                )
        self.seen = torch.tensor(
            [self.variables.index(name) for name in force.variables]
        )
        self.rows = torch.tensor(
            [
                self.model.index(name, "equation of the neural force")
                for name in force.equations
            ]
        )
        self.network = Network(
            [len(force.variables), *force.hidden, len(force.equations)]
        )

    def features(self, x: Tensor, z: Tensor | None) -> Tensor:
        """The monomials, (n_rows, n_monomials)."""
        return self.basis.features(x if z is None else torch.cat((x, z), 1))

    def at(self, flat: Tensor) -> "DictionaryEvaluation":
        """The right-hand side at the parameters."""
        theta, *parts = (
            flat.split([len(self.names), *self.network.sizes])
            if self.network
            else [flat]
        )
        return DictionaryEvaluation(
            self, theta, self.network.layers(parts) if self.network else []
        )


class DictionaryEvaluation:
    """`DictionaryDynamics` at given parameters; the matrices are made once per step of
    training.
    """

    def __init__(
        self,
        dynamics: DictionaryDynamics,
        theta: Tensor,
        layers: list[tuple[Tensor, Tensor]],
    ) -> None:
        self.d, self.theta, self.layers, self.forces = (
            dynamics,
            theta,
            layers,
            list[Tensor](),
        )
        d, n = dynamics, dynamics.model.n_states
        filled = d.fixed.index_add(
            0, d.cells, theta.index_select(0, d.sources) * d.factors
        )
        gradient, force = filled.view(2, -1, n).unbind(0)
        self.structure = d.structure
        if len(d.damped):
            diagonal = theta.index_select(0, d.damping)
            self.structure = (
                d.structure.reshape(-1)
                .index_add(0, d.damped, diagonal, alpha=-1)
                .view(n, n)
            )
        self.C = torch.addmm(force, gradient, self.structure) if d.has_energy else force
        if d.needs_efforts:
            self.C = torch.cat((self.C, gradient), 1)
        self.values = (
            dict(zip(d.read, theta.index_select(0, d.read_at).unbind(0), strict=True))
            if d.read
            else {}
        )

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        d = self.d
        both = (
            combination(x, z, self.C, d.basis)
            if features is None
            else features @ self.C
        )
        dx, efforts = (
            both.split(d.model.n_states, 1) if d.needs_efforts else (both, None)
        )
        if d.others:
            dx = self._with_others(x, z, dx, efforts)
        if self.layers:
            dx = self._with_network(x, z, dx)
        return dx

    def _with_others(
        self, x: Tensor, z: Tensor | None, dx: Tensor, efforts: Tensor | None
    ) -> Tensor:
        d, slots = self.d, {slot for slot, _, _ in self.d.others}
        if "H" in slots:
            extra = self._other_efforts(x)
            dx, efforts = (
                dx + extra @ self.structure,
                None if efforts is None else efforts + extra,
            )
        if slots == {"H"}:
            return dx
        n = d.model.n_states
        known = dict(
            zip(d.variables[n:], () if z is None else z.unbind(1), strict=True)
        )
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
        added = torch.stack(
            [torch.as_tensor(column).expand(len(x)) for column in columns.values()], 1
        )
        return dx.index_add(1, torch.tensor(list(columns)), added.to(dx.dtype))

    def _other_efforts(self, x: Tensor) -> Tensor:
        """Gradient of the terms of the energy that are not monomials, by torch."""
        with torch.enable_grad():
            x = x if x.requires_grad else x.detach().requires_grad_()
            known = dict(zip(self.d.model.states, x.unbind(1), strict=True))
            energy = sum(
                (
                    self._value(t, "H", known)
                    for slot, _, t in self.d.others
                    if slot == "H"
                ),
                start=0.0 * x[:, 0],
            )
            (gradient,) = torch.autograd.grad(energy.sum(), x, create_graph=True)
        return gradient

    def _value(self, term: Term, place: str, known: Mapping[str, Any]) -> Any:
        inner = {name: self.values[term.inner_name(name, place)] for name in term.inner}
        body = evaluate(term.body, {**known, **inner}, FUNCTIONS)
        return (
            body
            if term.is_formula
            else self.values[term.coefficient_name(place)] * body
        )

    def _with_network(self, x: Tensor, z: Tensor | None, dx: Tensor) -> Tensor:
        seen = (x if z is None else torch.cat((x, z), 1)).index_select(1, self.d.seen)
        assert self.d.force is not None
        self.forces.append(relu_network(self.layers, seen, self.d.force.first))
        return dx.index_add(1, self.d.rows, self.forces[-1])
