"""Directions: what a term of R or F acts along, a state or a sum of states.

"p1 - p2" is the vector b = (1, -1) in the equations of p1 and p2. A loss r along it is
r b b' in the matrix R, which stays positive semidefinite wherever r >= 0: a damper
between two bodies. A force f along it is f b: what one state loses the other one gets.
Factors may have numbers and parameters, as in "h2 - s*h1" or "T1/C1 - T2/C2", and in F
efforts, inputs and the time: "dH_dp2*p1 - dH_dp1*p2" exchanges energy without loss, as
an entry of S does. A state alone is the direction with one entry.
"""

import ast
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.expressions import names_of, needs_brackets, parse

ONE = "1"


class Part(NamedTuple):
    """A state in a direction, with the sign of its factor, and the factor's formula."""

    state: str
    sign: int
    factor: str

    def times(self, what: str) -> str:
        """A product with the factor, as text without its sign."""
        if self.factor == ONE:
            return what
        factor = f"({self.factor})" if needs_brackets(self.factor) else self.factor
        return f"{factor}*{what}"


@lru_cache(maxsize=1024)
def direction_parts(direction: str, states: tuple[str, ...]) -> tuple[Part, ...]:
    """The states of a direction in their order, each with its factor.

    Raises:
        ModelError: it is no sum of states, each once and with a factor.
    """
    parts = tuple(_parts(parse(direction), direction, states, 1))
    found = [part.state for part in parts]
    for state in found:
        if found.count(state) > 1:
            raise ModelError(f"direction {direction!r} has {state!r} twice.")
    return parts


def _parts(
    node: ast.expr, direction: str, states: Sequence[str], sign: int
) -> Iterator[Part]:
    match node:
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            yield from _parts(left, direction, states, sign)
            yield from _parts(right, direction, states, sign)
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            yield from _parts(left, direction, states, sign)
            yield from _parts(right, direction, states, -sign)
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            yield from _parts(inner, direction, states, -sign)
        case _:
            found = _factor(node, states)
            if found is None:
                text = ast.unparse(node)
                raise ModelError(
                    f"{text!r} in {direction!r} is neither a state of the model "
                    f"({', '.join(states)}) nor a multiple of one; write a direction "
                    'as a sum of states, such as "p1 - p2".'
                    f"{did_you_mean(text, states)}"
                )
            yield Part(found[0], sign, _text(found[1]))


def _factor(node: ast.expr, states: Sequence[str]) -> tuple[str, ast.expr] | None:
    """The one state of a product and all other factors; None for any other formula."""
    match node:
        case ast.Name(id=name) if name in states:
            return name, ast.Constant(1)
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
            is_second = isinstance(op, ast.Mult) and not _states_in(left, states)
            other = left if is_second else right
            found = _factor(right if is_second else left, states)
            if found is None or _states_in(other, states):
                return None
            state, factor = found
            if isinstance(op, ast.Mult) and ast.unparse(factor) == ONE:
                return state, other
            return state, ast.BinOp(factor, op, other)
    return None


def _states_in(node: ast.expr, states: Sequence[str]) -> set[str]:
    """The states in a part of a formula."""
    return set(names_of(ast.unparse(node))).intersection(states)


def normal_direction(direction: str, states: Sequence[str]) -> str:
    """A direction as it is kept; a state stays as it is."""
    if direction in states:
        return direction
    direction_parts(direction, tuple(states))  # refuses what is none
    return _text(parse(direction))


def _text(node: ast.expr) -> str:
    return ast.unparse(node).replace(" * ", "*").replace(" / ", "/")


def factors_of(direction: str, states: Sequence[str]) -> set[str]:
    """Names in the factors of a direction; "" has none."""
    is_plain = not direction or direction in states
    return set() if is_plain else set(names_of(direction)).difference(states)


def summed(parts: Sequence[Part], names: Mapping[str, str]) -> str:
    """A direction with other names in place of the states: (dH_dp1 - dH_dp2)."""
    text = ""
    for part in parts:
        text += f" {'-' if part.sign < 0 else '+'} {part.times(names[part.state])}"
    text = text.removeprefix(" + ").lstrip()
    return text if len(parts) == 1 and parts[0].sign > 0 else f"({text})"
