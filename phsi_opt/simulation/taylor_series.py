"""Taylor series of a motion and of its sensitivities, in decimal numbers.

Of dx/dt = f(x, u, t, theta) and dS/dt = f_x S + f_theta, with S = dx/d(x0, theta)::

    x(t0 + s) = x_0 + x_1 s + x_2 s^2 + ...

Every instruction of the CasADi function has a recurrence for its next coefficient
(Griewank and Walther, Evaluating Derivatives, 2008, chapter 13); slopes of sines,
exponentials and so on are CasADi's own. At a corner, such as that of ``abs``, the
branch counts on which the motion starts. A hundred digits, since the smallest part of
such series that tells a parameter is far below the rounding of floats.
"""

from collections.abc import Callable, Iterable, Sequence
from decimal import Decimal, getcontext
from functools import cached_property
from math import atan
from operator import mul
from typing import NamedTuple

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.column_function import carried_out, instructions_of

NO_CHANGE = Decimal(0)


class Node(NamedTuple):
    """A value with its coefficients so far, and the nodes from which it follows."""

    kind: int  # CasADi's number of the operation
    of: tuple["Node", ...]
    c: list[Decimal]
    is_constant: bool
    slope: list["Node"]  # of a function such as exp, once it is known


# ---- the coefficient of order k ------------------------------------------------------

Rule = Callable[..., Decimal]  # of k, the node, and those from which it follows


def _convolved(a: list[Decimal], b: list[Decimal], k: int, first: int = 0) -> Decimal:
    """The sum of a[j] b[k - j] for j from ``first`` to k."""
    return sum(map(mul, a[first : k + 1], b[k - first :: -1]), NO_CHANGE)


def _product(k: int, node: Node, a: Node, b: Node) -> Decimal:
    if a.is_constant or b.is_constant:
        return a.c[0] * b.c[k] if a.is_constant else a.c[k] * b.c[0]
    return _convolved(a.c, b.c, k)


def _quotient(k: int, node: Node, a: Node, b: Node) -> Decimal:
    known = NO_CHANGE if b.is_constant or not k else _convolved(b.c, node.c, k, 1)
    return (a.c[k] - known) / b.c[0]


def _inverse(k: int, node: Node, a: Node) -> Decimal:
    return -_convolved(a.c, node.c, k, 1) / a.c[0] if k else 1 / a.c[0]


def _power(k: int, node: Node, a: Node, exponent: Decimal) -> Decimal:
    if not k:
        return a.c[0] ** exponent
    total = NO_CHANGE
    for j in range(1, k + 1):
        total += (exponent * j - (k - j)) * a.c[j] * node.c[k - j]
    return total / (k * a.c[0])


def _function(start: Callable[[Decimal], Decimal]) -> Rule:
    """Of exp and so on: k g_k is the sum of j a_j times coefficient k - j of dg/da."""

    def rule(k: int, node: Node, a: Node) -> Decimal:
        if not k:
            return start(a.c[0])
        slope = node.slope[0].c
        return sum((j * a.c[j] * slope[k - j] for j in range(1, k + 1)), NO_CHANGE) / k

    return rule


def _chosen(condition: Callable[[Decimal, Decimal], bool]) -> Rule:
    return lambda k, node, a, b: (a if condition(a.c[0], b.c[0]) else b).c[k]


def _told(condition: Callable[..., int]) -> Rule:
    def rule(k: int, node: Node, *of: Node) -> Decimal:
        return Decimal(0 if k else int(condition(*(one.c[0] for one in of))))

    return rule


def _turned(angle: Decimal) -> tuple[Decimal, Decimal]:
    """Its cosine and sine: the series of a small part, doubled again and again."""
    n_doubled = 40
    x = angle / 2**n_doubled
    cosine, sine = Decimal(1), x
    term, k = x, 1
    while abs(term) > Decimal(10) ** (-getcontext().prec - 60):
        k += 1
        term *= x / k
        if k % 2:
            sine += term if k % 4 == 1 else -term
        else:
            cosine += term if k % 4 == 0 else -term
    for _ in range(n_doubled):
        cosine, sine = cosine * cosine - sine * sine, 2 * cosine * sine
    return cosine, sine


def _arctangent(x: Decimal) -> Decimal:
    angle = Decimal(atan(x))
    for _ in range(6):  # Newton's steps double the digits
        cosine, sine = _turned(angle)
        angle += (x * cosine - sine) * cosine
    return angle


