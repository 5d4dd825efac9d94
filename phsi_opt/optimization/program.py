"""One nonlinear program, assembled from named blocks.

    minimise   1/2 sum r(z)^2 + linear cost      subject to   lower <= g(z) <= upper,
        bounds on z

Variables are scaled where they enter, so that the solver sees numbers near one and its
tolerance means the same for every block. The Hessian is the Gauss-Newton one, J'J of
the residuals: it leaves out the curvature of the constraints, which is nearly all of
the cost of the exact Hessian and of use only where residuals are large
(docs/design.md). A loss that knows this curvature adds it as a second choice. No solver
is named here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError


@dataclass(frozen=True)
class Block:
    """A named part of the variables or constraints; ``label(i)`` names its entry i in
    messages.
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

    ``settings`` are numbers that may change between two solves, such as the noise;
    ``set_to`` are their values.
    """

    variables: dict[str, Block]
    constraints: dict[str, Block]
    z: ca.MX
    settings: ca.MX
    set_to: np.ndarray
    objective: ca.MX
    residual: ca.MX
    g: ca.MX
    jacobian: ca.Function  # (z, settings) -> g and its Jacobian
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
        return {
            name: (z * self.scale)[block.slice]
            for name, block in self.variables.items()
        }

    def name_of(self, index: int, blocks: dict[str, Block]) -> str:
        """Name of one entry, such as 'defect[trajectory=2, interval=17]'."""
        block = next(b for b in blocks.values() if b.start <= index < b.stop)
        return f"{block.name}[{block.label(index - block.start)}]"


@dataclass
class Assembly:
    """Collects blocks; `finish` closes it into a `Program`."""

    _symbols: list[ca.MX] = field(default_factory=list)
    _variables: dict[str, Block] = field(default_factory=dict)
    _constraints: dict[str, Block] = field(default_factory=dict)
    _numbers: dict[str, list[np.ndarray]] = field(
        default_factory=lambda: {
            n: [] for n in ("start", "scale", "lower", "upper", "g_lower", "g_upper")
        }
    )
    _g: list[tuple[ca.MX, Callable[[ca.MX], ca.MX] | None]] = field(
        default_factory=list
    )
    _residuals: list[tuple[ca.MX, Callable[[ca.MX], ca.MX] | None]] = field(
        default_factory=list
    )
    _linear: list[ca.MX] = field(default_factory=list)
    _settings: list[tuple[ca.MX, np.ndarray]] = field(default_factory=list)
    _curvature: Callable[[ca.MX, ca.MX], ca.MX] | None = None

    def curvature(self, of_constraints: Callable[[ca.MX, ca.MX], ca.MX]) -> None:
        """Say how to make the constraints' part of the exact Hessian: (scaled z,
        multipliers) -> its upper triangle.
        """
        self._curvature = of_constraints

    def setting(self, name: str, value: np.ndarray) -> ca.MX:
        """Numbers that may change between two solves of the same program."""
        symbol = ca.MX.sym(name, len(value))
        self._settings.append((symbol, np.asarray(value, dtype=float)))
        return symbol

    def variable(
        self,
        name: str,
        start: np.ndarray,
        lower: float | np.ndarray = -np.inf,
        upper: float | np.ndarray = np.inf,
        scale: float | np.ndarray = 1.0,
        label: Callable[[int], str] = str,
    ) -> ca.MX:
        """Add a block of variables and return it, unscaled, as a column."""
        begin = np.ravel(np.asarray(start, dtype=float))
        if not np.all(np.isfinite(begin)):
            raise ModelError(
                f"the start of {name} has {np.sum(~np.isfinite(begin))} values that are not finite."
            )
        size = np.broadcast_to(np.asarray(scale, dtype=float), begin.shape)
        symbol = ca.MX.sym(name, begin.size)
        offset = sum(s.numel() for s in self._symbols)
        self._symbols.append(symbol)
        self._variables[name] = Block(name, offset, offset + begin.size, label)
        self._numbers["scale"].append(size)
        for key, value in (("start", begin), ("lower", lower), ("upper", upper)):
            self._numbers[key].append(
                np.broadcast_to(np.asarray(value, dtype=float), begin.shape) / size
            )
        return symbol * ca.DM(size)

    def constrain(
        self,
        name: str,
        expression: ca.MX,
        lower: float = 0.0,
        upper: float = 0.0,
        label: Callable[[int], str] = str,
        jacobian: Callable[[ca.MX], ca.MX] | None = None,
    ) -> None:
        """Add lower <= expression <= upper; the caller scales the expression to numbers
        near one.

        ``jacobian(z)`` where the caller knows one that costs less than automatic
        differentiation of the whole.
        """
        column = ca.vec(expression)
        offset = sum(g.numel() for g, _ in self._g)
        self._g.append((column, jacobian))
        self._constraints[name] = Block(name, offset, offset + column.numel(), label)
        self._numbers["g_lower"].append(np.full(column.numel(), float(lower)))
        self._numbers["g_upper"].append(np.full(column.numel(), float(upper)))

    def residual(
        self, expression: ca.MX, jacobian: Callable[[ca.MX], ca.MX] | None = None
    ) -> None:
        """Add 1/2 sum(expression^2) to the objective; ``jacobian(z)`` where the caller
        knows a cheaper one.
        """
        self._residuals.append((ca.vec(expression), jacobian))

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
        """Add sum(weight |expression|) through slack variables: -s <= expression <= s,
        cost weight s.
        """
        slack = self.variable(
            f"slack_{name}", np.abs(start) + 0.1 * scale, lower=0.0, scale=scale
        )
        inverse = ca.DM(1 / scale)
        self.constrain(f"l1_upper_{name}", (slack - expression) * inverse, 0.0, np.inf)
        self.constrain(f"l1_lower_{name}", (slack + expression) * inverse, 0.0, np.inf)
        self.cost(ca.dot(ca.DM(weight), slack))

    def finish(self) -> Program:
        """Close the program: objective, constraints and Gauss-Newton Hessian in the
        scaled variables.
        """
        z = ca.vertcat(*self._symbols)
        # One symbol for the solver; the blocks become slices of it.
        whole = ca.MX.sym("z", z.numel())
        offsets = np.cumsum([0] + [s.numel() for s in self._symbols]).tolist()
        parts = [whole[a:b] for a, b in pairwise(offsets)]
        residual, linear, g = (
            ca.graph_substitute([ca.vertcat(*column)], self._symbols, parts)[0]
            if column
            else ca.MX(0, 1)
            for column in (
                [r for r, _ in self._residuals],
                self._linear,
                [e for e, _ in self._g],
            )
        )
        objective = ca.sumsqr(residual) / 2 + (ca.sum1(linear) if self._linear else 0)
        numbers = {
            key: np.concatenate(rows) if rows else np.zeros(0)
            for key, rows in self._numbers.items()
        }
        settings = ca.vertcat(ca.MX(0, 1), *(symbol for symbol, _ in self._settings))
        set_to = np.concatenate([np.zeros(0), *(value for _, value in self._settings)])
        n = g.numel()
        return Program(
            self._variables,
            self._constraints,
            whole,
            settings,
            set_to,
            objective,
            residual,
            g,
            self._jacobian(whole, settings, g),
            self._hessian(whole, settings, residual, n),
            self._exact(whole, settings, residual, n),
            **numbers,
        )

    def _exact(
        self, z: ca.MX, settings: ca.MX, residual: ca.MX, n_constraints: int
    ) -> Callable[[], ca.Function] | None:
        curvature = self._curvature
        if curvature is None:
            return None

        def make() -> ca.Function:
            factor, lam = ca.MX.sym("factor"), ca.MX.sym("lam", n_constraints)
            slope = ca.jacobian(residual, z)
            # The residuals' own curvature is zero but for sensors, which are linear or
            # nearly so.
            hessian = ca.triu(factor * ca.mtimes(slope.T, slope)) + curvature(z, lam)
            return ca.Function("exact", [z, settings, factor, lam], [hessian])

        return make

    def _jacobian(self, z: ca.MX, settings: ca.MX, g: ca.MX) -> ca.Function:
        rows, first = [], 0
        for column, known in self._g:
            part = g[first : first + column.numel()]
            rows.append(ca.jacobian(part, z) if known is None else known(z))
            first += column.numel()
        return ca.Function(
            "jac_g", [z, settings], [g, ca.vertcat(ca.MX(0, z.numel()), *rows)]
        )

    def _hessian(
        self, z: ca.MX, settings: ca.MX, residual: ca.MX, n_constraints: int
    ) -> ca.Function:
        known = [jacobian(z) for _, jacobian in self._residuals if jacobian is not None]
        if len(known) == len(self._residuals):
            return _DenseGaussNewton(z, ca.vertcat(*known), n_constraints)
        factor, lam = ca.MX.sym("factor"), ca.MX.sym("lam", n_constraints)
        jacobian = ca.jacobian(residual, z)
        hessian = ca.triu(factor * ca.mtimes(jacobian.T, jacobian))
        return ca.Function("gauss_newton", [z, settings, factor, lam], [hessian])


class _DenseGaussNewton(ca.Callback):
    """factor J'J (upper triangle) of a Jacobian with few columns, by BLAS; CasADi's own
    product is 100 times slower.
    """

    def __init__(self, z: ca.MX, jacobian: ca.MX, n_constraints: int) -> None:
        ca.Callback.__init__(self)
        # Structurally empty columns, of slack variables, are left out of the product.
        self._filled = np.flatnonzero(
            np.diff(np.array(jacobian.sparsity().colind())) > 0
        )
        dense = ca.densify(jacobian[:, self._filled.tolist()])
        self._n, self._n_constraints = z.numel(), n_constraints
        made: Any = ca.Function("jacobian", [z], [dense]).buffer()
        self._buffer, self._evaluate = made
        self._z, self._columns = (
            np.zeros(self._n),
            np.zeros((dense.size2(), dense.size1())),
        )
        for setter, array in (
            (self._buffer.set_arg, self._z),
            (self._buffer.set_res, self._columns),
        ):
            shared: Any = array
            setter(0, memoryview(shared))
        filled = np.zeros((self._n, self._n))
        filled[np.ix_(self._filled, self._filled)] = 1.0
        self._upper = ca.sparsify(ca.DM(np.triu(filled))).sparsity()
        self._entries = tuple(
            np.array(index, dtype=int) for index in self._upper.get_triplet()
        )
        self.construct("gauss_newton", {})

    def get_n_in(self) -> int:
        return 4

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense((self._n, 0, 1, self._n_constraints)[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._upper

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        self._z[:] = np.array(arg[0]).ravel()
        self._evaluate()
        hessian = np.zeros((self._n, self._n))
        hessian[np.ix_(self._filled, self._filled)] = float(arg[2]) * (
            self._columns @ self._columns.T
        )
        return [ca.DM(self._upper, hessian[self._entries])]
