"""Monomials in torch: all of a dictionary's at once, and what they are combined to.

A polynomial right-hand side is one matrix product, B(x) C with B the monomials and C
linear in the coefficients; its derivative by x needs the monomials of lower degree,
which the basis holds too.
"""

import ast
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from phsi_opt.baselines.descent_settings import is_count
from phsi_opt.baselines.torch_networks import joined
from phsi_opt.model.expressions import parse

Exponents = tuple[int, ...]  # one per variable


def monomial(body: str, variables: Sequence[str]) -> Exponents | None:
    """Exponents of a product of powers of the variables, or of 1; None otherwise."""
    powers = _powers(parse(body))
    if powers is None or not set(powers) <= set(variables):
        return None
    return tuple(powers.get(name, 0) for name in variables)


def _powers(node: ast.expr) -> dict[str, int] | None:
    """Exponent by name of an expression, None if it is no product of powers."""
    if isinstance(node, ast.Constant):
        return {} if node.value == 1 else None
    if isinstance(node, ast.Name):
        return {node.id: 1}
    if not isinstance(node, ast.BinOp):
        return None
    if isinstance(node.op, ast.Pow):
        return _power(node.left, node.right)
    if isinstance(node.op, ast.Mult):
        return _product(_powers(node.left), _powers(node.right))
    return None


def _power(base: ast.expr, exponent: ast.expr) -> dict[str, int] | None:
    if not isinstance(base, ast.Name) or not isinstance(exponent, ast.Constant):
        return None
    if not is_count(exponent.value):
        return None
    return {base.id: exponent.value}  # type: ignore[dict-item]


def _product(
    left: dict[str, int] | None, right: dict[str, int] | None
) -> dict[str, int] | None:
    if left is None or right is None:
        return None
    product = dict(left)
    for name, power in right.items():
        product[name] = product.get(name, 0) + power
    return product


def lowered(exponents: Exponents, k: int) -> Exponents:
    """The monomial divided by its variable k."""
    return (*exponents[:k], exponents[k] - 1, *exponents[k + 1 :])


def _closed(exponents: Iterable[Exponents], n_variables: int) -> set[Exponents]:
    """The monomials and all that divide them, the constant included."""
    closed = {(0,) * n_variables}
    waiting = list(exponents)
    while waiting:
        one = waiting.pop()
        if one in closed:
            continue
        closed.add(one)
        for k in range(n_variables):
            if one[k]:
                waiting.append(lowered(one, k))
    return closed


def _by_degree(closed: set[Exponents]) -> list[list[Exponents]]:
    highest = max(map(sum, closed))
    levels: list[list[Exponents]] = [[] for _ in range(highest + 1)]
    for exponents in sorted(closed, reverse=True):
        levels[sum(exponents)].append(exponents)
    return levels


class Basis:
    """Monomials of variables v, closed under division by a variable.

    Each is then a product of two others. Only the first ``n_states`` variables have a
    derivative.

    Args:
        exponents: of the monomials that are needed, a number per variable.
        n_variables: number of variables.
        n_states: number of variables with a derivative.
        dtype: of the derivative's factors.

    Attributes:
        position: column of each monomial in ``features(v)``.
    """

    def __init__(
        self,
        exponents: Iterable[Exponents],
        n_variables: int,
        n_states: int,
        dtype: torch.dtype,
    ) -> None:
        by_degree = _by_degree(_closed(exponents, n_variables))
        self.position: dict[Exponents, int] = {}
        for level in by_degree:
            for one in level:
                self.position[one] = len(self.position)
        self.levels: list[tuple[Tensor, Tensor]] = []
        for before, level in pairwise(by_degree):
            self.levels.append(self._factors(before, level))
        every = list(range(n_variables))
        self.all_linear = bool(self.levels) and self.levels[0][1].tolist() == every
        self._place_derivatives(n_states, dtype)

    @staticmethod
    def _factors(
        before: list[Exponents], level: list[Exponents]
    ) -> tuple[Tensor, Tensor]:
        """Of each monomial: its factor one degree lower, and its other factor."""
        parents = []
        variables = []
        for exponents in level:
            first = next(k for k, power in enumerate(exponents) if power)
            parents.append(before.index(lowered(exponents, first)))
            variables.append(first)
        return torch.tensor(parents), torch.tensor(variables)

    def _place_derivatives(self, n_states: int, dtype: torch.dtype) -> None:
        """d(monomial ``upper``)/dx_k = ``slope`` times the monomial ``lower``."""
        upper = []
        lower = []
        slopes = []
        for exponents, column in self.position.items():
            for k in range(n_states):
                if exponents[k]:
                    upper.append(column)
                    lower.append(self.position[lowered(exponents, k)])
                    slopes.append((k, exponents[k]))
        self.upper = torch.tensor(upper, dtype=torch.long)
        self.lower = torch.tensor(lower, dtype=torch.long)
        self.slope = torch.zeros((len(slopes), n_states), dtype=dtype)
        for row, (k, power) in enumerate(slopes):
            self.slope[row, k] = power

    def __len__(self) -> int:
        return len(self.position)

    def features(self, v: Tensor) -> Tensor:
        """All monomials of v (n_rows, n_variables), (n_rows, n_monomials)."""
        parts = [torch.ones((v.shape[0], 1), dtype=v.dtype)]
        for degree, (parent, variable) in enumerate(self.levels):
            if degree == 0:
                parts.append(v if self.all_linear else v.index_select(1, variable))
                continue
            factor = parts[-1].index_select(1, parent)
            parts.append(factor * v.index_select(1, variable))
        return torch.cat(parts, 1)

    def pulled_back(self, gradient: Tensor, features: Tensor) -> Tensor:
        """Gradient by the states from that by the monomials."""
        outer = gradient.index_select(1, self.upper)
        inner = features.index_select(1, self.lower)
        return (outer * inner) @ self.slope


class Combination(torch.autograd.Function):
    """``basis.features([x, z]) @ C`` with its derivative by x and C written out.

    Two nodes of the graph instead of a dozen.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, z: Tensor | None, C: Tensor, basis: Basis
    ) -> Tensor:
        """The value, (n_rows, n_columns of C)."""
        features = basis.features(joined(x, z))
        ctx.save_for_backward(features, C)
        ctx.basis = basis
        return features @ C

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, Tensor, None]:
        """The derivative by x and C."""
        features, C = ctx.saved_tensors
        by_x = ctx.basis.pulled_back(gradient @ C.t(), features)
        by_C = features.t() @ gradient
        return by_x, None, by_C, None


def combination(x: Tensor, z: Tensor | None, C: Tensor, basis: Basis) -> Tensor:
    """``basis.features([x, z]) @ C``, differentiable by x and C."""
    value: Tensor = Combination.apply(x, z, C, basis)
    return value
