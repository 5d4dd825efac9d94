"""One nonlinear program, written in CasADi's symbols block by block.

::

    minimise    1/2 sum r(z)^2 + linear cost
    subject to  lower <= g(z) <= upper, bounds on z

A loss adds named blocks of variables, residuals and constraints in the units of the
model. Variables are scaled where they enter, so that the solver sees numbers near one
and its tolerance means the same for every block. The Hessian is Gauss-Newton's, J'J of
the residuals: the curvature of the constraints is nearly all of the cost of the exact
one, and of use only where residuals are large. Expressions and their derivatives are
CasADi's (Andersson, Gillis, Horn, Rawlings and Diehl 2019).
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.errors import ModelError, shown

Label = Callable[[int], str]

# A slack variable starts above the absolute value that it bounds, by this share of the
# value's scale, so that the start is inside the constraints.
SLACK_ABOVE = 0.1
# CasADi's name of the BLAS in its wheel, for dense products; its own loops take eight
# times as long for 69 parameters and 40 000 residuals.
BLAS = "classic"


class Block(NamedTuple):
    """A part of the variables or constraints: its place, and names of its entries."""

    slice: slice
    label: Label


class Program:
    """A nonlinear program in scaled variables z; ``scale * z`` are the values.

    Attributes:
        variables: blocks of z by name.
        constraints: blocks of g by name.
        z: symbols, (n_variables,).
        settings: symbols of numbers that may change between two solves, such as the
            noise.
        set_to: their values.
        residual: (n_residuals,), whose squares the objective halves.
        cost: that is linear in the variables.
        g: constraints, (n_constraints,).
        start: scaled variables to start from, (n_variables,).
        scale: (n_variables,).
        bounds: lower and upper bounds of z, (2, n_variables).
        g_bounds: those of g, (2, n_constraints).
    """

    def __init__(self) -> None:
        self.variables: dict[str, Block] = {}
        self.constraints: dict[str, Block] = {}
        self.z = self.settings = self.residual = self.g = ca.MX(0, 1)
        self.cost = ca.MX(0)
        self.set_to = self.start = self.scale = np.zeros(0)
        self.bounds = self.g_bounds = np.zeros((2, 0))
        self._dense_slopes: ca.MX | None = None
        self._curvature = np.zeros(0)
        # Of the constraints at some places that have second derivatives.
        self._second_slopes: list[tuple[slice, Callable[[ca.MX], ca.MX]]] = []

    def setting(self, name: str, value: np.ndarray) -> ca.MX:
        """Numbers (n_values,) that may change between two solves of one program."""
        symbol = ca.MX.sym(name, len(value))
        self.settings = ca.vertcat(self.settings, symbol)
        self.set_to = np.append(self.set_to, value)
        return symbol

    def variable(
        self,
        name: str,
        start: np.ndarray,
        lower: float | np.ndarray = -np.inf,
        upper: float | np.ndarray = np.inf,
        scale: float | np.ndarray = 1.0,
        label: Label = str,
    ) -> ca.MX:
        """Add a block of variables and return it, unscaled, as a column.

        ``start`` (n,) are values to start from, ``scale`` sizes that make the values
        numbers near one; ``label`` names an entry in messages.

        Raises:
            ModelError: a start or a size is not finite, or a bound is no number.
        """
        sizes, low, high = np.broadcast_arrays(scale, lower, upper, start)[:3]
        with np.errstate(all="ignore"):
            scaled = np.array([start, low, high]) / sizes
        is_fine = np.isfinite([sizes, scaled[0]]).all(0) & ~np.isnan(scaled).any(0)
        for i in np.flatnonzero(~is_fine)[:1]:
            raise ModelError(
                f"{label(i)} of {name} starts at {start[i]:g} with the size "
                f"{sizes[i]:g} and the bounds {low[i]:g} and {high[i]:g}; expected "
                "finite numbers. Give it another start, or rescale its term."
            )
        symbol = ca.MX.sym(name, len(start))
        first = len(self.start)
        self.variables[name] = Block(slice(first, first + len(start)), label)
        self.z = ca.vertcat(self.z, symbol)
        self.start = np.append(self.start, scaled[0])
        self.scale = np.append(self.scale, sizes)
        self.bounds = np.hstack([self.bounds, scaled[1:]])
        return symbol * ca.DM(sizes)

    def constrain(
        self,
        name: str,
        expression: ca.MX,
        upper: float = 0.0,
        label: Label = str,
        curvature: Callable[[ca.MX], ca.MX] | None = None,
    ) -> None:
        """Add 0 <= expression <= upper, scaled by the caller to numbers near one.

        ``curvature`` takes multipliers, a column, to the second derivatives of
        multipliers'expression in the scaled first variables, their upper triangle;
        None: there are none.
        """
        column = ca.vec(expression)
        first = self.g.numel()
        place = slice(first, first + column.numel())
        self.constraints[name] = Block(place, label)
        if curvature is not None:
            self._second_slopes.append((place, curvature))
        self.g = ca.vertcat(self.g, column)
        limits = np.tile([[0.0], [upper]], column.numel())
        self.g_bounds = np.hstack([self.g_bounds, limits])

    def add_residual(self, expression: ca.MX, slopes: ca.MX | None = None) -> None:
        """Add 1/2 sum(expression^2) to the objective.

        ``slopes`` in the values of the first variables, dense, may be given where it is
        the only residual: the Gauss-Newton Hessian is then a product made by BLAS.
        """
        self.residual = ca.vertcat(self.residual, ca.vec(expression))
        self._dense_slopes = slopes

    def add_squares(
        self, expression: ca.MX, mean: np.ndarray, weight: np.ndarray
    ) -> None:
        """Add ``sum(weight (expression - mean)^2) / 2`` of the first variables.

        All arrays are (n_entries,).
        """
        self.cost += ca.dot(ca.DM(weight), (expression - ca.DM(mean)) ** 2) / 2
        self._curvature = weight

    def add_l1(
        self,
        name: str,
        expression: ca.MX,
        weight: np.ndarray,
        start: np.ndarray,
        scale: np.ndarray,
    ) -> None:
        """Add ``sum(weight |expression|)`` through slack variables s.

        -s <= expression <= s, at the cost weight s; all arrays (n_entries,) have one
        entry per entry of ``expression``, ``start`` its values at the start.
        """
        above = np.abs(start) + SLACK_ABOVE * scale
        slack = self.variable(f"slack_{name}", above, lower=0.0, scale=scale)
        inverse = ca.DM(1 / scale)
        self.constrain(f"l1_upper_{name}", (slack - expression) * inverse, np.inf)
        self.constrain(f"l1_lower_{name}", (slack + expression) * inverse, np.inf)
        self.cost = self.cost + ca.dot(ca.DM(weight), slack)

    @property
    def objective(self) -> ca.MX:
        """1/2 sum residual^2 + cost, a number."""
        return ca.sumsqr(self.residual) / 2 + self.cost

    @property
    def nlp(self) -> dict[str, ca.MX]:
        """The problem as `casadi.nlpsol` takes it: x, p, f and g."""
        parts = {"x": self.z, "p": self.settings}
        return parts | {"f": self.objective, "g": self.g}

    @property
    def arguments(self) -> dict[str, np.ndarray]:
        """Start, settings and bounds, as the solver that `nlpsol` makes takes them."""
        lower, upper = self.bounds
        g_lower, g_upper = self.g_bounds
        found = {"x0": self.start, "p": self.set_to, "lbx": lower, "ubx": upper}
        return found | {"lbg": g_lower, "ubg": g_upper}

    def column(self, name: str) -> ca.MX:
        """The unscaled symbols of a block of variables, a column.

        Raises:
            ModelError: there is no such block.
        """
        require_known(
            name, self.variables, f"block {shown(name)} is not in the program"
        )
        place = self.variables[name].slice
        return self.z[place] * ca.DM(self.scale[place])

    def jacobian(self) -> ca.Function:
        """Function (z, settings) -> g and its Jacobian."""
        both = [self.g, ca.jacobian(self.g, self.z)]
        return ca.Function("jac_g", [self.z, self.settings], both)

    def hessian(self, exact: bool = False) -> ca.Function:
        """Function (z, settings, factor, multipliers) -> upper triangle of the Hessian.

        An exact one has the curvature of the constraints; that of the residuals is zero
        but for sensors, which are linear or nearly so.
        """
        slopes = self._dense_slopes
        if slopes is None:
            slopes = ca.jacobian(self.residual, self.z)
            product = ca.mtimes(slopes.T, slopes)
        else:
            scale = ca.DM(self.scale[: slopes.size2()])
            product = ca.mtimes(slopes.T, slopes, BLAS) * ca.mtimes(scale, scale.T)
        factor = ca.MX.sym("factor")
        multipliers = ca.MX.sym("lam", self.g.numel())
        n_others = self.z.numel() - product.size1()
        curvature = np.zeros(self.z.numel())
        first = len(self._curvature)
        curvature[:first] = self._curvature * self.scale[:first] ** 2
        product = ca.diagcat(ca.triu(product), ca.MX(n_others, n_others))
        hessian = factor * (product + ca.diag(ca.DM(curvature)))
        if exact:
            for place, of_block in self._second_slopes:
                curved = of_block(multipliers[place])
                n_further = self.z.numel() - curved.size1()
                hessian += ca.diagcat(curved, ca.MX(n_further, n_further))
        arguments = [self.z, self.settings, factor, multipliers]
        return ca.Function("hessian", arguments, [hessian])

    def values(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Unscaled values of every block of variables."""
        values = z * self.scale
        return {name: values[block.slice] for name, block in self.variables.items()}

    def name_of(self, index: int, blocks: Mapping[str, Block]) -> str:
        """Name of one entry, such as 'defect (trajectory 2, t = 1.7 to 1.8, row 1)'."""
        for name, block in blocks.items():
            if block.slice.start <= index < block.slice.stop:
                return f"{name} ({block.label(index - block.slice.start)})"
        raise IndexError(f"no block has the entry {index}.")
