"""The laws of the catalogue: one row of a table per law, with names to fill in.

The texts of a row contain names in braces, which the ``catalogue`` fills in:

- ``{x}`` the state of the equation, ``{own}`` the same where nothing else is beside it;
- ``{e}`` its effort: a velocity, a flow, a level;
- ``{q}`` the position of a momentum, ``{angle}`` the same in radians;
- ``{u}`` an input, ``{slope}`` the slope of the model's own force in it, ``{new}`` an
  input that the equation does not use yet, ``{of_u}`` its name where there are several;
- ``{inertia}`` what the equation divides a force by, such as a mass, "" where the model
  tells none; a model without an energy has it. What a law adds is divided by it, too;
- ``{s}`` another storage or input, ``{s_e}`` its effort; ``{level}`` what flows over;
- ``{q1}``, ``{q2}`` two positions, ``{x1}``, ``{x2}`` two states between which it acts;
- ``{source}``, ``{a_source}``, ``{grows_with}``, ``{place}``, ``{input_size}`` words.

A row with a name that an equation does not have is not offered there. What acts between
two states stands along a direction, and its effort is a difference. A loss is
R_ii dH/dx_i: a force c f(v) against the velocity v has R_ii = c f(v)/v.

The cells of a row are, in this order:

1. the name;
2. roles of the states in whose equations the law is offered (none: all);
3. the formula; several formulas, and their coefficients, are separated by ";";
4. the odds: how often such a thing is met before anything is measured. 4 where three or
   more of the measured machines that this package was tried on had it (some 24), 1
   where one or two had, or where it is a textbook's usual law, 1/4 where none had and
   most machines have no reason to;
5. what it adds, with c for its coefficient, as people read it;
6. other names;
7. the family (none: a loss that grows with the effort);
8. the name of the coefficient: it may be ``>= 0``, ``formula`` (no coefficient), or
   empty (named by its place); none: that in the head of the section;
9. in H: the force of the law in a model without an energy.

A formula brings what it names of ``INNER_PARAMETERS`` and ``MEMORIES``. The head of a
section has its slot and the usual name of a coefficient.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import chain, permutations
from operator import attrgetter
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import needs_brackets
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.structure import Role
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.presentation.numbers import called, enumerated

OF_EQUATION = "in the equation of"
SECOND_STORAGE = "a storage that is not measured"
STORAGES = (SECOND_STORAGE, "a spring that yields", "a resonance")

# ---- parameters inside the formulas --------------------------------------------------


class Inner(NamedTuple):
    """A parameter inside a formula."""

    parameter: Parameter
    words: str = ""  # what people call it, where its name does not say so


def _tried(
    of: str,
    shares: Iterable[float],
    most: float = np.inf,
    unit: str = "",
    words: str = "",
) -> Inner:
    """A positive parameter that starts at the best of several values."""
    guess = Tried(of, tuple(shares), most)
    return Inner(Parameter(lower=0.0, unit=unit, guess=guess), words)


def _width(of: str, share: float, *sharper: float, words: str = "") -> Inner:
    """A width within which a corner is rounded: known, as a share of a typical size."""
    guess = Share(of, share, sharper)
    return Inner(Parameter(lower=0.0, fixed=True, guess=guess), words)


# Limits to try, as shares of the largest level or value; closer to each other near the
# largest one, where a limit is passed briefly.
LIMITS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.94, 0.97)
# In times between samples: from a share of one on, each about 1.6 times the last.
DELAYS = (0.25, 0.5, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)
# No limit or play beyond the largest value does anything: the most is 1 there.
INNER_PARAMETERS = {
    "ratio": Inner(Parameter(1.0, lower=0.0), "ratio of the capacities"),
    # Dry friction turns over within this share of the typical (root mean square)
    # velocity: sharp beside the motion, smooth for the solver. The fourth powers make
    # its plateau flat, so that the share costs no friction at the velocities beyond it.
    # The corner is then halved while that fits better. By a quarter at once, the steps
    # of fits of 10 000 samples went to and fro 20 times.
    "v0": _width("{e}", 0.06, *(0.5,) * 6, words="speed of transition v0"),
    # A friction that falls over a longer range is Coulomb's.
    "v_s": _tried("{e}", (0.05, 0.1, 0.2, 0.3, 0.45), 3.0, words="Stribeck speed v_s"),
    # A turbulent leak turns laminar below this share of the typical level, where its
    # square root would be steep without end.
    "e0": _width("{e}", 0.01, words="level of transition e0"),
    "half": _tried("{e}", (0.03, 0.1, 0.3, 1.0), words="level of half the conductance"),
    "limit": _tried("{level}", LIMITS, 1.0),
    "{omega}": Inner(
        Parameter(lower=0.0, unit="rad/s", guess=Scan("t")), "frequency omega"
    ),
    "dead_zone_{u}_{x}": _tried(
        "{u}",
        (0.005, 0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8),
        1.0,
        words="half the width of the dead zone",
    ),
    "saturation_{u}_{x}": _tried(
        "{u}",
        (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98),
        1.0,
        words="limit of the saturation",
    ),
    "lag_{u}_{x}": _tried("dt", DELAYS, unit="s", words="lag"),
    "delay_{u}_{x}": Inner(Parameter(lower=0.0, unit="s"), "delay"),
    "play": _tried("{q}", (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9), 1.0),
    # Shares of the longest record; what takes longer is told from a constant by
    # nothing. A re-fit begins at the one in the middle: a second storage that follows
    # soon is hardly different from the first, and a solver finds its way from there.
    "storage_time_constant_{x}": _tried(
        "t",
        (0.002, 0.003, 0.005, 0.01, 0.03, 0.1, 0.3),
        1.0,
        "s",
        "time constant of the second storage",
    ),
    # The displacement over which a hysteresis yields.
    "hysteresis_width_{x}": _tried(
        "{q}", (0.05, 0.1, 0.2, 0.4), words="width of the hysteresis"
    ),
    "bouc_wen_shape_{x}": Inner(
        Parameter(lower=-2.0, guess=Tried("1", (-1.0, 0.0), 2.0)),
        "shape s of the hysteresis",
    ),
    # Within this share of the typical velocity its absolute value is rounded; that of
    # the hysteresis' state, which stays within -1 and 1, within 0.05.
    "hysteresis_slow_{x}": _width("{e}", 0.02),
    "relaxation_time_{x}": _tried(
        "t", (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.3), 1.0, "s"
    ),
    # Over 2 pi the period of a resonance; a quarter more from one to the next.
    "resonance_time_{x}": _tried("dt", (0.6 * 1.25**k for k in range(24)), unit="s"),
    "resonance_damping_{x}": Inner(Parameter(0.1, lower=0.0)),
    "clipping_{x}": _tried("{x}", LIMITS, 1.0, words="limit of the clipping"),
    "sensor_delay_{x}": _tried("dt", DELAYS, unit="s"),
}

# ---- memory: further states, each with its rate --------------------------------------


def _bouc_wen(z: str, shape: str = "") -> str:
    """The rate of a hysteresis by Bouc (1967) and Wen (1976) with n = 1, rounded.

    The force is -c z, with w dz/dt = v - (|v| z + s v |z|)/2. With the shape s = 1, z
    stays within -1 and 1, and w is the displacement over which it yields; with s < -1
    the force grows ever faster, and falls faster still on the way back.
    """
    size = f"sqrt({{e}}**2 + hysteresis_slow_{{x}}**2)*{z}"
    back = f"{shape}{{e}}*sqrt({z}**2 + 0.0025)"
    return f"({{e}} - ({size} + {back})/2)/hysteresis_width_{{x}}"


ABSORBER = (
    "({q} - {q}_absorber)/resonance_time_{x}**2"
    " + resonance_damping_{x}*({e} - {q}_absorber_rate)/resonance_time_{x}"
)
# The rates of the states that formulas name, or the rates before them.
MEMORIES = {
    # The force follows the lagged input z: lag dz/dt = u - z.
    "{u}_lagged_{x}": "({u} - {u}_lagged_{x})/lag_{u}_{x}",
    # A second storage z beside the state x, such as the walls around a room's air:
    # dx/dt = ... + c (z - x), tau dz/dt = x - z. With the capacities C1 and C2 and a
    # resistance R between the two, c = 1/(R C1) and tau = R C2, so that C2/C1 = c tau.
    # What the model had for both before is now for the first alone.
    "{x}_second": "({x} - {x}_second)/storage_time_constant_{x}",
    "hysteresis_{x}": _bouc_wen("hysteresis_{x}"),
    "bouc_wen_{x}": _bouc_wen("bouc_wen_{x}", "bouc_wen_shape_{x}*"),
    # A spring and a damper in series: z is how far the damper has given way.
    "{q}_relaxed": "({q} - {q}_relaxed)/relaxation_time_{x}",
    # A small mass on a spring and a damper, at z with the velocity w.
    "{q}_absorber": "{q}_absorber_rate",
    "{q}_absorber_rate": ABSORBER,
    # The delay tau of a sensor is Pade's approximation of order three, with three
    # states a, b = a', c = a'', whose phase is right to 1 % up to tau times the
    # frequency = 4:
    #     c' = 120/tau^3 (x - a) - 60/tau^2 b - 12/tau c
    #     x(t - tau) = x - 2 (x - a) + tau^2/5 c
    "{x}_delayed": "{x}_delayed_rate",
    "{x}_delayed_rate": "{x}_delayed_bend",
    "{x}_delayed_bend": "120/sensor_delay_{x}**3*({x} - {x}_delayed)"
    " - 60/sensor_delay_{x}**2*{x}_delayed_rate - 12/sensor_delay_{x}*{x}_delayed_bend",
}

# ---- the tables ----------------------------------------------------------------------

SHORTHAND = {
    "GROWING": "a loss that grows with {grows_with}",
    "CHANGING": "{a_source} that changes with the time",
    "POSITION": "{a_source} that depends on the {place}",
    # sign(e)/e, rounded within the turnover velocity v0.
    "DRY": "({e}**4 + v0**4)**(-0.25)",
    "BOTH": "coulomb_friction_{x} >= 0; stribeck_friction_{x} >= 0",
    "DEAD": "min(max({u}, -dead_zone_{u}_{x}), dead_zone_{u}_{x})",
    "FULL": "min(max({u}, -saturation_{u}_{x}), saturation_{u}_{x})",
    "OUTSIDE": "-max({q} - play, 0) + max(-{q} - play, 0)",
    "HELD": "hysteresis_force_{x} >= 0",
    "ABSORBED": ABSORBER,
    "SECOND": SECOND_STORAGE,
    "WAVES": "-{q}*sin({omega}*t); -{q}*cos({omega}*t)",
    "LATE": "2*({x}_delayed - {x}) + sensor_delay_{x}**2/5*{x}_delayed_bend",
}
TABLES = """
# Losses: terms of R_ii >= 0 = loss/effort. A turbulent leak is the square root of the
# level, linear below a small one; Stribeck's friction is larger at low speed.
[losses] R {name}_{x} >= 0
viscous damping | BODY | 1 | 4 | -c {e} | viscous friction, damper, dashpot, linear drag
laminar pipe friction | PIPE | 1 | 1 | -c {e} | pipe resistance, pipe loss
linear leak | TANK, UNKNOWN | 1 | 1 | -c {e} | leak, leakage, seepage
linear resistance | COIL, CIRCUIT | 1 | 1 | -c {e} | ohmic loss, winding resistance, series resistance
leakage conductance | CAPACITOR | 1 | 1 | -c {e} | leakage current, self-discharge
heat loss | HEAT | 1 | 4 | -c {e} | cooling, convection, heat leak, heat transfer
coulomb friction | BODY, UNKNOWN | DRY | 4 | -c sign({e}) | dry friction, sliding friction, kinetic friction | dry friction
contact voltage drop | COIL, CIRCUIT | DRY | 1 | -c sign({e}) | brush drop, diode drop | a constant voltage drop
quadratic drag | BODY, UNKNOWN | abs({e}) | 4 | -c |{e}| {e} | air drag, air resistance, wind resistance, windage
turbulent pipe friction | PIPE | abs({e}) | 1 | -c |{e}| {e} | pipe loss, pressure loss
quadratic leak | TANK | abs({e}) | 1 | -c |{e}| {e} | leak, leakage
quadratic resistance | COIL, CIRCUIT | abs({e}) | 1 | -c |{e}| {e}
quadratic conductance | CAPACITOR | abs({e}) | 1 | -c |{e}| {e}
quadratic heat loss | HEAT | abs({e}) | 1 | -c |{e}| {e} | natural convection
cubic drag | BODY, UNKNOWN | {e}**2 | 1/4 | -c {e}^3
stribeck friction | BODY, UNKNOWN | DRY; DRY*exp(-({e}/v_s)**2) | 1 | -(c + s exp(-({e}/v_s)^2)) sign({e}) | stiction, static friction | dry friction | BOTH
turbulent leak | TANK, UNKNOWN | ({e}**2 + e0**2)**(-0.25) | 4 | -c sign({e}) sqrt(|{e}|) | leak, leakage, orifice, outflow, hole
saturating leak | TANK, UNKNOWN | 1/(1 + abs({e})/half) | 1 | -c {e}/(1 + |{e}|/half) | leak, leakage
overflow | TANK, UNKNOWN | max(abs({e}) - limit, 0)/max(abs({e}), limit) | 1 | -c sign({e}) max(|{e}| - limit, 0) | spill, weir | an overflow
radiation | HEAT | {radiation} | 1 | -c {e}^3 |{e}| | thermal radiation, radiative loss
position-dependent damping | BODY | {q}**2 | 1/4 | -c {q}^2 {e} | position-dependent friction | damping that depends on the position
charge-dependent resistance | COIL | {q}**2 | 1/4 | -c {q}^2 {e} | | a resistance that depends on a charge
# What stores energy; a gap is a spring with free play, to both sides.
[energies] H {name}_{q1}_{q2}
linear stiffness | BODY, PIPE | {q}**2/2 | 1 | energy c {q}^2/2 | spring | POSITION | {name}_{q} | -{q}
quadratic stiffness | BODY, PIPE | {q}**3/3 | 1 | energy c {q}^3/3 | asymmetric spring | POSITION | {name}_{q} | -{q}**2
cubic stiffness | BODY, PIPE | {q}**4/4 | 4 | energy c {q}^4/4 | hardening, softening, duffing spring | POSITION | {name}_{q} | -{q}**3
gravity torque | BODY | -cos({angle}) | 1 | energy -c cos({angle}) | pendulum, imbalance, eccentric weight | POSITION | {name}_{q} | -sin({angle})
linear elastance | COIL | {q}**2/2 | 1 | energy c {q}^2/2 | series capacitor | POSITION | {name}_{q} | -{q}
quadratic elastance | COIL | {q}**3/3 | 1 | energy c {q}^3/3 | | POSITION | {name}_{q} | -{q}**2
cubic elastance | COIL | {q}**4/4 | 1 | energy c {q}^4/4 | | POSITION | {name}_{q} | -{q}**3
coil saturation | COIL | {own}**4/4 | 1 | energy c {x}^4/4 | saturation, iron saturation, magnetic saturation | a storage that saturates | {name}_{own}
coil or capacitor saturation | CIRCUIT | {own}**4/4 | 1 | energy c {x}^4/4 | saturation, iron saturation | a storage that saturates | {name}_{own}
coupling stiffness | BODY | ({q1} - {q2})**2/2 | 1 | energy c ({q1} - {q2})^2/2 | coupling spring | a coupling of two positions
coupling stiffness | PIPE | ({q1} - {q2})**2/2 | 1 | energy c ({q1} - {q2})^2/2 | coupling spring | a coupling of two volumes
coupling capacitance | COIL | ({q1} - {q2})**2/2 | 1 | energy c ({q1} - {q2})^2/2 | | a coupling of two charges
gap | BODY | max(abs({q}) - play, 0)**2/2 | 1 | energy c max(|{q}| - play, 0)^2/2 | backlash, free play, play, clearance, slack | POSITION | gap_{q} >= 0 | OUTSIDE
# What comes from outside, in the time.
[forces] F {name}_{x}
constant {source} | | 1 | 4 | c | bias, offset, load, tilt, gravity, disturbance, supply | a constant {source}
drifting {source} | | t | 1/4 | c t | drift, trend, ramp | CHANGING
harmonic {source} | | sin({omega}*t); cos({omega}*t) | 1/4 | a sin({omega} t) + b cos({omega} t) | unbalance, vibration, ripple, hum | CHANGING |
# Between an input and its force.
[inputs] F {name}_{x}
quadratic input{of_u} | | {u}**2 | 1 | c {u}^2 | nonlinear actuator | {input_size} | quadratic_input_{u}_{x}
odd quadratic input{of_u} | | abs({u})*{u} | 1 | c |{u}| {u} | nonlinear actuator | {input_size} | odd_quadratic_input_{u}_{x}
cubic input{of_u} | | {u}**3 | 1/4 | c {u}^3 | nonlinear actuator | {input_size} | cubic_input_{u}_{x}
input gain{of_u} | | {new} | 1 | c {dF}{u} | actuator gain, calibration, scale error | {input_size} | input_gain_{u}_{x}
input gain{of_u} | | {slope}*{u} | 1 | c {dF}{u} | actuator gain, calibration, scale error | {input_size} | input_gain_{u}_{x}
input dead zone{of_u} | | -{slope}*DEAD | 1 | -{dF}min(max({u}, -width), width) | dead band, threshold | {input_size} | formula
input saturation{of_u} | | -{slope}*({u} - FULL) | 1 | -{dF}({u} - min(max({u}, -limit), limit)) | saturation | {input_size} | formula
input lag{of_u} | | {slope}*({u}_lagged_{x} - {u}) | 4 | {dF}(z - {u}), lag dz/dt = {u} - z | actuator lag, slow actuator | a delay of the input | formula
input delay{of_u} | | {slope}*(delayed({u}, delay_{u}_{x}) - {u}) | 4 | {dF}({u}(t - delay) - {u}) | dead time, transport delay, latency | a delay of the input | formula
# What remembers, or changes with the time.
[lasting] F {name}_{x}
second heat storage | HEAT | {x}_second - {x} | 4 | c (z - {x}), tau dz/dt = {x} - z | wall, thermal mass, second storage | SECOND | {name}_{x} >= 0
second charge storage | CIRCUIT | {x}_second - {x} | 4 | c (z - {x}), tau dz/dt = {x} - z | relaxation, second storage | SECOND | {name}_{x} >= 0
parametric stiffness | BODY, PIPE | WAVES | 1/4 | -{q} (a sin({omega} t) + b cos({omega} t)) | | a stiffness that changes with the time |
parametric elastance | COIL | WAVES | 1/4 | -{q} (a sin({omega} t) + b cos({omega} t)) | | a capacitance that changes with the time |
hysteresis | BODY, PIPE, COIL | -hysteresis_{x} | 1 | -c z, w dz/dt = {e} - (|{e}| z + {e} |z|)/2 | bouc-wen, presliding | hysteresis | HELD
bouc-wen hysteresis | BODY, PIPE, COIL | -bouc_wen_{x} | 1/4 | -c z, w dz/dt = {e} - (|{e}| z + s {e} |z|)/2 | free hysteresis | hysteresis | HELD
maxwell element | BODY | {q}_relaxed - {q} | 1 | -c ({q} - z), tau dz/dt = {q} - z | viscoelastic, creep, second storage | a spring that yields | {name}_{x} >= 0
resonance | BODY | -(ABSORBED) | 1 | -m z'', tau^2 z'' = {q} - z + d tau ({e} - z') | absorber, tuned mass | a resonance | resonance_mass_{x} >= 0
# From other storages, and from the surroundings. What the other storage loses by it is
# an effect of its own, in that one's equation.
[overflows] F {name}_{x}
overflow from {s} | | max({s_e} - limit, 0) | 1 | c max({s_e} - limit, 0) | spill, weir | an overflow | overflow_{s}_{x} >= 0
[heat exchanges] F heat_exchange_{s}_{x} >= 0
heat exchange with {s} | HEAT | {s_e} - {e} | 1 | c ({s_e} - {e}) | heat transfer, ambient, conduction | an exchange of heat
# Between two states: what the one loses the other gets.
[between] R {name} >= 0
damper between {x1} and {x2} | BODY | 1 | 1 | -c {e} | coupling damper, viscous coupling | a loss between two bodies
dry friction between {x1} and {x2} | BODY | DRY | 1 | -c sign({e}) | friction between, slipping clutch | a loss between two bodies
exchange of heat between {x1} and {x2} | HEAT | 1 | 4 | -c {e} | heat exchange, thermal bridge, thermal conductance | an exchange of heat
connection between {x1} and {x2} | TANK | ({e}**2 + e0**2)**(-0.25) | 1 | -c sign({e}) sqrt(|{e}|) | leak between, pipe, orifice | a connection
# As an entry of S between two momenta does, without loss.
[exchanges] F {name}
gyroscopic coupling between {x1} and {x2} | BODY | 1 | 1 | c dH/dx2, -c dH/dx1 | Coriolis force, magnetic force | a coupling without loss
[spills] F {name} >= 0
spill from {s} into {x} | | max({s_e} - limit, 0) | 1 | c max({s_e} - limit, 0) | weir, overflow into | an overflow
# What a sensor adds to the state: measured = state + sensor terms.
[sensors] sensor {name}_{x}
sensor offset | | 1 | 1 | sensor + c | offset, bias, zero error | an error of the sensor
sensor gain | | {x} | 1/4 | sensor + c {x} | calibration, scale error | an error of the sensor
sensor drift | | t | 1/4 | sensor + c t | drift | an error of the sensor
sensor clipping | | min(max({x}, -clipping_{x}), clipping_{x}) - {x} | 1 | sensor = min(max({x}, -limit), limit) | clipping, saturation | an error of the sensor | formula
sensor delay | | LATE | 1 | sensor = {x}(t - delay) | latency, time delay, filter delay | a delay of the sensor | formula
"""  # noqa: E501


@dataclass(frozen=True)
class Law:
    """A law of the catalogue: the effect that it has in any equation.

    Args:
        name: of the effect.
        slot: where it acts.
        terms: by the body of each term its coefficient, as the cells of a row say it.
            Terms that a model has already are left out.
        family: its class in words.
        roles: of the states in whose equations it is offered; empty: of all.
        force: of a law in H: what it is in F of a model without an energy; "": nothing.
        odds: of meeting it, before anything is measured.
        adds: what it adds, as people read it.
        others: other names.
    """

    name: str
    slot: str
    terms: Mapping[str, str]
    family: str
    roles: tuple[Role, ...] = ()
    force: str = ""
    odds: float = 1.0
    adds: str = ""
    others: tuple[str, ...] = ()

    def effect(self, model: BaseModel, names: Mapping[str, str]) -> Effect | None:
        """The effect in the equation of ``{x}``; None where it is not offered."""
        slot = self.slot
        terms = self.terms
        equation = names.get("along", names["x"])
        if slot == "H" and not model.has_energy:
            slot = "F"
            terms = dict.fromkeys([self.force] if self.force else [], *terms.values())
        if slot == "R" and "along" in names and not model.has_energy:
            slot = "F"
            bodies = ["-{e}" if body == "1" else f"-{{e}}*{body}" for body in terms]
            terms = dict(zip(bodies, terms.values(), strict=True))
        known = [one.body for one in model.terms_at(slot, equation)]
        try:
            name = self.name.format_map(names)
            names = {**names, "name": name.replace(" ", "_")}
            if slot == "sensor":
                names["inertia"] = ""
            memory: dict[str, Dictionary] = {}
            named = _names_in(*terms)
            for state, rate in MEMORIES.items():
                if state in named:
                    named |= _names_in(rate)
                    term = _term(rate, "formula", names)
                    memory[state.format_map(names)] = Dictionary((term,))
            # What the rates name is known to the whole model.
            rates = chain(*memory.values())
            of_rates = set().union(*map(attrgetter("inner"), rates))
            added = []
            for one in terms.items():
                term = _term(*one, names, of_rates)
                if term.body not in known:
                    added.append(term)
            if not added:
                return None
            family = self.family.format_map(names)
        except KeyError:  # the equation has no position, or no such input
            return None
        sum_of_terms = Dictionary(tuple(added))
        return Effect(name, slot, equation, sum_of_terms, memory, family)


def _names_in(*templates: str) -> set[str]:
    """Names and numbers in formulas, those with braces as they are written."""
    return set(re.findall(r"[\w{}]+", " ".join(templates)))


def _term(
    template: str,
    coefficient: str,
    names: Mapping[str, str],
    known: Iterable[str] = (),
) -> Term:
    """A term with the names filled in, and the parameters that its body names.

    But for those that are known already; and with the ratio of two capacities in the
    direction along which it stands, if any.
    """
    inner = {}
    named = _names_in(template, names.get("ratio", ""))
    for key, (parameter, _) in INNER_PARAMETERS.items():
        name = key.format_map(names) if key in named else ""
        if name and name not in known:
            guess = parameter.guess
            if isinstance(guess, Share | Tried):
                guess = replace(guess, of=guess.of.format_map(names))
            inner[name] = replace(parameter, guess=guess)
    body = template.format_map(names)
    if coefficient == "formula":
        return Term(body, None, inner)
    if names["inertia"] and "{slope}" not in template:
        body = f"{f'({body})' if needs_brackets(body) else body}/{names['inertia']}"
    called, _, bound = coefficient.partition(" >= ")
    free = Parameter(lower=float(bound or -np.inf))
    return Term(body, free, inner, called.format_map(names))


def _laws(tables: str) -> dict[str, list[Law]]:
    """The laws of each section, by its title."""
    for code, part in SHORTHAND.items():
        tables = re.sub(rf"\b{code}\b", part, tables)
    sections: dict[str, list[Law]] = {}
    for line in tables.strip().splitlines():
        if line.startswith("#"):
            continue
        if head := re.fullmatch(r"\[(.*)\] (\w+) (.*)", line):
            laws = sections[head[1]] = []
            slot = head[2]
            usual = ["", SHORTHAND["GROWING"], head[3], ""]  # from other names on
            continue
        cells = list(map(str.strip, re.split(r" \|(?= |$)", line)))
        name, roles, formulas, odds, adds = cells[:5]
        others, family, coefficients, force = cells[5:] + usual[len(cells) - 5 :]
        bodies = formulas.split("; ")
        each = coefficients.split("; ") * len(bodies)
        law = Law(
            name,
            slot,
            dict(zip(bodies, each, strict=False)),
            family,
            tuple(Role[role] for role in roles.split(", ") if role),
            force,
            float(Fraction(odds)),
            adds,
            tuple(filter(None, others.split(", "))),
        )
        laws.append(law)
    return sections


LAWS = _laws(TABLES)
# By the first words of their names; unknown functions are in no table.
BY_NAME = {"unknown": Law("unknown", "F", {}, "", odds=0.25)}
for _law in chain(*LAWS.values()):
    BY_NAME.setdefault(_law.name.partition("{")[0].strip(), _law)


def law_of(name: str) -> Law:
    """The law of an effect; of "input delay of u" it is "input delay"."""
    words = name.split()
    for n in range(len(words), 0, -1):
        law = BY_NAME.get(" ".join(words[:n]))
        if law is not None:
            return law
    return Law(name, "F", {}, "")


# ---- what people call them -----------------------------------------------------------


def effect_words(effect: Effect, labels: Mapping[str, str]) -> str:
    """An effect as people read it, such as "coulomb friction in the equation of p".

    Args:
        effect: the effect.
        labels: what people read for states and inputs, by name.
    """
    law = law_of(effect.name)
    begin = law.name.partition("{")[0]
    if law in LAWS["forces"] or not effect.name.startswith(begin):
        begin = effect.name
    name = begin + called(effect.name.removeprefix(begin), labels)
    return name if effect.tells_place else name + place_words(effect, labels)


def effects_words(effects: Iterable[Effect], labels: Mapping[str, str]) -> str:
    """Several effects as people read them, such as "a and b"."""
    return enumerated(map(partial(effect_words, labels=labels), effects))


def place_words(effect: Effect, labels: Mapping[str, str]) -> str:
    """Where it acts, such as " in the equation of p"."""
    place = called(effect.equation, labels)
    if effect.slot == "sensor":
        return f" of {place}"
    is_state = effect.equation.isidentifier()
    return f" {OF_EQUATION} {place}" if is_state else f" along {place}"


# By the first words of a parameter's name what it is called.
WORDS_OF_PARAMETERS = {"heat exchange": "heat exchange"} | dict.fromkeys(BY_NAME, "")
for _key, _inner in INNER_PARAMETERS.items():
    if _inner.words:
        _stem = _key.partition("_{")[0].strip("{}").replace("_", " ")
        WORDS_OF_PARAMETERS[_stem] = _inner.words


def parameter_words(
    model: BaseModel, name: str, labels: Mapping[str, str] = MappingProxyType({})
) -> str:
    """A parameter of an effect as people call it; other names stay as they are.

    Such as "coulomb friction in the equation of p, speed of transition v0" for
    coulomb_friction_p.v0; with the labels of channels.
    """
    place, _, body = name.partition("[")
    if name not in model.entries:  # such as one of a run: m[run 3]
        return name
    if body:
        return f"coefficient of {body.removesuffix(']')} in {place}"
    outer, _, inner = name.rpartition(".")
    if outer:
        told = WORDS_OF_PARAMETERS.get(inner.replace("_", " ")) or inner
        return f"{parameter_words(model, outer, labels)}, {told}"
    for first, second in permutations(model.states, 2):
        for told in (f" between {first} and {second}", f" from {first} into {second}"):
            if name.endswith(told.replace(" ", "_")):
                return name[: -len(told)].replace("_", " ") + called(told, labels)
    for state in filter(lambda one: name.endswith(f"_{one}"), model.states):
        stem = name.removesuffix(f"_{state}").replace("_", " ")
        kinds = filter(f"{stem} ".startswith, map("{} ".format, WORDS_OF_PARAMETERS))
        kind = max(kinds, key=len, default="").rstrip()
        if kind:
            rest = stem[len(kind) + 1 :]
            is_variable = rest in (*model.states, *model.inputs)
            # A constant force is none of an input "force".
            is_source = BY_NAME.get(kind) in LAWS["forces"]
            if is_variable and not is_source:
                rest = f"of {called(rest, labels)}"
            words = f"{WORDS_OF_PARAMETERS[kind] or kind} {rest}".rstrip()
            of_state = "of" if law_of(kind).slot in ("H", "sensor") else OF_EQUATION
            return f"{words} {of_state} {called(state, labels)}"
    return name


def parameter_symbols(model: BaseModel) -> dict[str, str]:
    """Symbols of the parameters of effects by their names; others are their own.

    A letter with the law as its index, such as "F_C" of Coulomb friction and "c_cubic
    drag"; where several are alike, with the place as well.
    """
    usual = {"coulomb friction": "F_C", "stribeck friction": "F_S"}
    between = ("between", "and", "from", "into", "with")
    places = re.compile(f"(_({'|'.join((*model.states, *model.inputs, *between))}))+$")
    found: dict[str, str] = {}
    for name, entry in model.entries.items():
        if "[" in name or parameter_words(model, name) == name:
            continue
        stem = places.sub("", name).replace("_", " ")
        if stem.endswith("delay"):  # a time in u(t - 5 ms)
            continue
        letter = "\N{GREEK SMALL LETTER TAU}" if entry.parameter.unit == "s" else "c"
        symbol = usual.get(stem, f"{letter}_{re.sub(' time.*', '', stem)}")
        if "." in name:  # inside a formula
            symbol = name.rpartition(".")[2]
        place = name.partition(".")[0].rpartition("_")[2]
        found[name] = f"{symbol}, {place}" if symbol in found.values() else symbol
    return found


def laws_told() -> dict[str, str]:
    """What each law of the catalogue adds, by its name, in the names of any model."""
    names = {"angle": "q", "s": "x2", "s_e": "e2", "source": "force", "of_u": ""}
    names |= {"dF": "dF/du "}
    for name in ("e", "q", "x", "u", "omega", "q1", "q2", "x1", "x2"):
        names[name] = name
    told = {}
    for law in chain(*LAWS.values()):
        told[law.name.format_map(names)] = law.adds.format_map(names)
    return told


def is_second_storage(effect: Effect) -> bool:
    """Whether an effect splits a storage in two.

    Half of it gone, the capacity of the model means another thing: a linearisation of
    the model without the effect says nothing about it.
    """
    return effect.family == SECOND_STORAGE
