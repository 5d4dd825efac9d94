"""Puts a nonlinear program together from named blocks.

A loss adds its variables, constraints and residuals in the units of the model;
`Assembly.finish` makes one scaled `Program` of them, with its derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.optimization.program import Block, Program

Label = Callable[[int], str]
Jacobian = Callable[[ca.MX], ca.MX]  # of the scaled variables z
Curvature = Callable[[ca.MX, ca.MX], ca.MX]  # of z and the multipliers

# A slack variable starts above the absolute value that it bounds, by this share of the
# value's scale, so that the start is inside the constraints.
SLACK_ABOVE = 0.1
# CasADi's name of the BLAS in its wheel, for dense products; its own loops take eight
# times as long for 69 parameters and 40 000 residuals.
BLAS = "classic"


@dataclass(frozen=True, eq=False)
class _Variables:
    """A block of variables: its symbol, and start and bounds in scaled numbers."""

    block: Block
    symbol: ca.MX
    scale: np.ndarray
    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True, eq=False)
class _Expression:
    """A column of expressions; its Jacobian where the caller knows a cheaper one."""

    column: ca.MX
    jacobian: Jacobian | None


@dataclass(frozen=True, eq=False)
class _DenseResidual:
    """Residuals of the first block of variables, with dense slopes."""

    residual: ca.Function
    slopes: ca.Function


@dataclass(frozen=True, eq=False)
class _Constraints:
    """A block of constraints with their bounds."""

    block: Block
    expression: _Expression
    lower: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True, eq=False)
class _Setting:
    """Numbers that may change between two solves."""

    symbol: ca.MX
    value: np.ndarray


@dataclass
class Assembly:
    """Collects blocks; `finish` closes it into a `Program`."""

    _variables: list[_Variables] = field(default_factory=list)
    _constraints: list[_Constraints] = field(default_factory=list)
    _residuals: list[ca.MX] = field(default_factory=list)
    _dense: _DenseResidual | None = None
    _linear: list[ca.MX] = field(default_factory=list)
    _settings: list[_Setting] = field(default_factory=list)
    _curvature: Curvature | None = None

    def curvature(self, of_constraints: Curvature) -> None:
        """Say how to make the constraints' part of the exact Hessian.

        ``of_constraints``: (scaled z, multipliers) -> its upper triangle.
        """
        self._curvature = of_constraints

    def setting(self, name: str, value: np.ndarray) -> ca.MX:
        """Numbers (n_values,) that may change between two solves of one program."""
        symbol = ca.MX.sym(name, len(value))
        self._settings.append(_Setting(symbol, np.asarray(value, dtype=float)))
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

        Args:
            name: of the block.
            start: its values to start from, of any shape such as (n_nodes, n_states);
                flattened row by row.
            lower: bounds, a number or one per value.
            upper: bounds likewise.
            scale: sizes that make the values numbers near one.
            label: names an entry in messages.

        Raises:
            ModelError: the start is not finite.
        """
        begin = np.ravel(np.asarray(start, dtype=float))
        n_bad = np.sum(~np.isfinite(begin))
        if n_bad:
            raise ModelError(
                f"the start of {name} has {n_bad} values that are not finite."
            )
        size = _spread(scale, begin)
        symbol = ca.MX.sym(name, begin.size)
        offset = self._variables[-1].block.stop if self._variables else 0
        self._variables.append(
            _Variables(
                block=Block(name, offset, offset + begin.size, label),
                symbol=symbol,
                scale=size,
                start=begin / size,
                lower=_spread(lower, begin) / size,
                upper=_spread(upper, begin) / size,
            )
        )
        return symbol * ca.DM(size)

    def constrain(
        self,
        name: str,
        expression: ca.MX,
        lower: float = 0.0,
        upper: float = 0.0,
        label: Label = str,
        jacobian: Jacobian | None = None,
    ) -> None:
        """Add lower <= expression <= upper.

        Args:
            name: of the block.
            expression: scaled by the caller to numbers near one.
            lower: bound of every entry.
            upper: bound of every entry.
            label: names an entry in messages.
            jacobian: of z, where the caller knows one that costs less than automatic
                differentiation of the whole.
        """
        column = ca.vec(expression)
        offset = self._constraints[-1].block.stop if self._constraints else 0
        block = Block(name, offset, offset + column.numel(), label)
        self._constraints.append(
            _Constraints(
                block=block,
                expression=_Expression(column, jacobian),
                lower=np.full(column.numel(), float(lower)),
                upper=np.full(column.numel(), float(upper)),
            )
        )

    def residual(self, expression: ca.MX) -> None:
        """Add 1/2 sum(expression^2) to the objective."""
        self._residuals.append(ca.vec(expression))

    def dense_residual(self, residual: ca.Function, slopes: ca.Function) -> None:
        """Add 1/2 sum(r^2), where r depends on the first block alone, and densely.

        The Gauss-Newton Hessian is then a product of dense matrices, made by BLAS.

        Args:
            residual: unscaled values of the first block (n_first,) -> r (n_residuals,).
            slopes: the same -> its derivatives (n_residuals, n_first).
        """
        self._dense = _DenseResidual(residual, slopes)

    def cost(self, expression: ca.MX) -> None:
        """Add a cost that is linear in the variables."""
        self._linear.append(expression)

    def l1(
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
        self.constrain(f"l1_upper_{name}", (slack - expression) * inverse, 0.0, np.inf)
        self.constrain(f"l1_lower_{name}", (slack + expression) * inverse, 0.0, np.inf)
        self.cost(ca.dot(ca.DM(weight), slack))

    def finish(self) -> Program:
        """Close the program.

        Objective, constraints and derivatives are functions of the scaled variables.
        """
        z = ca.MX.sym("z", self._variables[-1].block.stop)
        linear = self._in_terms_of(z, self._linear)
        columns = [constraints.expression.column for constraints in self._constraints]
        g = self._in_terms_of(z, columns)
        cost = ca.sum1(linear) if self._linear else ca.MX(0)
        symbols = [setting.symbol for setting in self._settings]
        settings = ca.vertcat(ca.MX(0, 1), *symbols)
        variables = self._variables
        constraints = self._constraints
        residual = self._residual(z)
        gauss_newton = self._gauss_newton(z)
        return Program(
            variables=_by_name(variables),
            constraints=_by_name(constraints),
            z=z,
            settings=settings,
            set_to=_stacked(self._settings, "value"),
            objective=ca.sumsqr(residual) / 2 + cost,
            residual=residual,
            g=g,
            jacobian=self._jacobian(z, settings, g),
            hessian=self._hessian(z, settings, gauss_newton, g.numel()),
            exact=self._exact(z, settings, gauss_newton, g.numel()),
            start=_stacked(variables, "start"),
            scale=_stacked(variables, "scale"),
            lower=_stacked(variables, "lower"),
            upper=_stacked(variables, "upper"),
            g_lower=_stacked(constraints, "lower"),
            g_upper=_stacked(constraints, "upper"),
        )

    def _in_terms_of(self, z: ca.MX, columns: Sequence[ca.MX]) -> ca.MX:
        """The columns below each other, with slices of z in place of the blocks'
        symbols: the solver knows one symbol.
        """
        if not columns:
            return ca.MX(0, 1)
        return ca.graph_substitute([ca.vertcat(*columns)], *self._parts_of(z))[0]

    def _jacobian(self, z: ca.MX, settings: ca.MX, g: ca.MX) -> ca.Function:
        rows = [ca.MX(0, z.numel())]
        for constraints in self._constraints:
            known = constraints.expression.jacobian
            part = g[constraints.block.slice]
            rows.append(ca.jacobian(part, z) if known is None else known(z))
        return ca.Function("jac_g", [z, settings], [g, ca.vertcat(*rows)])

    def _parts_of(self, z: ca.MX) -> tuple[list[ca.MX], list[ca.MX]]:
        """The blocks' symbols, and the slices of z that stand for them."""
        symbols = []
        parts = []
        for variables in self._variables:
            symbols.append(variables.symbol)
            parts.append(z[variables.block.slice])
        return symbols, parts

    def _residual(self, z: ca.MX) -> ca.MX:
        """All residuals, (n_residuals,)."""
        residual = self._in_terms_of(z, self._residuals)
        if self._dense is None:
            return residual
        return ca.vertcat(residual, self._dense.residual(self._first(z)))

    def _first(self, z: ca.MX) -> ca.MX:
        """Unscaled values of the first block of variables."""
        first = self._variables[0]
        return z[first.block.slice] * ca.DM(first.scale)

    def _gauss_newton(self, z: ca.MX) -> ca.MX:
        """J'J of all residuals, upper triangle."""
        if self._dense is None:
            slopes = ca.jacobian(self._in_terms_of(z, self._residuals), z)
            return ca.triu(ca.mtimes(slopes.T, slopes))
        slopes = self._dense.slopes(self._first(z))
        product = ca.mtimes(slopes.T, slopes, BLAS)
        scale = ca.DM(self._variables[0].scale)
        n_others = z.numel() - scale.numel()
        others = ca.MX(n_others, n_others)
        return ca.triu(ca.diagcat(product * ca.mtimes(scale, scale.T), others))

    def _hessian(
        self, z: ca.MX, settings: ca.MX, gauss_newton: ca.MX, n_constraints: int
    ) -> ca.Function:
        """The Gauss-Newton Hessian, upper triangle."""
        factor = ca.MX.sym("factor")
        multipliers = ca.MX.sym("lam", n_constraints)
        arguments = [z, settings, factor, multipliers]
        return ca.Function("gauss_newton", arguments, [factor * gauss_newton])

    def _exact(
        self, z: ca.MX, settings: ca.MX, gauss_newton: ca.MX, n_constraints: int
    ) -> Callable[[], ca.Function] | None:
        """What makes the Hessian with the constraints' curvature, where it is known."""
        curvature = self._curvature
        if curvature is None:
            return None

        def make() -> ca.Function:
            factor = ca.MX.sym("factor")
            multipliers = ca.MX.sym("lam", n_constraints)
            # The residuals' own curvature is zero but for sensors, which are linear or
            # nearly so.
            hessian = factor * gauss_newton + curvature(z, multipliers)
            return ca.Function("exact", [z, settings, factor, multipliers], [hessian])

        return make


def _spread(value: float | np.ndarray, like: np.ndarray) -> np.ndarray:
    """A number or an array in the shape of another array."""
    return np.broadcast_to(np.asarray(value, dtype=float), like.shape)


def _stacked(
    parts: Sequence[_Variables | _Constraints | _Setting], name: str
) -> np.ndarray:
    """One field of all parts, one after another; empty where there are none."""
    arrays = [np.zeros(0)]
    for part in parts:
        arrays.append(getattr(part, name))
    return np.concatenate(arrays)


def _by_name(parts: Sequence[_Variables | _Constraints]) -> dict[str, Block]:
    """The blocks by their names."""
    return {part.block.name: part.block for part in parts}
