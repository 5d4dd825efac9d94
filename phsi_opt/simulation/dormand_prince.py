"""Dormand and Prince's explicit Runge-Kutta scheme of order five, as a CasADi function.

One step, with the error estimate of the embedded scheme of order four; who takes the
steps, and how long they are, is decided elsewhere (`free_run`).

J. R. Dormand and P. J. Prince (1980), "A family of embedded Runge-Kutta formulae",
Journal of Computational and Applied Mathematics 6, 19-26.
"""

from collections.abc import Sequence

import casadi as ca

# The last row of STAGES is the step of order five, WEIGHTS_4 that of order four.
NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
STAGES: tuple[tuple[float, ...], ...] = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
WEIGHTS_4 = (
    5179 / 57600,
    0.0,
    7571 / 16695,
    393 / 640,
    -92097 / 339200,
    187 / 2100,
    1 / 40,
)


def step(rhs: ca.Function, n_watched: int) -> ca.Function:
    """One step of a right-hand side whose inputs change linearly.

    Args:
        rhs: CasADi function (x, u, t) -> dx/dt.
        n_watched: number of states, the first ones, whose errors are estimated.

    Returns:
        CasADi function (x, column) -> x after the step, size of the estimated error
        (n_watched,); the column holds the time, the length of the step, the inputs and
        their slopes.
    """
    n_inputs = rhs.size1_in(1)
    x = ca.SX.sym("x", rhs.size1_in(0))
    column = ca.SX.sym("column", 2 + 2 * n_inputs)
    t = column[0]
    h = column[1]
    u = column[2 : 2 + n_inputs]
    slope = column[2 + n_inputs :]
    rates: list[ca.SX] = []
    for weights, c in zip(STAGES, NODES, strict=True):
        stage = _moved(x, h, weights, rates)
        rates.append(rhs(stage, u + c * h * slope, t + c * h))
    after = _moved(x, h, STAGES[-1], rates[:-1])
    of_order_4 = _moved(x, h, WEIGHTS_4, rates)
    error = ca.fabs(after - of_order_4)[:n_watched]
    return ca.Function("step", [x, column], [after, error], {"cse": True})


def _moved(
    x: ca.SX, h: ca.SX, weights: Sequence[float], rates: Sequence[ca.SX]
) -> ca.SX:
    """x + h * sum of weight * rate, without the weights that are zero."""
    moved = x
    for weight, rate in zip(weights, rates, strict=True):
        if weight:
            moved = moved + h * weight * rate
    return moved
