"""Least squares with few unknowns: objective and derivatives by BLAS, evaluated once.

A solver asks for objective, gradient and Hessian one after the other. All follow from
residuals and Jacobian, which are computed together at each point and kept until the
next. CasADi's own sparse product is 100 times slower where the Jacobian has few
columns; programs with many unknown states have a sparse one and take it (`Assembly`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

# Values of the variables -> residuals and their slopes.
Evaluation = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Slopes:
    """Residuals and their slopes at one point.

    Attributes:
        residual: (n_residuals,).
        columns: (n_residuals, n_filled) unscaled slopes in the first variables.
        scale: (n_filled,) factors of the columns.
    """

    residual: np.ndarray
    columns: np.ndarray
    scale: np.ndarray

    @property
    def gradient(self) -> np.ndarray:
        """Of half the sum of squares, (n_filled,)."""
        return self.scale * (self.columns.T @ self.residual)

    @property
    def hessian(self) -> np.ndarray:
        """J'J, (n_filled, n_filled)."""
        return np.outer(self.scale, self.scale) * (self.columns.T @ self.columns)


class DenseLeastSquares:
    """Half the squares of r(z), plus c'z, with a dense Jacobian.

    The Jacobian has entries in the first of the variables alone.

    Args:
        evaluate: unscaled first variables (n_first,) -> residuals (n_residuals,) and
            their slopes (n_residuals, n_first).
        n_residuals: number of residuals.
        factor: of all residuals.
        scale: (n_first,) of the first variables.
        cost: (n_variables,) the linear cost c.
        n_others: number of settings, which nothing here depends on, and of multipliers.
    """

    def __init__(
        self,
        evaluate: Evaluation,
        n_residuals: int,
        factor: float,
        scale: np.ndarray,
        cost: np.ndarray,
        n_others: tuple[int, int],
    ) -> None:
        self.n = len(cost)
        self.n_residuals = n_residuals
        self.n_settings, self.n_constraints = n_others
        self.scale = scale
        self.cost = cost
        self._factor = factor
        self._evaluate = evaluate
        self._z = np.full(len(scale), np.nan)
        self._kept: Slopes | None = None
        self.residual = _Residual(self)
        self.objective = _Objective(self)
        self.gradient = _Gradient(self)
        self.hessian = _Hessian(self)

    def at(self, z: np.ndarray) -> Slopes:
        """Residuals and slopes at z (n_variables,)."""
        first = z[: len(self.scale)]
        if self._kept is None or not np.array_equal(first, self._z):
            residual, slopes = self._evaluate(first * self.scale)
            columns = self._factor * self.scale
            self._kept = Slopes(self._factor * residual, slopes, columns)
            self._z = first.copy()
        return self._kept

    def unscaled(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and slopes at z (n_variables,) as they were evaluated."""
        slopes = self.at(z)
        return slopes.residual / self._factor, slopes.columns

    def value(self, z: np.ndarray) -> float:
        """The objective at z (n_variables,)."""
        residual = self.at(z).residual
        return float(residual @ residual / 2 + self.cost @ z)


class _OfLeastSquares(ca.Callback):
    """A function of (z, settings), and perhaps more, for CasADi."""

    name_for_casadi = ""
    outputs: tuple[str, ...] = ()

    def __init__(self, problem: DenseLeastSquares) -> None:
        ca.Callback.__init__(self)
        self.problem = problem
        self.construct(self.name_for_casadi, {})

    def get_n_in(self) -> int:
        """Number of arguments, for CasADi."""
        return 2

    def get_n_out(self) -> int:
        """Number of results, for CasADi."""
        return len(self.outputs)

    def get_name_in(self, i: int) -> str:
        """Name of the argument i, as CasADi's solvers expect it."""
        return ("x", "p", "lam_f", "lam_g")[i]

    def get_name_out(self, i: int) -> str:
        """Name of the result i, as CasADi's solvers expect it."""
        return self.outputs[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Sparsity of the argument i, for CasADi."""
        problem = self.problem
        sizes = (problem.n, problem.n_settings, 1, problem.n_constraints)
        return ca.Sparsity.dense(sizes[i], 1)


class _Residual(_OfLeastSquares):
    """(z, settings) -> the residuals."""

    name_for_casadi = "residual"
    outputs = ("r",)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Sparsity of the result, for CasADi."""
        return ca.Sparsity.dense(self.problem.n_residuals, 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """The residuals for numbers, for CasADi."""
        return [ca.DM(self.problem.at(_numbers(arg[0])).residual)]


class _Objective(_OfLeastSquares):
    """(z, settings) -> the objective."""

    name_for_casadi = "objective"
    outputs = ("f",)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Sparsity of the result, for CasADi."""
        return ca.Sparsity.dense(1, 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """The objective for numbers, for CasADi."""
        return [ca.DM(self.problem.value(_numbers(arg[0])))]


class _Gradient(_OfLeastSquares):
    """(z, settings) -> objective and gradient."""

    name_for_casadi = "gradient"
    outputs = ("f", "grad_f_x")

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Sparsity of the result i, for CasADi."""
        return ca.Sparsity.dense(self.problem.n if i else 1, 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """Both for numbers, for CasADi."""
        z = _numbers(arg[0])
        slopes = self.problem.at(z)
        gradient = self.problem.cost.copy()
        gradient[: len(slopes.scale)] += slopes.gradient
        return [ca.DM(self.problem.value(z)), ca.DM(gradient)]


class _Hessian(_OfLeastSquares):
    """(z, settings, factor, multipliers) -> factor J'J, upper triangle."""

    name_for_casadi = "gauss_newton"
    outputs = ("triu_hess_gamma_x_x",)

    def __init__(self, problem: DenseLeastSquares) -> None:
        n_filled = len(problem.scale)
        filled = np.zeros((problem.n, problem.n))
        filled[:n_filled, :n_filled] = np.triu(np.ones((n_filled, n_filled)))
        self._upper = ca.sparsify(ca.DM(filled)).sparsity()
        rows, columns = self._upper.get_triplet()
        self._rows = np.array(rows, dtype=int)
        self._places = np.array(columns, dtype=int)
        super().__init__(problem)

    def get_n_in(self) -> int:
        """Number of arguments, for CasADi."""
        return 4

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Sparsity of the Hessian, for CasADi."""
        return self._upper

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """The Hessian for numbers, for CasADi."""
        hessian = float(arg[2]) * self.problem.at(_numbers(arg[0])).hessian
        return [ca.DM(self._upper, hessian[self._rows, self._places])]


def _numbers(column: ca.DM) -> np.ndarray:
    return np.array(column.elements())
