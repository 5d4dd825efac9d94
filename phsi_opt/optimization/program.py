"""One nonlinear program, made of named blocks.

::

    minimise    1/2 sum r(z)^2 + linear cost
    subject to  lower <= g(z) <= upper, bounds on z

Variables are scaled where they enter, so that the solver sees numbers near one and its
tolerance means the same for every block. The Hessian is the Gauss-Newton one, J'J of
the residuals: it leaves out the curvature of the constraints, which is nearly all of
the cost of the exact Hessian and of use only where residuals are large
(docs/design.md). A loss that knows this curvature adds it as a second choice.

This file holds the finished program; `Assembly` puts it together. No solver is named
here. Expressions and their derivatives are CasADi's (Andersson, Gillis, Horn, Rawlings
and Diehl 2019).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np


@dataclass(frozen=True)
class Block:
    """A named part of the variables or constraints, from ``start`` to before ``stop``.

    ``label(i)`` names its entry i in messages.
    """

    name: str
    start: int
    stop: int
    label: Callable[[int], str]

    @property
    def slice(self) -> slice:
        """Where the block stands in the whole vector."""
        return slice(self.start, self.stop)


@dataclass(frozen=True)
class Program:
    """A finished nonlinear program in scaled variables z; ``scale * z`` are the values.

    Args:
        variables: blocks of z by name.
        constraints: blocks of g by name.
        z: symbol, (n_variables,).
        settings: symbol of numbers that may change between two solves, such as the
            noise.
        set_to: their values.
        objective: of z and the settings.
        residual: (n_residuals,), whose squares the objective halves.
        g: (n_constraints,).
        jacobian: function (z, settings) -> g and its Jacobian.
        hessian: function (z, settings, factor, multipliers) -> upper triangle of the
            Gauss-Newton Hessian times the factor.
        exact: makes the same function with the curvature of the constraints; None where
            no loss knows it.
        start: scaled variables to start from, (n_variables,).
        scale: (n_variables,).
        lower: bounds of z, (n_variables,).
        upper: bounds of z, (n_variables,).
        g_lower: bounds of g, (n_constraints,).
        g_upper: bounds of g, (n_constraints,).
    """

    variables: dict[str, Block]
    constraints: dict[str, Block]
    z: ca.MX
    settings: ca.MX
    set_to: np.ndarray
    objective: ca.MX
    residual: ca.MX
    g: ca.MX
    jacobian: ca.Function
    hessian: ca.Function
    exact: Callable[[], ca.Function] | None
    start: np.ndarray
    scale: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    g_lower: np.ndarray
    g_upper: np.ndarray

    def values(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Unscaled values of every block of variables."""
        values = z * self.scale
        return {name: values[block.slice] for name, block in self.variables.items()}

    def name_of(self, index: int, blocks: Mapping[str, Block]) -> str:
        """Name of one entry, such as 'defect (trajectory 2, t = 1.7 to 1.8, row 1)'."""
        for block in blocks.values():
            if block.start <= index < block.stop:
                return f"{block.name} ({block.label(index - block.start)})"
        raise IndexError(f"no block has the entry {index}.")
