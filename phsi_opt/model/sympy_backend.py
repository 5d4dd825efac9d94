"""SymPy as a library in which formulas are evaluated; slow to import."""

from math import comb, prod
from typing import Any

import sympy as sp
from sympy.printing.str import StrPrinter

from phsi_opt.model.expressions import Backend, functions_of

SYMPY = Backend(
    functions_of(sp, abs="Abs", min="Min", max="Max"),
    number=sp.sympify,
    constants={"pi": sp.pi},
)


class _FormulaPrinter(StrPrinter):
    """Writes expressions as formulas that ``expressions`` reads."""

    def _print_Float(self, number: Any) -> str:  # noqa: N802  (SymPy's name)
        is_rounded = number._prec < sp.Float(1.0)._prec
        return str(super()._print_Float(number)) if is_rounded else repr(float(number))

    def _print_Function(self, call: Any) -> str:  # noqa: N802
        name = type(call).__name__.lower()
        first, *others = map(self._print, call.args)
        if name not in ("max", "min"):
            return f"{name}({', '.join([first, *others])})"
        for other in others:  # a formula's maximum is of two
            first = f"{name}({first}, {other})"
        return first

    _print_Abs = _print_Max = _print_Min = _print_Function


def formula_text(expression: sp.Expr) -> str:
    """An expression as a formula."""
    return str(_FormulaPrinter().doprint(expression))


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
