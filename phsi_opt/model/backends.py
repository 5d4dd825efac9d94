"""The libraries in which formulas are evaluated, and the functions they may call.

One table per library; the names of the first one are the whitelist of ``expressions``.
That of SymPy is `phsi_opt.model.sympy_backend`, whose library takes time to import.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

# Names that have a value of their own in a formula.
CONSTANTS: Mapping[str, float] = {"pi": math.pi}


@dataclass(frozen=True)
class Backend:
    """A library in which formulas are evaluated.

    Args:
        functions: its function for each name of `FUNCTIONS`.
        number: what turns a Python number into one of the library.
        constants: its value for each name of `CONSTANTS`.
    """

    functions: Mapping[str, Callable[..., Any]]
    number: Callable[[float], Any] = float
    constants: Mapping[str, Any] = field(default_factory=lambda: CONSTANTS)


CASADI = Backend(
    {
        "sin": ca.sin,
        "cos": ca.cos,
        "tan": ca.tan,
        "atan": ca.atan,
        "exp": ca.exp,
        "log": ca.log,
        "sqrt": ca.sqrt,
        "tanh": ca.tanh,
        "abs": ca.fabs,
        "sign": ca.sign,
        "min": ca.fmin,
        "max": ca.fmax,
    }
)
NUMPY = Backend(
    {
        "sin": np.sin,
        "cos": np.cos,
        "tan": np.tan,
        "atan": np.arctan,
        "exp": np.exp,
        "log": np.log,
        "sqrt": np.sqrt,
        "tanh": np.tanh,
        "abs": np.abs,
        "sign": np.sign,
        "min": np.minimum,
        "max": np.maximum,
    }
)
FUNCTIONS = tuple(CASADI.functions)  # names that a formula may call
