"""The Gauss-Newton Hessian of a program whose Jacobian has few columns, by BLAS.

CasADi's own sparse product is 100 times slower there. Programs with many unknown
states have a sparse Jacobian and take CasADi's product (`Assembly`).
"""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np


class DenseGaussNewton(ca.Callback):
    """CasADi function (z, settings, factor, multipliers) -> factor J'J, upper triangle.

    Args:
        z: symbol of the variables, (n_variables,).
        jacobian: of the residuals, (n_residuals, n_variables), as an expression in z.
        n_constraints: number of multipliers, which are not used.
    """

    def __init__(self, z: ca.MX, jacobian: ca.MX, n_constraints: int) -> None:
        ca.Callback.__init__(self)
        self._n = z.numel()
        self._n_constraints = n_constraints
        # Structurally empty columns, of slack variables, are left out of the product.
        entries_per_column = np.diff(np.array(jacobian.sparsity().colind()))
        self._filled = np.flatnonzero(entries_per_column > 0)
        dense = ca.densify(jacobian[:, self._filled.tolist()])
        self._z = np.zeros(self._n)
        self._columns = np.zeros((dense.size2(), dense.size1()))
        # CasADi's own types say less than what its buffers take and give.
        made: Any = ca.Function("jacobian", [z], [dense]).buffer()
        self._buffer, self._evaluate = made
        z_memory: Any = self._z
        columns_memory: Any = self._columns
        self._buffer.set_arg(0, memoryview(z_memory))
        self._buffer.set_res(0, memoryview(columns_memory))
        filled = np.zeros((self._n, self._n))
        filled[np.ix_(self._filled, self._filled)] = 1.0
        self._upper = ca.sparsify(ca.DM(np.triu(filled))).sparsity()
        rows, columns = self._upper.get_triplet()
        self._rows = np.array(rows, dtype=int)
        self._places = np.array(columns, dtype=int)
        self.construct("gauss_newton", {})

    def get_n_in(self) -> int:
        """Number of arguments, for CasADi."""
        return 4

    def get_n_out(self) -> int:
        """Number of results, for CasADi."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Sparsity of the argument i, for CasADi."""
        sizes = (self._n, 0, 1, self._n_constraints)
        return ca.Sparsity.dense(sizes[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Sparsity of the Hessian, for CasADi."""
        return self._upper

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """The Hessian for numbers, for CasADi."""
        self._z[:] = np.array(arg[0]).ravel()
        self._evaluate()
        factor = float(arg[2])
        product = self._columns @ self._columns.T
        hessian = np.zeros((self._n, self._n))
        hessian[np.ix_(self._filled, self._filled)] = factor * product
        return [ca.DM(self._upper, hessian[self._rows, self._places])]
