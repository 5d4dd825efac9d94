"""A CasADi function at many places at once: a number per place, NumPy's arithmetic.

CasADi's interpreter goes through a function's instructions once for every interval of a
record. Here each instruction is carried out for all intervals together, which takes a
fraction of the time, and what has one value for all of them (parameters, numbers in
formulas) is worked out once. The instructions are those that CasADi lists of a function
of scalars; nothing is generated or compiled.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
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
# Functions whose instructions are remembered, those last asked for.
MOST_LISTINGS = 128
MOST_MACHINES = 32  # memories that are kept


def _if_else_zero(condition: np.ndarray, value: np.ndarray, out: np.ndarray) -> None:
    np.copyto(out, np.where(condition != 0, value, 0.0))


def _twice(value: np.ndarray, out: np.ndarray) -> None:
    np.add(value, value, out)


OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: np.positive,
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: _twice,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_NOT: np.logical_not,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FMOD: np.fmod,
    ca.OP_FABS: np.fabs,
    ca.OP_SIGN: np.sign,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
    ca.OP_ERF: erf,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_INV: np.reciprocal,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_LOG1P: np.log1p,
    ca.OP_EXPM1: np.expm1,
    ca.OP_HYPOT: np.hypot,
}


@dataclass(frozen=True)
class _Instruction:
    """One operation: numbers of the cells that it reads, and of the one it writes."""

    operation: Callable[..., Any]
    read: tuple[int, ...]
    written: int


@dataclass
class _Listing:
    """The instructions of a function, and the cells that they read and write.

    A cell is a number, or a number per place: an entry of an argument, a constant, or
    what an instruction writes.

    Attributes:
        constants: cell and value of every number.
        shared_inputs: cell, argument and entry of arguments with one value for all.
        inputs: cell, argument and entry of the others.
        shared: instructions whose results have one value for all places.
        columns: the others, in their order.
        outputs: cell, result and entry of every result.
        n_cells: number of cells.
        wide: cells with a number per place that instructions write.
    """

    constants: list[tuple[int, float]] = field(default_factory=list)
    shared_inputs: list[tuple[int, int, int]] = field(default_factory=list)
    inputs: list[tuple[int, int, int]] = field(default_factory=list)
    shared: list[_Instruction] = field(default_factory=list)
    columns: list[_Instruction] = field(default_factory=list)
    outputs: list[tuple[int, int, int]] = field(default_factory=list)
    n_cells: int = 0
    wide: set[int] = field(default_factory=set)

    @property
    def at_once(self) -> int:
        """Number of places that are worked on at once."""
        n_wide = len(self.wide) + len(self.inputs)
        return min(AT_ONCE, max(NUMBERS_AT_ONCE // n_wide, LEAST_AT_ONCE))

    def new_cell(self) -> int:
        """Number of a further cell."""
        self.n_cells += 1
        return self.n_cells - 1


@lru_cache(MOST_LISTINGS)
def _listing(function: ca.Function, is_shared: tuple[bool, ...]) -> _Listing:
    """The instructions, for arguments that have one value for all places or many.

    CasADi's registers are used again and again; a register that holds a number per
    place is one cell, and a single number has a cell of its own.
    """
    simpler = _without_repetitions(function)
    listing = _Listing()
    cell_of: dict[int, int] = {}  # by register, what it holds now
    register_cells: dict[int, int] = {}
    is_wide: set[int] = set()
    for k in range(simpler.n_instructions()):
        kind = simpler.instruction_id(k)
        read = simpler.instruction_input(k)
        written = simpler.instruction_output(k)
        if kind == ca.OP_OUTPUT:
            # Kept apart: the register may be written again before the end.
            cell = listing.new_cell()
            listing.wide.add(cell)
            copied = _Instruction(np.positive, (cell_of[read[0]],), cell)
            listing.columns.append(copied)
            listing.outputs.append((cell, written[0], written[1]))
            continue
        if kind == ca.OP_CONST:
            cell = listing.new_cell()
            listing.constants.append((cell, simpler.instruction_constant(k)))
        elif kind == ca.OP_INPUT:
            cell = listing.new_cell()
            one_for_all = is_shared[read[0]]
            places = listing.shared_inputs if one_for_all else listing.inputs
            places.append((cell, read[0], read[1]))
            if not one_for_all:
                is_wide.add(cell)
        else:
            cells = tuple(cell_of[register] for register in read)
            if is_wide.isdisjoint(cells):
                cell = listing.new_cell()
                listing.shared.append(_Instruction(OPERATIONS[kind], cells, cell))
            else:
                if written[0] not in register_cells:
                    register_cells[written[0]] = listing.new_cell()
                cell = register_cells[written[0]]
                is_wide.add(cell)
                listing.wide.add(cell)
                listing.columns.append(_Instruction(OPERATIONS[kind], cells, cell))
        cell_of[written[0]] = cell
    return listing


def _without_repetitions(function: ca.Function) -> ca.Function:
    """The same function, what it repeats worked out once."""
    arguments = []
    for i in range(function.n_in()):
        arguments.append(ca.SX.sym(function.name_in(i), function.sparsity_in(i)))
    results = function.call(arguments)
    return ca.Function("columns", arguments, ca.cse(results))


_Bound = list[tuple[Callable[..., Any], tuple[np.ndarray, ...], np.ndarray]]


class _Machine:
    """A listing with memory for a number of places; constants stand in it already.

    Attributes:
        listing: the instructions.
        cells: their memory.
        shared: instructions for all places at once, bound to it.
        columns: the others.
    """

    def __init__(self, listing: _Listing, size: int) -> None:
        wide = listing.wide | {cell for cell, _, _ in listing.inputs}
        cells = []
        for cell in range(listing.n_cells):
            cells.append(np.zeros(size if cell in wide else 1))
        for cell, value in listing.constants:
            cells[cell][0] = value
        self.listing = listing
        self.cells = cells
        self.shared = _bound(listing.shared, cells)
        self.columns = _bound(listing.columns, cells)

    def share(self, arguments: Sequence[np.ndarray]) -> None:
        """Take in what has one value for all places."""
        for cell, argument, entry in self.listing.shared_inputs:
            self.cells[cell][0] = arguments[argument][entry]
        for operation, read, written in self.shared:
            operation(*read, written)

    def work(
        self, place: slice, arguments: Sequence[np.ndarray], results: list[np.ndarray]
    ) -> None:
        """Fill in the results at some places."""
        cells = self.cells
        for cell, argument, entry in self.listing.inputs:
            cells[cell][:] = arguments[argument][entry, place]
        for operation, read, written in self.columns:
            operation(*read, written)
        for cell, result, entry in self.listing.outputs:
            results[result][entry, place] = cells[cell]


def _bound(instructions: list[_Instruction], cells: list[np.ndarray]) -> _Bound:
    """The instructions with the memory that they read and write."""
    bound = []
    for one in instructions:
        read = tuple(cells[cell] for cell in one.read)
        bound.append((one.operation, read, cells[one.written]))
    return bound


@lru_cache(MOST_MACHINES)
def _machine(
    function: ca.Function, is_shared: tuple[bool, ...], size: int, thread: int
) -> _Machine:
    """Each thread has its own memory."""
    return _Machine(_listing(function, is_shared), size)


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
        machine = _machine(self._function, self._is_shared, size, get_ident())
        with np.errstate(all="ignore"):
            machine.share(arguments)
            # The last stretch ends with the record, and may overlap the one before.
            for begin in range(0, n, size):
                first = min(begin, n - size)
                machine.work(slice(first, first + size), arguments, results)
        return results
