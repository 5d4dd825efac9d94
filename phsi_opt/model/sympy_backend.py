"""SymPy as a library in which formulas are evaluated; slow to import."""

from functools import reduce
from math import comb, prod
from typing import Any

import sympy as sp
from sympy.printing.str import StrPrinter

from phsi_opt.model.expressions import Backend, functions_of


def _delayed(signal: Any, delay: Any) -> Any:
    return sp.Function(signal.name, real=True)(sp.Symbol("t", real=True) - delay)


SYMPY = Backend(
    {**functions_of(sp, abs="Abs", min="Min", max="Max"), "delayed": _delayed},
    number=sp.sympify,
    constants={"pi": sp.pi},
)


class _FormulaPrinter(StrPrinter):
    """Writes expressions as formulas that ``expressions`` reads."""

    def _print(self, expression: Any, **kwargs: Any) -> str:
        match expression:
            case sp.Float() if expression._prec >= sp.Float(1.0)._prec:
                return repr(float(expression))
            case sp.NumberSymbol() if expression is not sp.pi:
                return repr(float(expression))
            case sp.Max() | sp.Min():  # a formula's maximum is of two
                name = type(expression).__name__.lower()
                parts = map(self._print, expression.args)
                return reduce(lambda one, other: f"{name}({one}, {other})", parts)
            case sp.Function():
                name = type(expression).__name__.replace("Abs", "abs")
                return f"{name}({', '.join(map(self._print, expression.args))})"
        return str(super()._print(expression, **kwargs))


def formula_text(expression: sp.Expr) -> str:
    """An expression as a formula."""
    return str(_FormulaPrinter().doprint(expression))


def without_steps(expression: sp.Expr) -> sp.Expr:
    """The slope of max(a, 0)^n in which no step is written beside max(a, 0)."""

    def shortened(product: sp.Mul) -> sp.Expr:
        corners = {one.args for one in product.atoms(sp.Max)}
        kept = []
        for factor in product.args:
            is_step = isinstance(factor, sp.Heaviside)
            if not is_step or sp.Max(0, factor.args[0]).args not in corners:
                kept.append(factor)
        return sp.Mul(*kept)

    return expression.replace(lambda one: one.is_Mul, shortened)


def n_expanded(expression: sp.Expr) -> int:
    """Terms of an expression after it is multiplied out, at most; 1 for one term.

    The largest number of it and of what stands inside its functions.
    """
    parts = list(map(n_expanded, expression.args))
    if expression.is_Add:
        return sum(parts)
    if expression.is_Mul:
        return prod(parts)
    if expression.is_Pow and expression.exp.is_Integer:
        n, power = parts[0], abs(int(expression.exp))
        return comb(n + power - 1, power)
    return max(parts, default=1)
