"""Hidden forces, from textbooks, for a mass whose states are a position and a momentum.

Each makes what a force of size one adds to the rates of both; nothing is taken from
the package.
"""

from collections.abc import Callable

import numpy as np

from problems.field_machines.records import Array, Hidden, Law, Truth

# Dry friction turns over within this share of the typical speed.
CORNER = 0.005


def on_momentum(force: Callable[[Array], Array]) -> Law:
    """The force in the second of two rates."""

    def added(x: Array, u: Array) -> Array:
        rates = np.zeros_like(x)
        rates[..., 1] = force(x)
        return rates

    return added


def viscous(mass: float, largest: float, equation: str = "p") -> Hidden:
    """-c v; in a storage's equation the same term is a leak."""
    law = on_momentum(lambda x: -x[..., 1] / mass)
    truth = Truth(("viscous damping", "linear leak"), equation, 1.0)
    return Hidden("viscous damping", law, (truth,), largest)


def quadratic(mass: float, largest: float, equation: str = "p") -> Hidden:
    """-c v |v|."""
    law = on_momentum(lambda x: -np.abs(x[..., 1]) * x[..., 1] / mass**2)
    truth = Truth(("quadratic drag",), equation, 1.0)
    return Hidden("quadratic drag", law, (truth,), largest)


def coulomb(mass: float, speed: float, largest: float, equation: str = "p") -> Hidden:
    """-f tanh(v/w), w a small share of the typical speed."""
    width = CORNER * speed
    law = on_momentum(lambda x: -np.tanh(x[..., 1] / mass / width))
    truth = Truth(("coulomb friction",), equation, 1.0)
    return Hidden("coulomb friction", law, (truth,), largest)


def cubic(largest: float, equation: str = "p") -> Hidden:
    """-b q^3."""
    law = on_momentum(lambda x: -(x[..., 0] ** 3))
    truth = Truth(("cubic stiffness",), equation, 1.0)
    return Hidden("cubic stiffness", law, (truth,), largest)
