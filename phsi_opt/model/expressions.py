"""Formulas as text: one whitelist, read into CasADi, SymPy or NumPy.

Text is parsed into Python's own syntax tree and walked; nothing is ever evaluated as
code, so a model file is data. What may stand in a formula: numbers, names, ``+ - * /
**``, brackets and the functions of `FUNCTIONS`. The same walk serves every backend, so
what is solved, what is printed and what is exported cannot drift apart.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from phsi_opt.errors import ModelError, did_you_mean

# name: (CasADi, SymPy, NumPy)
FUNCTIONS: dict[
    str, tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]
] = {
    "sin": (ca.sin, sp.sin, np.sin),
    "cos": (ca.cos, sp.cos, np.cos),
    "tan": (ca.tan, sp.tan, np.tan),
    "atan": (ca.atan, sp.atan, np.arctan),
    "exp": (ca.exp, sp.exp, np.exp),
    "log": (ca.log, sp.log, np.log),
    "sqrt": (ca.sqrt, sp.sqrt, np.sqrt),
    "tanh": (ca.tanh, sp.tanh, np.tanh),
    "abs": (ca.fabs, sp.Abs, np.abs),
    "sign": (ca.sign, sp.sign, np.sign),
    "min": (ca.fmin, sp.Min, np.minimum),
    "max": (ca.fmax, sp.Max, np.maximum),
}
CASADI, SYMPY, NUMPY = 0, 1, 2
Backend = (
    int | Mapping[str, Callable[..., Any]]
)  # one of the three, or a table of its own functions by these names
CONSTANTS = {"pi": (math.pi, sp.pi, math.pi)}
TWO_ARGUMENTS = {"min", "max"}
OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
# characters; a formula is written by a person, a longer one is a mistake or an attack
LONGEST = 10_000
LARGEST_EXPONENT = 64
DEEPEST = 200  # operations and functions inside one another; the walks are recursive


@lru_cache(maxsize=4096)
def parse(text: str) -> ast.expr:
    """Read a formula; raise `ModelError` that shows what is not allowed in it."""
    if not isinstance(text, str) or not text.strip():
        raise ModelError(
            f"formula {text!r} is not text; expected an expression such as 'k*q**2/2'."
        )
    if len(text) > LONGEST:
        raise ModelError(
            f"a formula of {len(text)} characters is too long (limit {LONGEST}); split it into terms."
        )
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _check(tree, text)
    except SyntaxError as error:
        hint = " Write a power as **." if "^" in text else ""
        raise ModelError(
            f"formula {text!r} cannot be read: {error.msg} at column {error.offset}.{hint}"
        ) from None
    except (RecursionError, MemoryError):
        raise ModelError(
            f"formula {text[:60]!r}... is nested too deeply; split it into terms."
        ) from None
    return tree


def _check(node: ast.AST, text: str, depth: int = 0) -> None:
    if depth > DEEPEST:
        raise RecursionError
    if isinstance(node, ast.BinOp):
        _check(node.left, text, depth + 1)
        _check(node.right, text, depth + 1)
        _check_operator(node, text)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        _check(node.operand, text, depth + 1)
    elif isinstance(node, ast.Call):
        _check_call(node, text)
        for argument in node.args:
            _check(argument, text, depth + 1)
    elif isinstance(node, ast.Constant):
        if not _is_finite(node.value):
            raise ModelError(
                f"{_source(node, text)[:60]!r} in formula {text[:60]!r} is not a finite number."
            )
    elif not isinstance(node, ast.Name):
        raise ModelError(
            f"{_source(node, text)!r} in formula {text!r} is not allowed; a formula holds numbers, names, + - * / **, "
            f"brackets and the functions {', '.join(FUNCTIONS)}."
        )


def _is_finite(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond the floats
        return False


def _source(node: ast.AST, text: str) -> str:
    return ast.get_source_segment(text.strip(), node) or type(node).__name__


def _check_operator(node: ast.BinOp, text: str) -> None:
    if type(node.op) not in OPERATORS:
        hint = " Write a power as **." if isinstance(node.op, ast.BitXor) else ""
        raise ModelError(
            f"the operator in {_source(node, text)!r} of formula {text!r} is not allowed.{hint}"
        )
    if (
        isinstance(node.op, ast.Pow)
        and abs(_number(node.right, text) or 0.0) > LARGEST_EXPONENT
    ):
        raise ModelError(
            f"the exponent in {_source(node, text)!r} is beyond {LARGEST_EXPONENT}; rescale the term."
        )
    # In floats a tower of powers overflows at once; in the whole numbers of SymPy it
    # would fill the memory.
    _number(node, text)


def _number(node: ast.expr, text: str) -> float | None:
    """Value of a part without names, which must be finite; None for a part with names."""
    if names_of(node):
        return None
    with np.errstate(all="ignore"):
        value = _walk(node, {}, NUMPY, text)
    if isinstance(value, complex) or not math.isfinite(value):
        raise ModelError(
            f"{_source(node, text)!r} in formula {text!r} has no finite value."
        )
    return float(value)


def _check_call(node: ast.Call, text: str) -> None:
    if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
        called = _source(node.func, text)
        hint = did_you_mean(called, FUNCTIONS)
        raise ModelError(
            f"function {called!r} in formula {text!r} is not known; expected one of {', '.join(FUNCTIONS)}.{hint}"
        )
    expected = 2 if node.func.id in TWO_ARGUMENTS else 1
    if node.keywords or len(node.args) != expected:
        raise ModelError(
            f"{_source(node, text)!r} in formula {text!r}: {node.func.id} takes {expected} argument(s)."
        )


def names_of(node: ast.AST | str) -> set[str]:
    """Names that a formula uses: states, inputs, parameters, the time (not its
    functions, not pi).
    """
    return set(_names_in(node)) if isinstance(node, str) else _names_below(node)


@lru_cache(maxsize=1024)
def _names_in(text: str) -> frozenset[str]:
    return frozenset(_names_below(parse(text)))


def _names_below(tree: ast.AST) -> set[str]:
    called = {id(part.func) for part in ast.walk(tree) if isinstance(part, ast.Call)}
    found = {
        part.id
        for part in ast.walk(tree)
        if isinstance(part, ast.Name) and id(part) not in called
    }
    return found - set(CONSTANTS)


def evaluate(text: str, names: Mapping[str, Any], backend: Backend = CASADI) -> Any:
    """Value of the formula with ``names`` replaced, in CasADi (default), SymPy, NumPy
    or with other functions.
    """
    return _walk(parse(text), names, backend, text)


def _walk(node: ast.expr, names: Mapping[str, Any], backend: Backend, text: str) -> Any:
    if isinstance(node, ast.BinOp):
        left, right = (
            _walk(node.left, names, backend, text),
            _walk(node.right, names, backend, text),
        )
        try:
            return OPERATORS[type(node.op)](left, right)
        except (ZeroDivisionError, OverflowError) as error:
            raise ModelError(
                f"formula {text!r} has no finite value: {error}."
            ) from None
    if isinstance(node, ast.UnaryOp):
        operand = _walk(node.operand, names, backend, text)
        return -operand if isinstance(node.op, ast.USub) else operand
    if isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name)  # parse() let nothing else through
        function = (
            FUNCTIONS[node.func.id][backend]
            if isinstance(backend, int)
            else backend[node.func.id]
        )
        return function(*(_walk(part, names, backend, text) for part in node.args))
    if isinstance(node, ast.Name):
        return _lookup(node.id, names, backend, text)
    assert isinstance(node, ast.Constant) and isinstance(node.value, int | float)
    return sp.sympify(node.value) if backend == SYMPY else float(node.value)


def _lookup(name: str, names: Mapping[str, Any], backend: Backend, text: str) -> Any:
    if name in names:
        return names[name]
    if name in CONSTANTS:
        return CONSTANTS[name][backend if isinstance(backend, int) else NUMPY]
    hint = (
        did_you_mean(name, names)
        or f" Give it a value: formula({text!r}, {name}=Parameter(...))."
    )
    raise ModelError(
        f"name {name!r} in formula {text!r} is unknown; known are {', '.join(sorted(names))}.{hint}"
    )


def renamed(text: str, names: Mapping[str, str]) -> str:
    """The formula with names exchanged."""
    tree = ast.parse(text.strip(), mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in names:
            node.id = names[node.id]
    return ast.unparse(tree)
