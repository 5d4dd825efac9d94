"""One-step schemes: the mean derivative Psi over a step.

A defect (x1 - x0)/h - Psi is made from it (`defects`). A scheme sees the right-hand
side as ``g(x, c)``: the state x at the fraction c of the step (time and input at that
fraction are filled in by the caller). Schemes may use both ends, so none of them needs
an inner solve.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Any

from phsi_opt.errors import ModelError, did_you_mean

RightHandSide = Callable[[Any, float], Any]


@dataclass(frozen=True)
class Integrator:
    """A one-step scheme: ``psi(g, x0, x1, h)`` approximates (x1 - x0)/h.

    Attributes:
        name: what users call it.
        order: the error of the approximation is of this order in h.
        symmetric: whether exchanging the two ends, with h negative, changes nothing.
        psi: the mean derivative, of numbers, symbols or tensors alike.
    """

    name: str
    order: int
    symmetric: bool
    psi: Callable[[RightHandSide, Any, Any, Any], Any]


def _euler(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
    return g(x0, 0.0)


def _midpoint(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
    return g((x0 + x1) / 2, 0.5)


def _rk4(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
    k1 = g(x0, 0.0)
    k2 = g(x0 + h / 2 * k1, 0.5)
    k3 = g(x0 + h / 2 * k2, 0.5)
    k4 = g(x0 + h * k3, 1.0)
    return (k1 + 2 * k2 + 2 * k3 + k4) / 6


# SRK4 evaluates the right-hand side at these shares of the step, the nodes of Gauss's
# quadrature with two points.
FIRST_NODE = 0.5 - sqrt(3) / 6
SECOND_NODE = 0.5 + sqrt(3) / 6


@dataclass(frozen=True)
class Stages:
    """States of SRK4 at the nodes of a step, in the form of x0 and x1."""

    first: Any
    second: Any


def srk4_stages(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Stages:
    """States at `FIRST_NODE` and `SECOND_NODE`, at which SRK4 averages the derivative.

    The inner stage at the second node feeds the outer one at the first node and the
    other way round; swapped, the order drops to two.
    """
    middle = (x0 + x1) / 2
    reach = sqrt(3) / 6 * h
    at_second = g(FIRST_NODE * x0 + SECOND_NODE * x1, SECOND_NODE)
    at_first = g(SECOND_NODE * x0 + FIRST_NODE * x1, FIRST_NODE)
    return Stages(middle - reach * at_second, middle + reach * at_first)


def srk4_one_way(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
    """Half of SRK4: its Psi is the mean of this from x0 to x1 and from x1 to x0."""
    inner = FIRST_NODE * x0 + SECOND_NODE * x1
    first = (x0 + x1) / 2 - sqrt(3) / 6 * h * g(inner, SECOND_NODE)
    return g(first, FIRST_NODE)


def _srk4(g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
    stages = srk4_stages(g, x0, x1, h)
    return (g(stages.first, FIRST_NODE) + g(stages.second, SECOND_NODE)) / 2


INTEGRATORS = {
    "euler": Integrator("euler", 1, False, _euler),  # thesis Eq. 5.7
    "midpoint": Integrator("midpoint", 2, True, _midpoint),  # thesis Eq. 5.8
    "rk4": Integrator("rk4", 4, False, _rk4),  # thesis Eq. 5.9
    "srk4": Integrator("srk4", 4, True, _srk4),  # thesis Eq. 5.11
}
# For starting values: one evaluation of the right-hand side at states that are known,
# so its defects are linear wherever the model is.
STARTING_SCHEME = "midpoint"


def integrator(name: str) -> Integrator:
    """The scheme of that name.

    Raises:
        ModelError: there is none.
    """
    if name not in INTEGRATORS:
        raise ModelError(
            f"integrator {name!r} is unknown; expected one of {', '.join(INTEGRATORS)}."
            f"{did_you_mean(str(name), INTEGRATORS)}"
        )
    return INTEGRATORS[name]
