"""The libraries in which formulas are evaluated, and the functions they may call.

The names of `FUNCTIONS` are the whitelist of ``expressions``.
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


# Names that a formula may call.
FUNCTIONS = (
    *("sin", "cos", "tan", "atan", "exp", "log"),
    *("sqrt", "tanh", "abs", "sign", "min", "max"),
)

# Names that no state, input or parameter can have.
RESERVED_IN_FORMULAS = ("t", *FUNCTIONS, *CONSTANTS)


def functions_of(library: Any, **other_names: str) -> dict[str, Callable[..., Any]]:
    """The functions of a library, some of which have another name there."""
    names = {name: other_names.get(name, name) for name in FUNCTIONS}
    return {name: getattr(library, called) for name, called in names.items()}


CASADI = Backend(functions_of(ca, abs="fabs", min="fmin", max="fmax"))
NUMPY = Backend(functions_of(np, atan="arctan", min="minimum", max="maximum"))
