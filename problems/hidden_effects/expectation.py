"""What a diagnosis should find of a hidden effect: equations and coefficient."""

import numpy as np

from problems.hidden_effects.machines import Setting
from problems.hidden_effects.rows import Truth
from problems.hidden_effects.truth import SENSORS, Hidden

# Effects whose coefficient in the catalogue is the size itself, or the size with the
# sign that was drawn. Of effects that are not named here, and count something else,
# none is compared.
SIZE = {
    "viscous damping",
    "coulomb friction",
    "quadratic drag",
    "cubic drag",
    "position-dependent damping",
    "linear stiffness",
    "cubic stiffness",
    "coupling stiffness",
    "gap",
    "harmonic force",
    "parametric stiffness",
    "input dead zone",
    "input lag",
    "input delay",
    "sensor delay",
}
SIGNED_SIZE = {
    "quadratic stiffness",
    "gravity torque",
    "constant force",
    "drifting force",
    "input gain",
    "quadratic input",
    "sensor offset",
    "sensor gain",
    "sensor drift",
}
LIMIT = {"input saturation", "sensor clipping"}


def truth_of(hidden: Hidden, s: Setting) -> Truth:
    """The effect as it should be found."""
    return Truth(hidden.name, _equations(hidden, s), _coefficient(hidden))


def _equations(hidden: Hidden, s: Setting) -> tuple[str, ...]:
    n = s.machine.n
    if hidden.name in SENSORS:
        return (s.states[hidden.at],)
    if hidden.name == "coupling stiffness":  # the spring pulls at both
        return s.states[n:]
    return (s.states[n + hidden.at],)


def _coefficient(hidden: Hidden) -> float:
    """The coefficient of the catalogue's effect; NaN where none is compared."""
    name = hidden.name
    shape = hidden.shape
    if name in SIZE:
        return hidden.size
    if name in SIGNED_SIZE:
        return shape["sign"] * hidden.size
    if name in LIMIT:
        return (1 - hidden.size) * shape["largest"]
    if name == "hysteresis":  # the force where it has yielded
        return hidden.size / (shape["beta"] + shape["gamma"])
    return np.nan
