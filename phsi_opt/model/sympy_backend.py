"""SymPy as a library in which formulas are evaluated; slow to import."""

from math import comb, prod

import sympy as sp

from phsi_opt.model.expressions import Backend, functions_of

SYMPY = Backend(
    functions_of(sp, abs="Abs", min="Min", max="Max"),
    number=sp.sympify,
    constants={"pi": sp.pi},
)


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
