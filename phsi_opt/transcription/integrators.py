"""One-step schemes: the mean derivative Psi over a step.

::

    Psi = sum_j weight_j g(x_j, c_j) / sum_j weight_j

with the state x_j at the share c_j of the step.

A defect (x1 - x0)/h - Psi is made from it (`defects`). A scheme sees the right-hand
side as ``g(x, c)``: the state x at the fraction c of the step (time and input at that
fraction are filled in by the caller). Schemes may use both ends, so none of them needs
an inner solve. What a part of g adds to Psi follows from its values at the stages, up
to what it changes of the x_j themselves.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Any

from phsi_opt.errors import ModelError, did_you_mean

RightHandSide = Callable[[Any, float], Any]
Stages = Callable[[RightHandSide, Any, Any, Any], tuple[Any, ...]]


@dataclass(frozen=True)
class Integrator:
    """A one-step scheme: ``psi(g, x0, x1, h)`` approximates (x1 - x0)/h."""

    name: str  # what users call it
    order: int  # the error of the approximation is of this order in h
    symmetric: bool  # whether exchanging the two ends, with h negative, changes nothing
    shares: tuple[float, ...]  # of the step at which its stages are, one per stage
    weights: tuple[int, ...]  # of the stages, whole numbers
    # (g, x0, x1, h) -> the states of the stages, numbers, symbols or tensors alike.
    states: Stages

    def psi(self, g: RightHandSide, x0: Any, x1: Any, h: Any) -> Any:
        """The mean derivative over a step."""
        parts = []
        states = self.states(g, x0, x1, h)
        for x, share, weight in zip(states, self.shares, self.weights, strict=True):
            parts.append(weight * g(x, share) if weight > 1 else g(x, share))
        total = sum(parts[1:], start=parts[0])
        return total / sum(self.weights) if len(parts) > 1 else total

    @property
    def nodes(self) -> tuple[float, ...]:
        """The distinct shares, increasing."""
        return tuple(sorted(set(self.shares)))


def _euler(g: RightHandSide, x0: Any, x1: Any, h: Any) -> tuple[Any, ...]:
    return (x0,)


def _midpoint(g: RightHandSide, x0: Any, x1: Any, h: Any) -> tuple[Any, ...]:
    return ((x0 + x1) / 2,)


def _rk4(g: RightHandSide, x0: Any, x1: Any, h: Any) -> tuple[Any, ...]:
    second = x0 + h / 2 * g(x0, 0.0)
    third = x0 + h / 2 * g(second, 0.5)
    return x0, second, third, x0 + h * g(third, 0.5)


# SRK4 evaluates the right-hand side at these shares of the step, the nodes of Gauss's
# quadrature with two points.
FIRST_NODE = 0.5 - sqrt(3) / 6
SECOND_NODE = 0.5 + sqrt(3) / 6


def _srk4(g: RightHandSide, x0: Any, x1: Any, h: Any) -> tuple[Any, ...]:
    """The inner stage at the second node feeds the outer one at the first node and the
    other way round; swapped, the order drops to two.
    """
    middle = (x0 + x1) / 2
    reach = sqrt(3) / 6 * h
    at_second = g(FIRST_NODE * x0 + SECOND_NODE * x1, SECOND_NODE)
    at_first = g(SECOND_NODE * x0 + FIRST_NODE * x1, FIRST_NODE)
    return middle - reach * at_second, middle + reach * at_first


INTEGRATORS = {
    one.name: one
    for one in (
        Integrator("euler", 1, False, (0.0,), (1,), _euler),  # thesis Eq. 5.7
        Integrator("midpoint", 2, True, (0.5,), (1,), _midpoint),  # thesis Eq. 5.8
        Integrator("rk4", 4, False, (0.0, 0.5, 0.5, 1.0), (1, 2, 2, 1), _rk4),  # 5.9
        Integrator("srk4", 4, True, (FIRST_NODE, SECOND_NODE), (1, 1), _srk4),  # 5.11
    )
}
SCHEME = "srk4"  # of the dynamics where nobody chose one
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
