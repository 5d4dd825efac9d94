"""The states at which a one-step scheme averages the right-hand side.

    Psi = sum_j weight_j g(x_j, c_j),    x_j at the share c_j of the step

What a part of g adds to Psi follows from its values there, up to what it changes of the
x_j themselves. `integrators` has the schemes as one expression each; a test holds both
together.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from phsi_opt.transcription.integrators import (
    FIRST_NODE,
    SECOND_NODE,
    RightHandSide,
    integrator,
    srk4_stages,
)


@dataclass(frozen=True)
class StageRule:
    """Where a scheme averages the right-hand side.

    Attributes:
        shares: of the step at which its stages are, one per stage.
        weights: of the stages, one per stage; their sum is 1.
        states: (g, x0, x1, h) -> the states of the stages in the form of x0 and x1.
    """

    shares: tuple[float, ...]
    weights: tuple[float, ...]
    states: Callable[[RightHandSide, Any, Any, Any], tuple[Any, ...]]

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
    fourth = x0 + h * g(third, 0.5)
    return x0, second, third, fourth


def _srk4(g: RightHandSide, x0: Any, x1: Any, h: Any) -> tuple[Any, ...]:
    outer = srk4_stages(g, x0, x1, h)
    return outer.first, outer.second


STAGE_RULES = {
    "euler": StageRule((0.0,), (1.0,), _euler),
    "midpoint": StageRule((0.5,), (1.0,), _midpoint),
    "rk4": StageRule((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6), _rk4),
    "srk4": StageRule((FIRST_NODE, SECOND_NODE), (0.5, 0.5), _srk4),
}


def stage_rule(scheme: str) -> StageRule:
    """The rule of the scheme of that name.

    Raises:
        ModelError: there is none.
    """
    return STAGE_RULES[integrator(scheme).name]
