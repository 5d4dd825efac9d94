"""SymPy as a library in which formulas are evaluated; slow to import."""

import sympy as sp

from phsi_opt.model.backends import Backend

SYMPY = Backend(
    {
        "sin": sp.sin,
        "cos": sp.cos,
        "tan": sp.tan,
        "atan": sp.atan,
        "exp": sp.exp,
        "log": sp.log,
        "sqrt": sp.sqrt,
        "tanh": sp.tanh,
        "abs": sp.Abs,
        "sign": sp.sign,
        "min": sp.Min,
        "max": sp.Max,
    },
    number=sp.sympify,
    constants={"pi": sp.pi},
)
