"""A CasADi function at many places at once: a number per place, NumPy's arithmetic.

CasADi's interpreter goes through a function's instructions once for every interval of a
record. Here each instruction is carried out for all intervals together, which takes a
fraction of the time, and what has one value for all of them (parameters, numbers in
formulas) is worked out once. The instructions are those that CasADi lists of a function
of scalars; nothing is generated or compiled. `in_columns` does the same with CasADi's
symbols in place of numbers.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
from scipy.special import erf

# Places that are worked on at once, at most; fewer where a function has many registers,
# so that these stay in the cache, but never so few that calls cost more than numbers.
AT_ONCE = 2048
NUMBERS_AT_ONCE = 2**18
LEAST_AT_ONCE = 256

# A number, or one per place: an entry of an argument, of a result, or what an
# instruction writes.
Cell = tuple[str, int, int]
Instruction = tuple[Callable[..., Any], list[Cell], Cell]  # reads cells, writes one


def _if_else_zero(condition: np.ndarray, value: np.ndarray, out: np.ndarray) -> None:
    np.copyto(out, np.where(condition != 0, value, 0.0))


# CasADi's name of an operation, and NumPy's.
NUMPY_NAMES = """
ASSIGN positive, OUTPUT positive, ADD add, SUB subtract, MUL multiply, DIV divide,
NEG negative, EXP exp, LOG log, POW power, CONSTPOW power, SQRT sqrt, SQ square,
SIN sin, COS cos, TAN tan, ASIN arcsin, ACOS arccos, ATAN arctan, LT less,
LE less_equal, EQ equal, NE not_equal, NOT logical_not, AND logical_and,
OR logical_or, FLOOR floor, CEIL ceil, FMOD fmod, FABS fabs, SIGN sign,
COPYSIGN copysign, FMIN fmin, FMAX fmax, INV reciprocal, SINH sinh, COSH cosh,
TANH tanh, ASINH arcsinh, ACOSH arccosh, ATANH arctanh, ATAN2 arctan2, LOG1P log1p,
EXPM1 expm1, HYPOT hypot
"""
OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_TWICE: partial(np.multiply, 2.0),
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
    ca.OP_ERF: erf,
}
for _pair in NUMPY_NAMES.split(","):
    _operation, _called = _pair.split()
    OPERATIONS[getattr(ca, f"OP_{_operation}")] = getattr(np, _called)


class _Listing:
    """The instructions of a function, and the cells that they read and write.

    CasADi's registers are used again and again; a register that holds a number per
    place is one cell, and a single number has a cell of its own.

    Attributes:
        constants: cells of numbers, with their values.
        shared: instructions whose results have one value for all places.
        columns: the others, in their order.
        at_once: number of places that are worked on at once.
    """

    def __init__(self, function: ca.Function, is_shared: tuple[bool, ...]) -> None:
        self.constants: dict[Cell, float] = {}
        self.shared: list[Instruction] = []
        self.columns: list[Instruction] = []
        held: dict[int, Cell] = {}  # by register
        wide: set[Cell] = set()
        simpler = _without_repetitions(function)
        for k in range(simpler.n_instructions()):
            kind = simpler.instruction_id(k)
            read = simpler.instruction_input(k)
            written = simpler.instruction_output(k)
            if kind == ca.OP_CONST:
                cell: Cell = ("constant", k, 0)
                self.constants[cell] = simpler.instruction_constant(k)
            elif kind == ca.OP_INPUT:
                cell = ("argument", read[0], read[1])
                if not is_shared[read[0]]:
                    wide.add(cell)
            else:
                cells = [held[register] for register in read]
                if kind == ca.OP_OUTPUT:
                    result = ("result", written[0], written[1])
                    self.columns.append((OPERATIONS[kind], cells, result))
                    continue
                is_wide = not wide.isdisjoint(cells)
                cell = ("column", written[0], 0) if is_wide else ("shared", k, 0)
                if is_wide:
                    wide.add(cell)
                instructions = self.columns if is_wide else self.shared
                instructions.append((OPERATIONS[kind], cells, cell))
            held[written[0]] = cell
        n_results = sum(function.nnz_out(i) for i in range(function.n_out()))
        fitting = NUMBERS_AT_ONCE // max(len(wide) + n_results, 1)
        self.at_once = min(AT_ONCE, max(fitting, LEAST_AT_ONCE))


_listing = lru_cache(128)(_Listing)  # those last asked for


def _without_repetitions(function: ca.Function) -> ca.Function:
    """The same function, what it repeats worked out once."""
    arguments = []
    for i in range(function.n_in()):
        arguments.append(ca.SX.sym(function.name_in(i), function.sparsity_in(i)))
    results = function.call(arguments)
    return ca.Function("columns", arguments, ca.cse(results))


@lru_cache(32)
class _Machine:
    """A listing with memory for a number of places; each thread has its own."""

    def __init__(
        self,
        function: ca.Function,
        is_shared: tuple[bool, ...],
        size: int,
        thread: int,
    ) -> None:
        listing = _listing(function, is_shared)
        self._common = [i for i, one_for_all in enumerate(is_shared) if one_for_all]
        self._own = [i for i, one_for_all in enumerate(is_shared) if not one_for_all]
        self._arguments = []
        for i, one_for_all in enumerate(is_shared):
            shape = (function.nnz_in(i), 1 if one_for_all else size)
            self._arguments.append(np.zeros(shape))
        self._results = []
        for i in range(function.n_out()):
            self._results.append(np.zeros((function.nnz_out(i), size)))
        self._memory: dict[Cell, np.ndarray] = {}
        for cell, value in listing.constants.items():
            self._memory[cell] = np.full(1, value)
        for _, _, cell in listing.shared:
            self._memory[cell] = np.zeros(1)
        for _, _, cell in listing.columns:
            self._memory[cell] = np.zeros(size)
        self._shared = [self._bound(one) for one in listing.shared]
        self._columns = [self._bound(one) for one in listing.columns]

    def _bound(self, instruction: Instruction) -> tuple[Any, ...]:
        """The instruction with the memory that it reads and writes."""
        operation, read, written = instruction
        return operation, [self._array(cell) for cell in read], self._array(written)

    def _array(self, cell: Cell) -> np.ndarray:
        kind, number, entry = cell
        if kind == "argument":
            return self._arguments[number][entry]
        if kind == "result":
            return self._results[number][entry]
        return self._memory[cell]

    def share(self, arguments: Sequence[np.ndarray]) -> None:
        """Take in what has one value for all places."""
        for i in self._common:
            self._arguments[i][:, 0] = arguments[i]
        for operation, read, written in self._shared:
            operation(*read, written)

    def work(
        self, place: slice, arguments: Sequence[np.ndarray], results: list[np.ndarray]
    ) -> None:
        """Fill in the results at some places."""
        for i in self._own:
            self._arguments[i][:] = arguments[i][:, place]
        for operation, read, written in self._columns:
            operation(*read, written)
        for own, result in zip(self._results, results, strict=True):
            result[:, place] = own


class ColumnFunction:
    """A CasADi function of scalars (SX), at many places at once.

    Args:
        function: with dense arguments.
        shared: numbers of the arguments that have one value for all places.
    """

    def __init__(self, function: ca.Function, shared: tuple[int, ...] = ()) -> None:
        self._function = function
        self._is_shared = tuple(i in shared for i in range(function.n_in()))
        self._sizes = [function.nnz_out(i) for i in range(function.n_out())]

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Every result as its entries (column by column), (n_entries, n_places).

        Args:
            *arguments: (n_rows, n_places) each, those that are shared (n_rows,).
        """
        n = arguments[self._is_shared.index(False)].shape[1]
        results = [np.zeros((n_entries, n)) for n_entries in self._sizes]
        if not n:
            return results
        n_stretches = -(-n // _listing(self._function, self._is_shared).at_once)
        size = -(-n // n_stretches)
        machine = _Machine(self._function, self._is_shared, size, get_ident())
        with np.errstate(all="ignore"):
            machine.share(arguments)
            # The last stretch ends with the record, and may overlap the one before.
            for begin in range(0, n, size):
                first = min(begin, n - size)
                machine.work(slice(first, first + size), arguments, results)
        return results


def in_columns(
    function: ca.Function, arguments: Sequence[Sequence[ca.MX | ca.DM]]
) -> list[list[ca.MX]]:
    """The same in symbols: a program's function at many places at once.

    `Function.map` goes through the instructions once for every place. Here CasADi's
    interpreter has one step for all of them: SRK4's defects and their slopes take a
    fifth to a tenth of the time (0.6 ms for 8.5 with 3000 intervals and 34 parameters).

    Args:
        function: of scalars (SX), with dense arguments.
        arguments: the entries of each argument: a column (n_places,), or a number that
            all places share.

    Returns:
        Entries of each result, column by column as CasADi stores them; what is the same
        at all places may be a number.
    """
    held: dict[int, ca.MX] = {}  # by register
    results = [[ca.MX(0)] * function.nnz_out(i) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        kind = function.instruction_id(k)
        read = function.instruction_input(k)
        written = function.instruction_output(k)
        if kind == ca.OP_OUTPUT:
            results[written[0]][written[1]] = held[read[0]]
        elif kind == ca.OP_INPUT:
            held[written[0]] = ca.MX(arguments[read[0]][read[1]])
        elif kind == ca.OP_CONST:
            held[written[0]] = ca.MX(function.instruction_constant(k))
        elif len(read) == 1:
            held[written[0]] = ca.MX.unary(kind, held[read[0]])
        else:
            first, second = (held[register] for register in read)
            held[written[0]] = ca.MX.binary(kind, first, second)
    return results


def in_rows(function: ca.Function, n: int) -> ca.Function:
    """A function of a column and parameters, for n columns that are rows of a table.

    By `in_columns`; every result is a table too, a row for each.

    Args:
        function: of scalars (SX), with dense arguments and results.
        n: number of rows.
    """
    rows = ca.MX.sym("rows", n, function.size1_in(0))
    theta = ca.MX.sym("theta", function.size1_in(1))
    tables = []
    for entries in in_columns(function, [ca.horzsplit(rows), ca.vertsplit(theta)]):
        # A number where all rows have the same.
        tables.append(ca.horzcat(*(ca.MX.zeros(n) + entry for entry in entries)))
    return ca.Function("rows", [rows, theta], tables)
