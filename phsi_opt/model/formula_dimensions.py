"""What a formula says about the units of its names: sums are of like things.

A unit is a product of powers, so that its logarithm is linear: each part of a formula
has a *form*, the sum of its names' dimensions with their powers. Terms of a sum have
like forms, and what stands in an exponential has none. These *likenesses* are collected
here; `parameter_units` solves them.
"""

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field

from phsi_opt.model.backends import CONSTANTS
from phsi_opt.model.expressions import parse

# Power of each quantity in a dimension, by the quantity's name.
Form = Mapping[str, float]

# A number beyond this one, or one that is no multiple of a quarter, may be a constant
# of physics with a unit of its own, such as 9.81.
LARGEST_PURE_NUMBER = 8
SUM = (ast.Add, ast.Sub)
OF_ANGLES = ("sin", "cos", "tan")
OF_ONE_UNIT = ("abs", "min", "max")


@dataclass(frozen=True)
class Likeness:
    """A form that has no dimension.

    Args:
        form: the powers of the quantities in it.
        is_angle: whether it may have the dimension of the radian.
        is_number: whether a number stands beside it in a sum, as in 1 - q; the number
            may then have a unit of its own.
    """

    form: Form
    is_angle: bool = False
    is_number: bool = False


@dataclass
class Likenesses:
    """All that formulas say; `said` grows with each formula that is walked."""

    said: list[Likeness] = field(default_factory=list)
    n_numbers: int = 0

    def alike(self, first: Form, second: Form) -> None:
        """Says that two forms have one dimension."""
        self.said.append(Likeness(product(first, second, -1.0)))

    def form_of(self, text: str, names: Mapping[str, Form]) -> Form:
        """The dimension of a formula.

        Args:
            text: the formula.
            names: the forms of the names in it.
        """
        return self._form(parse(text), names)

    def _form(self, node: ast.expr, names: Mapping[str, Form]) -> Form:
        match node:
            case ast.Constant(value=int() | float() as number):
                return self._number(float(number))
            case ast.Name(id=name):
                return {} if name in CONSTANTS else names[name]
            case ast.UnaryOp(operand=operand):
                return self._form(operand, names)
            case ast.Call(func=ast.Name(id=called), args=arguments):
                forms = [self._form(one, names) for one in arguments]
                return self._call(called, forms)
            case ast.BinOp(left=left, right=right):
                return self._operation(node, left, right, names)
        raise AssertionError(f"{ast.unparse(node)!r} was not checked")

    def _number(self, number: float) -> Form:
        is_simple = (4 * number).is_integer() and number <= LARGEST_PURE_NUMBER
        return {} if is_simple and number != 0 else self._unknown()

    def _unknown(self) -> Form:
        """A dimension of which nothing is known."""
        self.n_numbers += 1
        return {f"number {self.n_numbers}": 1.0}

    def _call(self, called: str, forms: list[Form]) -> Form:
        first = forms[0]
        if called in OF_ONE_UNIT:
            for other in forms[1:]:
                self.alike(first, other)
            return first
        if called == "sqrt":
            return product({}, first, 0.5)
        if called != "sign":
            self.said.append(Likeness(first, is_angle=called in OF_ANGLES))
        return {}

    def _operation(
        self,
        node: ast.BinOp,
        left: ast.expr,
        right: ast.expr,
        names: Mapping[str, Form],
    ) -> Form:
        if isinstance(node.op, ast.Pow):
            return self._power(left, right, names)
        first = self._form(left, names)
        second = self._form(right, names)
        if isinstance(node.op, SUM):
            has_number = isinstance(left, ast.Constant)
            has_number = has_number or isinstance(right, ast.Constant)
            difference = product(first, second, -1.0)
            self.said.append(Likeness(difference, is_number=has_number))
            if isinstance(left, ast.Constant):
                return second
            return first
        return product(first, second, 1.0 if isinstance(node.op, ast.Mult) else -1.0)

    def _power(
        self, base: ast.expr, above: ast.expr, names: Mapping[str, Form]
    ) -> Form:
        exponent = _plain_number(above)
        form = self._form(base, names)
        if exponent is not None:
            return product({}, form, exponent)
        self.said.append(Likeness(self._form(above, names)))
        return self._unknown() if form else {}


def product(first: Form, second: Form, power: float = 1.0) -> Form:
    """The form of first * second**power."""
    form = dict(first)
    for name, exponent in second.items():
        form[name] = form.get(name, 0.0) + power * exponent
    return form


def _plain_number(node: ast.expr) -> float | None:
    """Value of an exponent that is written as a number, such as -1/4 or (0.5)."""
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.UnaryOp(op=sign, operand=operand):
            value = _plain_number(operand)
            if value is None:
                return None
            return -value if isinstance(sign, ast.USub) else value
        case ast.BinOp(op=ast.Div(), left=left, right=right):
            above = _plain_number(left)
            below = _plain_number(right)
            return None if above is None or not below else above / below
    return None
