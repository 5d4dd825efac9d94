"""Effects from outside, as terms of F: forces in time, and hysteresis.

The frequency of a wave is free and scanned. Hysteresis needs a state that remembers.
"""

from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_parts import one_term, tried, underscored
from phsi_opt.model.effect import Effect
from phsi_opt.model.parameters import Parameter, Scan, Share
from phsi_opt.model.roles import WORDS, Role, role_of
from phsi_opt.model.structure import effort_of
from phsi_opt.model.terms import Dictionary, Term, formula

# Stiffness that changes with the time, by the role of the momentum.
PARAMETRIC = {
    Role.BODY: ("parametric stiffness", "a stiffness that changes with the time"),
    Role.PIPE: ("parametric stiffness", "a stiffness that changes with the time"),
    Role.COIL: ("parametric elastance", "a capacitance that changes with the time"),
}
HYSTERESIS = "hysteresis"

# Displacements over which a hysteresis yields, to try, as shares of the largest
# position.
YIELD_WIDTHS = (0.05, 0.1, 0.2, 0.4)
# The absolute value of the velocity in a hysteresis is rounded within this share of the
# typical (root mean square) velocity.
ROUNDED_VELOCITY = 0.02
# That of its state z, which stays within -1 and 1, is rounded within 0.05; squared.
SQUARED_ROUNDING_OF_STATE = 0.0025


def forces(model: BaseModel, equation: str) -> list[Effect]:
    """The forces in time that an equation may lack, in the words of its field.

    ::

        constant    c
        drifting    c t
        harmonic    a sin(omega t) + b cos(omega t)

    """
    role = role_of(model, equation)
    source = WORDS[role].source
    underlined = underscored(source)
    constant = one_term("1", f"constant_{underlined}_{equation}")
    drifting = one_term("t", f"drifting_{underlined}_{equation}")
    harmonic = _wave(_free_frequency(model, "harmonic", equation))
    lasting = f"a constant {source}"
    changing = f"{WORDS[role].a_source} that changes with the time"
    return [
        Effect(f"constant {source}", "F", equation, constant, family=lasting),
        Effect(f"drifting {source}", "F", equation, drifting, family=changing),
        Effect(f"harmonic {source}", "F", equation, harmonic, family=changing),
    ]


def parametric_stiffness(model: BaseModel, q: str, p: str) -> Effect:
    """A stiffness that changes with the time: -q (a sin(omega t) + b cos(omega t))."""
    name, family = PARAMETRIC[role_of(model, p)]
    omega = _free_frequency(model, "parametric", p)
    return Effect(name, "F", p, _wave(omega, factor=f"-{q}*"), family=family)


def _wave(omega: str, factor: str = "") -> Dictionary:
    inner = {omega: Parameter(lower=0.0, unit="rad/s", guess=Scan("t"))}
    sine = Term(f"{factor}sin({omega}*t)", Parameter(), inner)
    cosine = Term(f"{factor}cos({omega}*t)", Parameter(), inner)
    return Dictionary((sine, cosine))


def _free_frequency(model: BaseModel, kind: str, equation: str) -> str:
    """A name for the frequency of a wave in F of the equation that is not taken."""
    places = (f"{kind}_sin_{equation}", f"{kind}_cos_{equation}", f"F_{equation}")
    omega = "omega"
    while any(f"{place}.{omega}" in model.entries for place in places):
        omega += "_"
    return omega


def hysteresis(model: BaseModel, q: str, p: str) -> Effect:
    """Hysteresis of Bouc (1967) and Wen (1976) with n = 1, rounded.

    ::

        force = -c z,  w dz/dt = v - (|v| z + v |z|)/2

    so that z stays within -1 and 1, and w is the displacement over which it yields.
    """
    v = effort_of(model, p)
    z = f"hysteresis_{p}"
    width = f"hysteresis_width_{p}"
    slow = f"hysteresis_slow_{p}"
    speed = f"sqrt({v}**2 + {slow}**2)"
    size = f"sqrt({z}**2 + {SQUARED_ROUNDING_OF_STATE})"
    rate = f"({v} - ({speed}*{z} + {v}*{size})/2)/{width}"
    rounding = Parameter(lower=0.0, fixed=True, guess=Share(v, ROUNDED_VELOCITY))
    inner = {width: tried(q, YIELD_WIDTHS), slow: rounding}
    force = one_term(f"-{z}", f"hysteresis_force_{p}", lower=0.0)
    memory = {z: formula(rate, **inner)}
    return Effect("hysteresis", "F", p, force, memory, HYSTERESIS)
