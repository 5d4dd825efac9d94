"""CasADi functions that are called many times, on NumPy's own memory.

CasADi's own conversion of a result walks over it as a list of Python's numbers.
"""

from typing import Any

import casadi as ca
import numpy as np


class Evaluated:
    """A CasADi function with dense arguments, as arrays.

    Args:
        function: whose results are dense, or sparse: then the entries of their pattern
            alone are given, in CasADi's order (column by column).
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function  # its memory must outlive the buffer
        made: Any = function.buffer()
        self._buffer, self._evaluate = made
        self._arguments = []
        for i in range(function.n_in()):
            argument: Any = np.zeros(function.numel_in(i))
            self._arguments.append(argument)
            if argument.size:
                self._buffer.set_arg(i, memoryview(argument))
        self._results = []
        for i in range(function.n_out()):
            result: Any = np.zeros(_shape(function, i))
            self._results.append(result)
            if result.size:
                self._buffer.set_res(i, memoryview(result))

    def __call__(self, *arguments: Any) -> list[np.ndarray]:
        """The results, each transposed: a row per column of CasADi's.

        They are written over by the next call.

        Args:
            arguments: arrays in the shapes of CasADi's arguments.
        """
        for own, given in zip(self._arguments, arguments, strict=True):
            own[:] = np.ravel(np.asarray(given, dtype=float), order="F")
        self._evaluate()
        return self._results


def _shape(function: ca.Function, i: int) -> tuple[int, ...]:
    """Of the array for the result i."""
    if function.sparsity_out(i).is_dense():
        return function.size2_out(i), function.size1_out(i)
    return (function.nnz_out(i),)