FUNCTIONS: dict[int, Rule] = {
    ca.OP_EXP: _function(Decimal.exp),
    ca.OP_LOG: _function(Decimal.ln),
    ca.OP_SIN: _function(lambda a: _turned(a)[1]),
    ca.OP_COS: _function(lambda a: _turned(a)[0]),
    ca.OP_TAN: _function(lambda a: _turned(a)[1] / _turned(a)[0]),
    ca.OP_ATAN: _function(_arctangent),
    ca.OP_SINH: _function(lambda a: (a.exp() - (-a).exp()) / 2),
    ca.OP_COSH: _function(lambda a: (a.exp() + (-a).exp()) / 2),
    ca.OP_TANH: _function(lambda a: 1 - 2 / ((2 * a).exp() + 1)),
}
CORNERS: dict[int, Rule] = {
    ca.OP_FMIN: _chosen(lambda a, b: a <= b),
    ca.OP_FMAX: _chosen(lambda a, b: a >= b),
    ca.OP_FABS: lambda k, node, a: -a.c[k] if a.c[0] < 0 else a.c[k],
    ca.OP_IF_ELSE_ZERO: lambda k, node, a, b: b.c[k] if a.c[0] else NO_CHANGE,
    ca.OP_SIGN: _told(lambda a: (a > 0) - (a < 0)),
    ca.OP_LT: _told(lambda a, b: a < b),
    ca.OP_LE: _told(lambda a, b: a <= b),
    ca.OP_EQ: _told(lambda a, b: a == b),
    ca.OP_NE: _told(lambda a, b: a != b),
    ca.OP_NOT: _told(lambda a: not a),
    ca.OP_AND: _told(lambda a, b: bool(a and b)),
    ca.OP_OR: _told(lambda a, b: bool(a or b)),
}
RULES: dict[int, Rule] = {
    ca.OP_ASSIGN: lambda k, node, a: a.c[k],
    ca.OP_ADD: lambda k, node, a, b: a.c[k] + b.c[k],
    ca.OP_SUB: lambda k, node, a, b: a.c[k] - b.c[k],
    ca.OP_NEG: lambda k, node, a: -a.c[k],
    ca.OP_TWICE: lambda k, node, a: 2 * a.c[k],
    ca.OP_MUL: _product,
    ca.OP_SQ: lambda k, node, a: _product(k, node, a, a),
    ca.OP_DIV: _quotient,
    ca.OP_INV: _inverse,
    ca.OP_CONSTPOW: lambda k, node, a, b: _power(k, node, a, b.c[0]),
    ca.OP_SQRT: lambda k, node, a: _power(k, node, a, Decimal("0.5")),
    **FUNCTIONS,
    **CORNERS,
}


# ---- functions as nodes --------------------------------------------------------------


