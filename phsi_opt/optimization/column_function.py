"""A CasADi function at many places at once: a number per place, NumPy's arithmetic.

CasADi's interpreter goes through a function's instructions once for every interval of a
record. Here each instruction is carried out for all intervals together, which takes a
fraction of the time; what is the same for all of them (parameters, numbers in formulas)
is an array of length one. The instructions are those that CasADi lists of a function of
scalars; nothing is generated or compiled. `in_columns` does the same with CasADi's
symbols in place of numbers.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np
import scipy

AT_ONCE = 2048  # places that are worked on at once, so that registers stay in the cache

# CasADi's name of an operation, and NumPy's.
NUMPY_NAMES = """
ASSIGN positive, OUTPUT positive, ADD add, SUB subtract, MUL multiply, DIV divide,
NEG negative, EXP exp, LOG log, POW power, CONSTPOW power, SQRT sqrt, SQ square,
SIN sin, COS cos, TAN tan, ASIN arcsin, ACOS arccos, ATAN arctan,
FLOOR floor, CEIL ceil, FMOD fmod, FABS fabs, SIGN sign,
COPYSIGN copysign, FMIN fmin, FMAX fmax, INV reciprocal, SINH sinh, COSH cosh,
TANH tanh, ASINH arcsinh, ACOSH arccosh, ATANH arctanh, ATAN2 arctan2, LOG1P log1p,
EXPM1 expm1, HYPOT hypot
"""
NAMES_OF_TESTS = """
LT less, LE less_equal, EQ equal, NE not_equal,
NOT logical_not, AND logical_and, OR logical_or
"""


def _in_floats(test: Callable[..., Any], *operands: np.ndarray) -> np.ndarray:
    return np.asarray(test(*operands), dtype=float)


OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_TWICE: partial(np.multiply, 2.0),
    ca.OP_IF_ELSE_ZERO: lambda condition, value: np.where(condition != 0, value, 0.0),
    ca.OP_ERF: lambda value: scipy.special.erf(value),
}
for _pair in NUMPY_NAMES.split(","):
    _operation, _called = _pair.split()
    OPERATIONS[getattr(ca, f"OP_{_operation}")] = getattr(np, _called)
for _pair in NAMES_OF_TESTS.split(","):
    _operation, _called = _pair.split()
    _test = partial(_in_floats, getattr(np, _called))
    OPERATIONS[getattr(ca, f"OP_{_operation}")] = _test


# CasADi's number of an operation and what carries it out, the registers that it reads
# and writes, and the value of a constant.
Instruction = tuple[int, Any, list[int], list[int], Any]


def instructions_of(
    function: ca.Function,
    operation_of: Callable[[int, int], Any],
    number: Callable[[float], Any],
) -> list[Instruction]:
    """The instructions of a function of scalars with dense arguments."""
    # ``operation_of`` gives the operation of CasADi's number for a number of operands,
    # ``number`` makes a value of a constant.
    listed = []
    for k in range(function.n_instructions()):
        kind = function.instruction_id(k)
        read = function.instruction_input(k)
        is_number = kind == ca.OP_CONST
        value = number(function.instruction_constant(k)) if is_number else None
        operation = operation_of(kind, len(read))
        written = function.instruction_output(k)
        listed.append((kind, operation, read, written, value))
    return listed


def carried_out(
    instructions: list[Instruction], arguments: Sequence[Any]
) -> Iterator[tuple[int, int, Any]]:
    """Number, entry and value of each result, from the entries of each argument."""
    output, argument, constant = ca.OP_OUTPUT, ca.OP_INPUT, ca.OP_CONST
    held: dict[int, Any] = {}  # by register
    for kind, operation, read, written, value in instructions:
        if kind == output:
            yield written[0], written[1], held[read[0]]
        elif kind == argument:
            held[written[0]] = arguments[read[0]][read[1]]
        elif kind == constant:
            held[written[0]] = value
        elif len(read) == 1:
            held[written[0]] = operation(held[read[0]])
        else:
            held[written[0]] = operation(held[read[0]], held[read[1]])


@lru_cache(128)  # those last asked for
def _with_numpy(function: ca.Function) -> list[Instruction]:
    """NumPy's instructions, what the function repeats worked out once."""
    arguments = []
    for i in range(function.n_in()):
        arguments.append(ca.SX.sym(function.name_in(i), function.sparsity_in(i)))
    results = ca.cse(function.call(arguments))
    once = ca.Function("columns", arguments, results)
    return instructions_of(
        once, lambda kind, _: OPERATIONS.get(kind), partial(np.full, 1)
    )


def in_numbers(function: ca.Function, *arguments: np.ndarray) -> list[np.ndarray]:
    """Every result as its entries (column by column), (n_entries, n_places).

    Args:
        function: of scalars (SX), with dense arguments.
        *arguments: (n_rows, n_places) each; (n_rows,) where all places share them.
    """
    n = next(argument.shape[1] for argument in arguments if argument.ndim == 2)
    results = [np.zeros((function.nnz_out(i), n)) for i in range(function.n_out())]
    instructions = _with_numpy(function)
    with np.errstate(all="ignore"):
        for first in range(0, n, AT_ONCE):
            place = slice(first, first + AT_ONCE)
            parts = []
            for argument in arguments:
                is_shared = argument.ndim == 1
                parts.append(argument[:, None] if is_shared else argument[:, place])
            for number, entry, value in carried_out(instructions, parts):
                results[number][entry, place] = value
    return results


def _operation_on_symbols(kind: int, n_operands: int) -> Callable[..., ca.MX]:
    return partial(ca.MX.unary if n_operands == 1 else ca.MX.binary, kind)


def in_columns(
    function: ca.Function, arguments: Sequence[Sequence[ca.MX | ca.DM]], n: int
) -> list[ca.MX]:
    """The same in symbols: a program's function at n places, a row of results for each.

    `Function.map` goes through the instructions once for every place. Here CasADi's
    interpreter has one step for all of them: SRK4's defects and their slopes take a
    fifth to a tenth of the time.

    Args:
        function: of scalars (SX), with dense arguments.
        arguments: the entries of each: a column (n,), or a number where it is the same
            at all places.
        n: number of places.
    """
    symbols = [list(map(ca.MX, entries)) for entries in arguments]
    zeros = ca.MX.zeros(n)  # beside which a number is a column too
    results = [[zeros] * function.nnz_out(i) for i in range(function.n_out())]
    instructions = instructions_of(function, _operation_on_symbols, ca.MX)
    for number, entry, value in carried_out(instructions, symbols):
        results[number][entry] = zeros + value
    return [ca.horzcat(ca.MX(n, 0), *entries) for entries in results]


def in_rows(function: ca.Function, n: int) -> ca.Function:
    """A function of a column and parameters, for n columns that are rows of a table.

    Every result is a table too, a row for each.
    """
    rows = ca.MX.sym("rows", n, function.size1_in(0))
    theta = ca.MX.sym("theta", function.size1_in(1))
    tables = in_columns(function, [ca.horzsplit(rows), ca.vertsplit(theta)], n)
    return ca.Function("rows", [rows, theta], tables)
