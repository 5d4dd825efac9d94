"""Formulas as text: read through a whitelist, evaluated in CasADi, SymPy or NumPy.

Text is parsed into Python's own syntax tree and walked; nothing is ever run as code, so
a model file is data. What may stand in a formula: numbers, names, ``+ - * / **``,
brackets and `FUNCTIONS`. The same walk serves every backend, so what
is solved, what is printed and what is exported cannot drift apart.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.arguments import is_of
from phsi_opt.errors import ModelError, did_you_mean, shown
from phsi_opt.presentation.numbers import shortened

# Names that have a value of their own in a formula.
CONSTANTS: Mapping[str, float] = {"pi": math.pi}


@dataclass(frozen=True)
class Backend:
    """A library in which formulas are evaluated."""

    # Its function for each name of `FUNCTIONS`.
    functions: Mapping[str, Callable[..., Any]]
    # What turns a Python number into one of the library.
    number: Callable[[float], Any] = float
    # Its value for each name of `CONSTANTS`.
    constants: Mapping[str, Any] = field(default_factory=lambda: CONSTANTS)


# Names that a formula may call.
FUNCTIONS = (
    *("sin", "cos", "tan", "atan", "exp", "log"),
    *("sqrt", "sinh", "tanh", "abs", "sign", "min", "max"),
    "delayed",
)

# Names that no state, input or parameter can have.
RESERVED_IN_FORMULAS = ("t", *FUNCTIONS, *CONSTANTS)


def functions_of(library: Any, **other_names: str) -> dict[str, Callable[..., Any]]:
    """The functions of a library, some of which have another name there."""
    names = {name: other_names.get(name, name) for name in FUNCTIONS[:-1]}
    found = {name: getattr(library, called) for name, called in names.items()}
    return {**found, "delayed": lambda signal, delay: signal}  # of an unknown past


CASADI = Backend(functions_of(ca, abs="fabs", min="fmin", max="fmax"))
NUMPY = Backend(functions_of(np, atan="arctan", min="minimum", max="maximum"))

TWO_ARGUMENTS = ("min", "max", "delayed")  # the other functions take one
OPERATORS: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
# What to do about a formula that cannot be read, by what it or Python's message holds.
HINTS = {
    "^": "Write a power as **.",
    "=": "Give the right-hand side alone, without =.",
    "decimal literal": "Write a product with *, as in 2*q.",
    "never closed": "Close the bracket.",
}
# Beyond any law of physics, and short of what fills the memory as a whole number.
MAX_EXPONENT = 64
_shortened = partial(shortened, most=60)  # a formula, in a message


# ---- reading -------------------------------------------------------------------------


@lru_cache(maxsize=4096)
def parse(text: str) -> ast.expr:
    """The syntax tree of a formula.

    Raises:
        ModelError: what is not allowed in it.
    """
    if not isinstance(text, str) or not text.strip():
        raise ModelError(
            f"formula {shown(text)} is not text; expected an expression such as "
            "'k*q**2/2'."
        )
    if len(text) > 10_000:  # written by no person: a mistake or an attack
        raise ModelError(
            f"a formula of {len(text)} characters is too long "
            "(limit 10000); split it into terms."
        )
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _check(tree, text)
        # SymPy keeps all digits, and Python prints no more than 4300 of them.
        if _n_bits(tree) > 14_000:
            raise ModelError(
                f"the integers in formula {_shortened(text)!r} have too many digits "
                "when powers are expanded; write decimal numbers, or lower powers."
            )
    except SyntaxError as error:
        told = f"{error.msg} at column {error.offset}."
        hints = [hint for sign, hint in HINTS.items() if sign in f"{text} {told}"]
        said = " ".join([f"cannot be read: {told}", *hints])
    except UnicodeError:
        said = "contains a character that is not valid text."
    except (RecursionError, MemoryError):
        said = "is nested too deeply; split it into terms."
    else:
        return tree
    raise ModelError(f"formula {_shortened(text)!r} {said}")


def _check(node: ast.AST, text: str, depth: int = 0) -> None:
    # The walks are recursive, with two calls for each operation and function inside
    # another one, and Python allows a thousand calls.
    if depth > 200:
        raise RecursionError
    below: list[ast.expr] = []
    match node:
        case ast.BinOp(left=left, right=right):
            below = [left, right]
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            below = [operand]
        case ast.Call(args=below):
            _check_call(node, text)
        case ast.Constant():
            value: Any = node.value  # no bool, no whole number beyond the floats
            if not (is_of(value, float) and math.isfinite(value)):
                raise ModelError(f"{_place(node, text)} is not a finite number.")
        case ast.Name():
            pass
        case _:
            hint = " Decimals have a point: 0.5." if isinstance(node, ast.Tuple) else ""
            raise ModelError(
                f"{_place(node, text)} is not allowed; a formula may contain numbers, "
                "names, + - * / **, brackets and the functions "
                f"{', '.join(FUNCTIONS)}.{hint}"
            )
    for part in below:
        _check(part, text, depth + 1)
    if isinstance(node, ast.BinOp):
        _check_operator(node, text)


def _check_operator(node: ast.BinOp, text: str) -> None:
    if type(node.op) not in OPERATORS:
        hint = f" {HINTS['^']}" if isinstance(node.op, ast.BitXor) else ""
        raise ModelError(f"the operator in {_place(node, text)} is not allowed.{hint}")
    if isinstance(node.op, ast.Pow):
        exponent = _number(node.right, text) or 0.0
        if abs(exponent) > MAX_EXPONENT:
            raise ModelError(
                f"the exponent in {_source(node, text)!r} exceeds {MAX_EXPONENT}; "
                "rescale the term."
            )
    # In floats a tower of powers overflows at once; in the whole numbers of SymPy it
    # would fill the memory.
    _number(node, text)


def _number(node: ast.expr, text: str) -> float | None:
    """Value of a part without names, which must be finite; None for other parts."""
    if _names_below(node):
        return None
    with np.errstate(all="ignore"):
        value = _value(node, {}, NUMPY, text)
    if isinstance(value, complex) or not math.isfinite(value):
        raise ModelError(f"{_place(node, text)} has no finite value.")
    return float(value)


def _n_bits(node: ast.AST) -> int:
    """The bits of the numbers and powers of a part, at most, when it is exact."""
    match node:
        case ast.Constant(value=int() as number):
            return number.bit_length()
        case ast.BinOp(op=ast.Pow(), left=left, right=right):
            power = abs(_number(right, "") or 1.0)
            return math.ceil(_n_bits(left) * max(power, 1.0)) + _n_bits(right)
    return sum(map(_n_bits, ast.iter_child_nodes(node)))


def _check_call(node: ast.Call, text: str) -> None:
    if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
        called = _source(node.func, text)
        hint = did_you_mean(called, FUNCTIONS)
        raise ModelError(
            f"function {called!r} in formula {_shortened(text)!r} is not known; "
            f"expected one of {', '.join(FUNCTIONS)}.{hint}"
        )
    expected = 2 if node.func.id in TWO_ARGUMENTS else 1
    if node.keywords or len(node.args) != expected:
        raise ModelError(
            f"{_place(node, text)}: {node.func.id} takes {expected} argument(s)."
        )


def _place(node: ast.AST, text: str) -> str:
    """A part and its formula, as messages name them."""
    return f"{_source(node, text)!r} in formula {_shortened(text)!r}"


def _source(node: ast.AST, text: str) -> str:
    return _shortened(ast.get_source_segment(text.strip(), node) or type(node).__name__)


# ---- names ---------------------------------------------------------------------------


@lru_cache(maxsize=1024)
def names_of(text: str) -> frozenset[str]:
    """Names that need a value in a formula: states, inputs, parameters, the time.

    The functions that it calls and pi are not among them.
    """
    return frozenset(_names_below(parse(text)))


def needs_brackets(text: str) -> bool:
    """Whether a formula is a sum or has a sign, and not to stand behind a factor."""
    tree = parse(text)
    is_sum = isinstance(tree, ast.BinOp) and isinstance(tree.op, ast.Add | ast.Sub)
    return is_sum or text.lstrip()[0] in "+-"


def _names_below(tree: ast.AST) -> set[str]:
    match tree:
        case ast.Name(id=name):
            return {name} - CONSTANTS.keys()
        case ast.Call(args=parts):
            return set().union(*map(_names_below, parts))
    return set().union(*map(_names_below, ast.iter_child_nodes(tree)))


@lru_cache(maxsize=1024)
def delays_in(text: str) -> tuple[tuple[str, str], ...]:
    """What is delayed by what, in each ``delayed(u, tau)`` of a formula."""
    found = []
    for node in ast.walk(parse(text)):
        match node:
            case ast.Call(func=ast.Name(id="delayed"), args=[signal, delay]):
                found.append((ast.unparse(signal), ast.unparse(delay)))
    return tuple(found)


def angles_in(text: str) -> dict[str, str]:
    """Names that a sine, cosine or tangent takes without a factor, with the call."""
    found: dict[str, str] = {}
    for node in ast.walk(parse(text)):
        match node:
            case ast.Call(func=ast.Name(id="sin" | "cos" | "tan"), args=[angle]):
                products = ast.Mult | ast.Div | ast.Pow
                if not any(isinstance(one, products) for one in ast.walk(angle)):
                    found |= dict.fromkeys(_names_below(angle), ast.unparse(node))
    return found


def divisors(text: str) -> list[str]:
    """What a formula divides by, each before its factors; of c/(2*m) it is m."""
    found: list[ast.expr] = []
    for node in ast.walk(parse(text)):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            found += _factors(node.right)
    return list(map(ast.unparse, found))


def _factors(node: ast.expr) -> list[ast.expr]:
    match node:
        case ast.BinOp(op=ast.Mult(), left=left, right=right):
            factors = _factors(left) + _factors(right)
            is_multiple = any(isinstance(one, ast.Constant) for one in factors)
            return factors if is_multiple else [node, *factors]
        case ast.BinOp(op=ast.Pow(), left=base):
            return [node, *_factors(base)]
    return [node]


def is_linear(text: str, names: Sequence[str]) -> bool:
    """Whether a formula is linear in these names, all others being numbers."""
    symbols = {name: ca.SX.sym(name) for name in names_of(text)}
    chosen = ca.vertcat(*(symbols[name] for name in names))
    return bool(ca.is_linear(ca.SX(evaluate(text, symbols)), chosen))


# ---- evaluation ----------------------------------------------------------------------


def evaluate(text: str, names: Mapping[str, Any], backend: Backend = CASADI) -> Any:
    """Value of the formula with ``names`` replaced by symbols, numbers or arrays.

    Raises:
        ModelError: the formula cannot be read, uses a name that is not given, or
            divides by zero.
    """
    return _value(parse(text), names, backend, text)


def _value(
    node: ast.expr, names: Mapping[str, Any], backend: Backend, text: str
) -> Any:
    """Value of a part of a formula that `parse` has checked."""
    match node:
        case ast.BinOp(left=left, op=sign, right=right):
            values = [_value(part, names, backend, text) for part in (left, right)]
            try:
                return OPERATORS[type(sign)](*values)
            except (ZeroDivisionError, OverflowError) as error:
                raise ModelError(
                    f"formula {_shortened(text)!r} has no finite value: {error}."
                ) from None
        case ast.UnaryOp(op=sign, operand=operand):
            value = _value(operand, names, backend, text)
            return -value if isinstance(sign, ast.USub) else value
        case ast.Call(func=ast.Name(id="delayed")) if ast.unparse(node) in names:
            return names[ast.unparse(node)]
        case ast.Call(func=ast.Name(id=name), args=arguments):
            values = [_value(part, names, backend, text) for part in arguments]
            return backend.functions[name](*values)
        case ast.Constant(value=int() | float() as number):
            return backend.number(number)
        case ast.Name(id=name) if name in names:
            return names[name]
        case ast.Name(id=name) if name in backend.constants:
            return backend.constants[name]
        case ast.Name(id=name):
            give = f" Give it a value: formula({text!r}, {name}=Parameter(...))."
            raise ModelError(
                f"name {name!r} in formula {_shortened(text)!r} is unknown; known are "
                f"{', '.join(sorted(names))}.{did_you_mean(name, names) or give}"
            )
    raise AssertionError(f"{text!r} was not checked")