class Nodes:
    """The values of functions of scalars, each worked out once.

    Attributes:
        nodes: in an order in which a coefficient follows from those before.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[tuple[object, ...], Node] = {}

    def results(
        self, function: ca.Function, arguments: Sequence[Sequence[Node]]
    ) -> list[list[Node]]:
        """The entries of every result, from those of each argument."""
        found: list[list[Node]] = []
        for i in range(function.n_out()):
            found.append([self._number(0.0)] * function.nnz_out(i))
        listed = instructions_of(
            function, lambda kind, _: lambda *of: self._node(kind, of), self._number
        )
        for number, entry, node in carried_out(listed, arguments):
            found[number][entry] = node
        return found

    def _number(self, value: float) -> Node:
        coefficients = [Decimal(value)]
        made = Node(ca.OP_CONST, (), coefficients, is_constant=True, slope=[])
        return self._known.setdefault((ca.OP_CONST, value), made)

    def _node(self, kind: int, of: tuple[Node, ...]) -> Node:
        if kind == ca.OP_POW:
            logarithm = self._node(ca.OP_LOG, of[:1])
            return self._node(ca.OP_EXP, (self._node(ca.OP_MUL, (of[1], logarithm)),))
        key = (kind, *map(id, of))
        if key not in self._known:
            is_constant = all(one.is_constant for one in of)
            node = Node(kind, of, [], is_constant, [])
            self._known[key] = node  # before its slope, which may contain it
            self.nodes.append(node)
            if kind in FUNCTIONS and not is_constant:
                s = ca.SX.sym("s")
                slope = ca.densify(ca.jacobian(ca.SX.unary(kind, s), s))
                of_s = ca.Function("slope", [s], [slope])
                node.slope.append(self.results(of_s, [of])[0][0])
        return self._known[key]

    def extend(self, k: int) -> None:
        """Work out the coefficients of order k."""
        for node in self._known.values():
            if node.kind == ca.OP_CONST and k:
                node.c.append(NO_CHANGE)
        for node in self.nodes:
            is_zero = k and node.is_constant
            value = NO_CHANGE if is_zero else RULES[node.kind](k, node, *node.of)
            node.c.append(value)


# ---- the motion of a model -----------------------------------------------------------


def sensitivities(model: Model) -> ca.Function:
    """Of (x, S, u, t, theta): the rates of x and S, what is shown, and its slopes.

    S and the slopes are (n_states, n_states + n_free), in the starting states and the
    parameters.
    """
    return model.built("sensitivities", lambda: _sensitivities(model))


def _sensitivities(model: Model) -> ca.Function:
    x, u, t, theta = argument_symbols(model.rhs())
    n, n_free = model.n_states, len(model.free)
    S = ca.SX.sym("S", n, n + n_free)

    def with_slopes(function: ca.Function) -> list[ca.SX]:
        value = function(x, u, t, theta)
        direct = ca.horzcat(ca.SX(n, n), ca.jacobian(value, theta))
        return [value, ca.mtimes(ca.jacobian(value, x), S) + direct]

    results = [*with_slopes(model.rhs()), *with_slopes(model.output())]
    dense = list(map(ca.densify, ca.cse(results)))
    return ca.Function("sensitivities", [x, S, u, t, theta], dense)


class Motion:
    """The series of one motion, extended by one order after the other.

    Args:
        model: of the motion.
        x: (n_states,) where it starts.
        theta: (n_free,) parameters.
        draw: gives the next coefficient of an input: any function of time.

    Attributes:
        sizes: (n_states + n_free,) where it starts, and the parameters.
        slopes: by order, of what the sensors show, (n_states, n_states + n_free).
    """

    def __init__(
        self,
        model: Model,
        x: Sequence[Decimal],
        theta: Sequence[Decimal],
        draw: Callable[[], Decimal],
    ) -> None:
        n, n_free = model.n_states, len(model.free)
        self._draw = draw
        self._nodes = Nodes()
        unit = np.eye(n, n + n_free).ravel("F").tolist()
        self._x = _sources(x)
        self._S = _sources(map(Decimal, unit))
        self._u = _sources([None] * model.n_inputs)
        self._t = _sources([draw()])
        self._theta = _sources(theta, is_constant=True)
        arguments = [self._x, self._S, self._u, self._t, self._theta]
        results = self._nodes.results(sensitivities(model), arguments)
        self._rates = results[0] + results[1]
        self._shown = results[3]
        self.sizes = [*x, *theta]
        self.slopes: list[list[list[Decimal]]] = []

    @cached_property
    def has_corners(self) -> bool:
        """Whether it is one branch of several."""
        return any(node.kind in CORNERS for node in self._nodes.nodes)

    def order(self, k: int) -> list[list[Decimal]]:
        """Coefficient k of the slopes of what is shown, a row per sensor."""
        while len(self.slopes) <= k:
            self._extend()
        return self.slopes[k]

    def _extend(self) -> None:
        k = len(self.slopes)
        for node in self._u:
            node.c.append(self._draw())
        self._nodes.extend(k)
        for node, rate in zip(self._x + self._S, self._rates, strict=True):
            node.c.append(rate.c[k] / (k + 1))
        self._t[0].c.append(NO_CHANGE if k else Decimal(1))
        for node in self._theta:
            node.c.append(NO_CHANGE)
        n = len(self._x)
        rows = []
        for i in range(n):
            rows.append([node.c[k] for node in self._shown[i::n]])
        self.slopes.append(rows)


def _sources(starts: Iterable[Decimal | None], is_constant: bool = False) -> list[Node]:
    """Nodes whose coefficients are given, the first ones at once; None: none yet."""
    found = []
    for start in starts:
        first = [] if start is None else [start]
        found.append(Node(ca.OP_INPUT, (), first, is_constant, []))
    return found
