"""Polynomials in torch: all monomials of a dictionary at once, times a matrix.

A polynomial right-hand side is one matrix product, B(v) C with B the monomials of the
variables v and C linear in the coefficients.
"""

import ast
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from phsi_opt.arguments import is_count
from phsi_opt.model.expressions import parse

Monomial = tuple[int, ...]  # numbers of its factors in order: q*q*p is (0, 0, 1)


def monomial(body: str, variables: Sequence[str]) -> Monomial | None:
    """A product of powers of the variables, or 1, by its factors; None otherwise."""
    factors = _factors(parse(body))
    if factors is None or not set(factors) <= set(variables):
        return None
    return tuple(sorted(map(list(variables).index, factors)))


def _factors(node: ast.expr) -> list[str] | None:
    """Names of the factors of an expression, None if it is no product of powers."""
    match node:
        case ast.Constant(value=1):
            return []
        case ast.Name(id=name):
            return [name]
        case ast.BinOp(ast.Name(id=name), ast.Pow(), ast.Constant(value=power)):
            return [name] * power if is_count(power) else None  # type: ignore[operator]
        case ast.BinOp(left, ast.Mult(), right):
            before = _factors(left)
            after = _factors(right)
            return None if before is None or after is None else before + after
    return None


@dataclass(frozen=True)
class Cell:
    """A coefficient in C: of which monomial, in which column, times what factor."""

    monomial: Monomial
    column: int
    parameter: int
    factor: float = 1.0


def gradient_cells(body: Monomial, parameter: int, n_variables: int) -> list[Cell]:
    """The derivative of a monomial by the first variables, the k-th in column k."""
    cells = []
    for k in range(n_variables):
        if k in body:
            place = body.index(k)
            lower = body[:place] + body[place + 1 :]
            cells.append(Cell(lower, k, parameter, float(body.count(k))))
    return cells


class Polynomials:
    """Columns of polynomials, B(v) C(theta).

    Args:
        cells: the coefficients in C.
        n_variables: number of the variables v; behind them v has a column of ones.
        n_columns: number of polynomials.
        dtype: of the values.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        n_variables: int,
        n_columns: int,
        dtype: torch.dtype,
    ) -> None:
        monomials = sorted({cell.monomial for cell in cells} | {()})
        degree = max(1, *map(len, monomials))
        padded = [body + (n_variables,) * (degree - len(body)) for body in monomials]
        self.factors = torch.tensor(padded).T.contiguous()  # (degree, n_monomials)
        table: list[tuple[float, ...]] = []  # place in C, parameter, factor
        for cell in cells:
            place = monomials.index(cell.monomial) * n_columns + cell.column
            table.append((place, cell.parameter, cell.factor))
        columns = torch.tensor(table, dtype=torch.float64).view(-1, 3).T.contiguous()
        self.places, self.parameters = columns[:2].long()
        self.scales = columns[2].to(dtype)
        self.empty = torch.zeros(len(monomials) * n_columns, dtype=dtype)
        self.n_columns = n_columns

    def features(self, v: Tensor) -> Tensor:
        """B: all monomials of v (n_rows, n_variables + 1), (n_rows, n_monomials)."""
        product = v.index_select(1, self.factors[0])
        for factor in self.factors[1:]:
            product = product * v.index_select(1, factor)
        return product

    def matrix(self, theta: Tensor) -> Tensor:
        """C at the parameters, (n_monomials, n_columns)."""
        values = theta.index_select(0, self.parameters) * self.scales
        return self.empty.index_add(0, self.places, values).view(-1, self.n_columns)
