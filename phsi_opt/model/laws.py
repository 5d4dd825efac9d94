"""The laws of the catalogue as tables: one row per law, with names to fill in.

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
The cells of a row are, in this order: name; roles of the states in whose equations the
law is offered (none: all); formula; family; name of the coefficient; and, in H, the
force of the law in a model without an energy. Several formulas, and their coefficients,
are separated by ";". A coefficient may be ``>= 0``, ``formula`` (none), or empty
(named by its place); without this cell it is the last text of the table. A formula
brings what it names of ``INNER_PARAMETERS`` and ``MEMORIES``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain, permutations
from typing import NamedTuple

import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import needs_brackets
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.structure import Role
from phsi_opt.model.terms import Dictionary, Term

SECOND_STORAGE = "a storage that is not measured"
STORAGES = (SECOND_STORAGE, "a spring that yields", "a resonance")

# ---- parameters inside the bodies ----------------------------------------------------

# Dry friction turns over within this share of the typical (root mean square) velocity:
# sharp beside the motion, smooth for the solver. The fourth powers make its plateau
# flat, so that the share costs no friction at the velocities beyond it.
FRICTION_TURNOVER = 0.06
# Limits to try, as shares of the largest level or value; closer to each other near the
# largest one, where a limit is passed briefly.
LIMITS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.94, 0.97)


def _tried(of: str, *shares: float, most: float = np.inf, unit: str = "") -> Parameter:
    """A positive parameter that starts at the best of several values."""
    return Parameter(lower=0.0, unit=unit, guess=Tried(of, shares, most))


def _width(of: str, share: float, *sharper: float) -> Parameter:
    """A width within which a corner is rounded: known, as a share of a typical size."""
    return Parameter(lower=0.0, fixed=True, guess=Share(of, share, sharper))


# In times between samples: from a share of one on, each about 1.6 times the last.
DELAY = _tried(
    *("dt", 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0),
    *(13.0, 21.0, 34.0, 55.0, 89.0, 144.0, 233.0),
    unit="s",
)
# No limit or play beyond the largest value does anything: most is 1 there.
INNER_PARAMETERS = {
    # The corner is then halved while that fits better. By a quarter at once, the steps
    # of fits of 10 000 samples went to and fro 20 times.
    "v0": _width("{e}", FRICTION_TURNOVER, *(0.5,) * 6),
    # The Stribeck speed. A friction that falls over a longer range is Coulomb's.
    "v_s": _tried("{e}", 0.05, 0.1, 0.2, 0.3, 0.45, most=3.0),
    # A turbulent leak turns laminar below this share of the typical level, where its
    # square root would be steep without end.
    "e0": _width("{e}", 0.01),
    # The level at which a saturating leak has half of its conductance.
    "half": _tried("{e}", 0.03, 0.1, 0.3, 1.0),
    "limit": _tried("{level}", *LIMITS, most=1.0),
    "{omega}": Parameter(lower=0.0, unit="rad/s", guess=Scan("t")),
    "dead_zone_{u}_{x}": _tried(
        *("{u}", 0.005, 0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8), most=1.0
    ),
    "saturation_{u}_{x}": _tried(
        *("{u}", 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98), most=1.0
    ),
    "lag_{u}_{x}": DELAY,
    "delay_{u}_{x}": Parameter(lower=0.0, unit="s"),
    "play": _tried("{q}", 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, most=1.0),
    # Shares of the longest record; what takes longer is told from a constant by
    # nothing. A re-fit begins at the one in the middle: a second storage that follows
    # soon is hardly different from the first, and a solver finds its way from there.
    "storage_time_constant_{x}": _tried(
        *("t", 0.002, 0.003, 0.005, 0.01, 0.03, 0.1, 0.3), most=1.0, unit="s"
    ),
    # The displacement over which a hysteresis yields.
    "hysteresis_width_{x}": _tried("{q}", 0.05, 0.1, 0.2, 0.4),
    "bouc_wen_shape_{x}": Parameter(lower=-2.0, guess=Tried("1", (-1.0, 0.0), 2.0)),
    # Within this share of the typical velocity its absolute value is rounded; that of
    # the hysteresis' state, which stays within -1 and 1, within 0.05.
    "hysteresis_slow_{x}": _width("{e}", 0.02),
    "relaxation_time_{x}": _tried(
        *("t", 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.3), most=1.0, unit="s"
    ),
    # Over 2 pi the period of a resonance; a quarter more from one to the next.
    "resonance_time_{x}": _tried("dt", *(0.6 * 1.25**k for k in range(24)), unit="s"),
    "resonance_damping_{x}": Parameter(0.1, lower=0.0),
    "clipping_{x}": _tried("{x}", *LIMITS, most=1.0),
    "sensor_delay_{x}": DELAY,
}

# ---- memory: further states, each with its rate --------------------------------------


# The delay tau of a sensor is Pade's approximation of order three, with three states a,
# b = a', c = a'', whose phase is right to 1 % up to tau times the frequency = 4:
#     c' = 120/tau^3 (x - a) - 60/tau^2 b - 12/tau c
#     x(t - tau) = x - 2 (x - a) + tau^2/5 c
LATE_READING = "2*({x}_delayed - {x}) + sensor_delay_{x}**2/5*{x}_delayed_bend"
READING_MEMORY = {
    "{x}_delayed": "{x}_delayed_rate",
    "{x}_delayed_rate": "{x}_delayed_bend",
    "{x}_delayed_bend": "120/sensor_delay_{x}**3*({x} - {x}_delayed)"
    " - 60/sensor_delay_{x}**2*{x}_delayed_rate - 12/sensor_delay_{x}*{x}_delayed_bend",
}


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
# By the state that the bodies name.
MEMORIES: Mapping[str, Mapping[str, str]] = {
    # The force follows the lagged input z: lag dz/dt = u - z.
    "{u}_lagged_{x}": {"{u}_lagged_{x}": "({u} - {u}_lagged_{x})/lag_{u}_{x}"},
    # A second storage z beside the state x, such as the walls around a room's air:
    # dx/dt = ... + c (z - x), tau dz/dt = x - z. With the capacities C1 and C2 and a
    # resistance R between the two, c = 1/(R C1) and tau = R C2, so that C2/C1 = c tau.
    # What the model had for both before is now for the first alone.
    "{x}_second": {"{x}_second": "({x} - {x}_second)/storage_time_constant_{x}"},
    "hysteresis_{x}": {"hysteresis_{x}": _bouc_wen("hysteresis_{x}")},
    "bouc_wen_{x}": {"bouc_wen_{x}": _bouc_wen("bouc_wen_{x}", "bouc_wen_shape_{x}*")},
    # A spring and a damper in series: z is how far the damper has given way.
    "{q}_relaxed": {"{q}_relaxed": "({q} - {q}_relaxed)/relaxation_time_{x}"},
    # A small mass on a spring and a damper, at z with the velocity w.
    "{q}_absorber": {
        "{q}_absorber": "{q}_absorber_rate",
        "{q}_absorber_rate": ABSORBER,
    },
    "{x}_delayed": READING_MEMORY,
}

# ---- what people call them -----------------------------------------------------------

# By the name of a law: its odds, what it adds, with c for its coefficient, and its
# other names. A row of several laws of like names begins as they do. The odds say how
# often such a thing is met before anything is measured: 4 where three or more of the
# measured machines that this package was tried on had it (some 24), 1 where one or two
# had, or where it is a textbook's usual law, 1/4 where none had and most machines have
# no reason to.
SAID = """
viscous damping | 4 | -c {e} | viscous friction, damper, dashpot, linear drag
laminar pipe friction | 1 | -c {e} | pipe resistance, pipe loss
linear leak | 1 | -c {e} | leak, leakage, seepage
linear resistance | 1 | -c {e} | ohmic loss, winding resistance, series resistance
leakage conductance | 1 | -c {e} | leakage current, self-discharge
heat loss | 4 | -c {e} | cooling, convection, heat leak, heat transfer
coulomb friction | 4 | -c sign({e}) | dry friction, sliding friction, kinetic friction
contact voltage drop | 1 | -c sign({e}) | brush drop, diode drop
quadratic drag | 4 | -c |{e}| {e} | air drag, air resistance, wind resistance, windage
turbulent pipe friction | 1 | -c |{e}| {e} | pipe loss, pressure loss
quadratic leak | 1 | -c |{e}| {e} | leak, leakage
quadratic resistance | 1 | -c |{e}| {e} |
quadratic conductance | 1 | -c |{e}| {e} |
quadratic heat loss | 1 | -c |{e}| {e} | natural convection
cubic drag | 1/4 | -c {e}^3 |
stribeck friction | 1 | -(c + s exp(-({e}/v_s)^2)) sign({e}) | stiction, static friction
turbulent leak | 4 | -c sign({e}) sqrt(|{e}|) | leak, leakage, orifice, outflow, hole
saturating leak | 1 | -c {e}/(1 + |{e}|/half) | leak, leakage
overflow | 1 | -c sign({e}) max(|{e}| - limit, 0) | spill, weir
radiation | 1 | -c {e}^3 |{e}| | thermal radiation, radiative loss
position-dependent damping | 1/4 | -c {q}^2 {e} | position-dependent friction
charge-dependent resistance | 1/4 | -c {q}^2 {e} |
constant | 4 | c | bias, offset, load, tilt, gravity, disturbance, supply
drifting | 1/4 | c t | drift, trend, ramp
harmonic | 1/4 | a sin({omega} t) + b cos({omega} t) | unbalance, vibration, ripple, hum
quadratic input | 1 | c {u}^2 | nonlinear actuator
odd quadratic input | 1 | c |{u}| {u} | nonlinear actuator
cubic input | 1/4 | c {u}^3 | nonlinear actuator
input gain | 1 | c {dF}{u} | actuator gain, calibration, scale error
input dead zone | 1 | -{dF}min(max({u}, -width), width) | dead band, threshold
input saturation | 1 | -{dF}({u} - min(max({u}, -limit), limit)) | saturation
input lag | 4 | {dF}(z - {u}), lag dz/dt = {u} - z | actuator lag, slow actuator
input delay | 4 | {dF}({u}(t - delay) - {u}) | dead time, transport delay, latency
linear stiffness | 1 | energy c {q}^2/2 | spring
quadratic stiffness | 1 | energy c {q}^3/3 | asymmetric spring
cubic stiffness | 4 | energy c {q}^4/4 | hardening, softening, duffing spring
gravity torque | 1 | energy -c cos({angle}) | pendulum, imbalance, eccentric weight
linear elastance | 1 | energy c {q}^2/2 | series capacitor
quadratic elastance | 1 | energy c {q}^3/3 |
cubic elastance | 1 | energy c {q}^4/4 |
coil saturation | 1 | energy c {x}^4/4 | saturation, iron saturation, magnetic saturation
coil or capacitor saturation | 1 | energy c {x}^4/4 | saturation, iron saturation
coupling stiffness | 1 | energy c ({q1} - {q2})^2/2 | coupling spring
coupling capacitance | 1 | energy c ({q1} - {q2})^2/2 |
gap | 1 | energy c max(|{q}| - play, 0)^2/2 | backlash, free play, play, clearance, slack
second heat storage | 4 | c (z - {x}), tau dz/dt = {x} - z | wall, thermal mass, second storage
second charge storage | 4 | c (z - {x}), tau dz/dt = {x} - z | relaxation, second storage
parametric stiffness | 1/4 | -{q} (a sin({omega} t) + b cos({omega} t)) |
parametric elastance | 1/4 | -{q} (a sin({omega} t) + b cos({omega} t)) |
hysteresis | 1 | -c z, w dz/dt = {e} - (|{e}| z + {e} |z|)/2 | bouc-wen, presliding
bouc-wen hysteresis | 1/4 | -c z, w dz/dt = {e} - (|{e}| z + s {e} |z|)/2 | free hysteresis
maxwell element | 1 | -c ({q} - z), tau dz/dt = {q} - z | viscoelastic, creep, second storage
resonance | 1 | -m z'', tau^2 z'' = {q} - z + d tau ({e} - z') | absorber, tuned mass
unknown | 1/4 | f(z), or -r(z) {e} |
damper between | 1 | -c {e} | coupling damper, viscous coupling
dry friction between | 1 | -c sign({e}) | friction between, slipping clutch
gyroscopic coupling between | 1 | c dH/dx2, -c dH/dx1 | Coriolis force, magnetic force
spill from | 1 | c max({s_e} - limit, 0) | weir, overflow into
exchange of heat between | 4 | -c {e} | heat exchange, thermal bridge, thermal conductance
connection between | 1 | -c sign({e}) sqrt(|{e}|) | leak between, pipe, orifice
overflow from | 1 | c max({s_e} - limit, 0) | spill, weir
heat exchange with | 1 | c ({s_e} - {e}) | heat transfer, ambient, conduction
sensor offset | 1 | sensor + c | offset, bias, zero error
sensor gain | 1/4 | sensor + c {x} | calibration, scale error
sensor drift | 1/4 | sensor + c t | drift
sensor clipping | 1 | sensor = min(max({x}, -limit), limit) | clipping, saturation
sensor delay | 1 | sensor = {x}(t - delay) | latency, time delay, filter delay
"""  # noqa: E501


class Row(NamedTuple):
    """What is said of a law."""

    odds: float = 1.0  # before anything is measured
    adds: str = ""  # with names in braces
    others: tuple[str, ...] = ()  # names


ROWS: dict[str, Row] = {}
for _line in SAID.strip().splitlines():
    _name, _odds, _adds, _others = f"{_line} ".split(" | ")
    _names = tuple(filter(None, _others.strip().split(", ")))
    ROWS[_name] = Row(float(Fraction(_odds)), _adds, _names)


def said_of(name: str) -> Row:
    """What is said of an effect; of "input delay of u" the row is "input delay"."""
    words = name.split()
    for n in range(len(words), 0, -1):
        row = ROWS.get(" ".join(words[:n]))
        if row is not None:
            return row
    return Row()


# What the numbers of a law are, by the parts of their names, where these do not say it.
WORDS_OF_NUMBERS = {
    "v0": "speed of transition v0",
    "v_s": "Stribeck speed v_s",
    "e0": "level of transition e0",
    "half": "level of half the conductance",
    "ratio": "ratio of the capacities",
    "omega": "frequency omega",
    "dead zone": "half the width of the dead zone",
    "saturation": "limit of the saturation",
    "storage time constant": "time constant of the second storage",
    "clipping": "limit of the clipping",
    "hysteresis width": "width of the hysteresis",
    "bouc wen shape": "shape s of the hysteresis",
    "lag": "lag",
    "delay": "delay",
    "heat exchange": "heat exchange",
}


def parameter_words(model: BaseModel, name: str) -> str:
    """A parameter of an effect as people call it; other names stay as they are.

    Such as "coulomb friction on p, speed of transition v0" for coulomb_friction_p.v0.
    """
    place, _, body = name.partition("[")
    if name not in model.entries:  # such as one of a run: m[run 3]
        return name
    if body:
        return f"coefficient of {body.removesuffix(']')} in {place}"
    outer, _, inner = name.rpartition(".")
    if outer:
        told = WORDS_OF_NUMBERS.get(inner, inner)
        return f"{parameter_words(model, outer)}, {told}"
    for first, second in permutations(model.states, 2):
        for told in (f" between {first} and {second}", f" from {first} into {second}"):
            if name.endswith(told.replace(" ", "_")):
                return name[: -len(told)].replace("_", " ") + told
    for state in filter(lambda one: name.endswith(f"_{one}"), model.states):
        stem = name.removesuffix(f"_{state}").replace("_", " ")
        starts = filter(
            f"{stem} ".startswith, map("{} ".format, (*WORDS_OF_NUMBERS, *ROWS))
        )
        kind = max(starts, key=len, default="").rstrip()
        if kind:
            rest = stem[len(kind) + 1 :]
            is_variable = rest in (*model.states, *model.inputs)
            # A constant force is none of an input "force".
            is_source = any(law.name == f"{kind} {{source}}" for law in FORCES)
            of = " of" if is_variable and not is_source else ""
            words = WORDS_OF_NUMBERS.get(kind, kind)
            return f"{words}{of} {rest}".rstrip() + f" on {state}"
    return name


# ---- a law ---------------------------------------------------------------------------


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
    """

    name: str
    slot: str
    terms: Mapping[str, str]
    family: str
    roles: tuple[Role, ...] = ()
    force: str = ""

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
        known = {one.body for one in model.terms_at(slot, equation)}
        memory = {}
        try:
            name = self.name.format_map(names)
            names = {**names, "name": name.replace(" ", "_")}
            if slot == "sensor":
                names["inertia"] = ""
            of_direction = names.get("ratio", "")
            added = [_term(*one, names, of_direction) for one in terms.items()]
            added = [one for one in added if one.body not in known]
            if not added:
                return None
            for first, rates in MEMORIES.items():
                for state, rate in rates.items() if first in "".join(terms) else ():
                    rate_term = _term(rate, "formula", names)
                    memory[state.format_map(names)] = Dictionary((rate_term,))
            # What the rates name is known to the whole model.
            for one in chain(*memory.values()):
                added = [_without(term, one.inner) for term in added]
            family = self.family.format_map(names)
        except KeyError:  # the equation has no position, or no such input
            return None
        sum_of_terms = Dictionary(tuple(added))
        return Effect(name, slot, equation, sum_of_terms, memory, family)


def _without(term: Term, known: Mapping[str, Parameter]) -> Term:
    """A term less the parameters that are known already."""
    own = {name: one for name, one in term.inner.items() if name not in known}
    return replace(term, inner=own)


def _term(
    template: str, coefficient: str, names: Mapping[str, str], ratio: str = ""
) -> Term:
    """A term with the names filled in, and the parameters that its body names.

    And the ratio of two capacities in the direction along which it stands, if any.
    """
    inner = {ratio: Parameter(1.0, lower=0.0)} if ratio else {}
    for key, parameter in INNER_PARAMETERS.items():
        if key in template:
            guess = parameter.guess
            if isinstance(guess, Share | Tried):
                guess = replace(guess, of=guess.of.format_map(names))
            inner[key.format_map(names)] = replace(parameter, guess=guess)
    body = template.format_map(names)
    if coefficient == "formula":
        return Term(body, None, inner)
    if names["inertia"] and "{slope}" not in template:
        body = f"{f'({body})' if needs_brackets(body) else body}/{names['inertia']}"
    called, _, bound = coefficient.partition(" >= ")
    free = Parameter(lower=float(bound or -np.inf))
    return Term(body, free, inner, called.format_map(names))


# ---- tables --------------------------------------------------------------------------

FAMILIES = {
    "GROWING": "a loss that grows with {grows_with}",
    "CHANGING": "{a_source} that changes with the time",
    "LATE": "a delay of the input",
    "POSITION": "{a_source} that depends on the {place}",
    "SATURATION": "a storage that saturates",
    "SECOND": SECOND_STORAGE,
    "READING": "an error of the sensor",
}
SHORTHAND = {
    # sign(e)/e, rounded within the turnover velocity v0.
    "DRY": "({e}**4 + v0**4)**(-0.25)",
    "BOTH": "coulomb_friction_{x} >= 0; stribeck_friction_{x} >= 0",
    "DEAD": "min(max({u}, -dead_zone_{u}_{x}), dead_zone_{u}_{x})",
    "FULL": "min(max({u}, -saturation_{u}_{x}), saturation_{u}_{x})",
    "LATE_READING": LATE_READING,
    "OUTSIDE": "-max({q} - play, 0) + max(-{q} - play, 0)",
    "HELD": "hysteresis_force_{x} >= 0",
    "ABSORBED": ABSORBER,
    "WAVES": "-{q}*sin({omega}*t); -{q}*cos({omega}*t)",
}


def _laws(slot: str, table: str, coefficient: str = "{name}_{x}") -> tuple[Law, ...]:
    """The laws of a table, with the coefficient of the rows that say none."""
    defaults = ("GROWING", coefficient, "")
    for code, part in SHORTHAND.items():
        table = table.replace(code, part)
    laws = []
    for line in table.strip().splitlines():
        name, roles, bodies, *rest = map(str.strip, line.split("|"))
        family, coefficients, force = (*rest, *defaults[len(rest) :])
        names = bodies.split("; ")
        terms = dict(zip(names, coefficients.split("; ") * len(names), strict=False))
        of_roles = tuple(Role[role] for role in roles.split(", ") if role)
        said = FAMILIES.get(family, family)
        laws.append(Law(name, slot, terms, said, of_roles, force))
    return tuple(laws)


# Losses: terms of R_ii >= 0 = loss/effort. A turbulent leak is the square root of the
# level, linear below a small one; Stribeck's friction is larger at low speed.
LOSSES = _laws(
    "R",
    """
viscous damping | BODY | 1
laminar pipe friction | PIPE | 1
linear leak | TANK, UNKNOWN | 1
linear resistance | COIL, CIRCUIT | 1
leakage conductance | CAPACITOR | 1
heat loss | HEAT | 1
coulomb friction | BODY, UNKNOWN | DRY | dry friction
contact voltage drop | COIL, CIRCUIT | DRY | a constant voltage drop
quadratic drag | BODY, UNKNOWN | abs({e})
turbulent pipe friction | PIPE | abs({e})
quadratic leak | TANK | abs({e})
quadratic resistance | COIL, CIRCUIT | abs({e})
quadratic conductance | CAPACITOR | abs({e})
quadratic heat loss | HEAT | abs({e})
cubic drag | BODY, UNKNOWN | {e}**2
stribeck friction | BODY, UNKNOWN | DRY; DRY*exp(-({e}/v_s)**2) | dry friction | BOTH
turbulent leak | TANK, UNKNOWN | ({e}**2 + e0**2)**(-0.25)
saturating leak | TANK, UNKNOWN | 1/(1 + abs({e})/half)
overflow | TANK, UNKNOWN | max(abs({e}) - limit, 0)/max(abs({e}), limit) | an overflow
radiation | HEAT | {radiation}
position-dependent damping | BODY | {q}**2 | damping that depends on the position
charge-dependent resistance | COIL | {q}**2 | a resistance that depends on a charge
""",
    "{name}_{x} >= 0",
)
# What comes from outside, in the time.
FORCES = _laws(
    "F",
    """
constant {source} | | 1 | a constant {source}
drifting {source} | | t | CHANGING
harmonic {source} | | sin({omega}*t); cos({omega}*t) | CHANGING |
""",
)
# Between an input and its force.
INPUTS = _laws(
    "F",
    """
quadratic input{of_u} | | {u}**2 | {input_size} | quadratic_input_{u}_{x}
odd quadratic input{of_u} | | abs({u})*{u} | {input_size} | odd_quadratic_input_{u}_{x}
cubic input{of_u} | | {u}**3 | {input_size} | cubic_input_{u}_{x}
input gain{of_u} | | {new} | {input_size} | input_gain_{u}_{x}
input gain{of_u} | | {slope}*{u} | {input_size} | input_gain_{u}_{x}
input dead zone{of_u} | | -{slope}*DEAD | {input_size} | formula
input saturation{of_u} | | -{slope}*({u} - FULL) | {input_size} | formula
input lag{of_u} | | {slope}*({u}_lagged_{x} - {u}) | LATE | formula
input delay{of_u} | | {slope}*(delayed({u}, delay_{u}_{x}) - {u}) | LATE | formula
""",
)
# What stores energy; a gap is a spring with free play, to both sides.
ENERGIES = _laws(
    "H",
    """
linear stiffness | BODY, PIPE | {q}**2/2 | POSITION | {name}_{q} | -{q}
quadratic stiffness | BODY, PIPE | {q}**3/3 | POSITION | {name}_{q} | -{q}**2
cubic stiffness | BODY, PIPE | {q}**4/4 | POSITION | {name}_{q} | -{q}**3
gravity torque | BODY | -cos({angle}) | POSITION | {name}_{q} | -sin({angle})
linear elastance | COIL | {q}**2/2 | POSITION | {name}_{q} | -{q}
quadratic elastance | COIL | {q}**3/3 | POSITION | {name}_{q} | -{q}**2
cubic elastance | COIL | {q}**4/4 | POSITION | {name}_{q} | -{q}**3
coil saturation | COIL | {own}**4/4 | SATURATION | {name}_{own}
coil or capacitor saturation | CIRCUIT | {own}**4/4 | SATURATION | {name}_{own}
coupling stiffness | BODY | ({q1} - {q2})**2/2 | a coupling of two positions
coupling stiffness | PIPE | ({q1} - {q2})**2/2 | a coupling of two volumes
coupling capacitance | COIL | ({q1} - {q2})**2/2 | a coupling of two charges
gap | BODY | max(abs({q}) - play, 0)**2/2 | POSITION | gap_{q} >= 0 | OUTSIDE
""",
    "{name}_{q1}_{q2}",
)
# What remembers, or changes with the time. The force of a parametric stiffness is
# -q (a sin(omega t) + b cos(omega t)).
LASTING = _laws(
    "F",
    """
second heat storage | HEAT | {x}_second - {x} | SECOND | {name}_{x} >= 0
second charge storage | CIRCUIT | {x}_second - {x} | SECOND | {name}_{x} >= 0
parametric stiffness | BODY, PIPE | WAVES | a stiffness that changes with the time |
parametric elastance | COIL | WAVES | a capacitance that changes with the time |
hysteresis | BODY, PIPE, COIL | -hysteresis_{x} | hysteresis | HELD
bouc-wen hysteresis | BODY, PIPE, COIL | -bouc_wen_{x} | hysteresis | HELD
maxwell element | BODY | {q}_relaxed - {q} | a spring that yields | {name}_{x} >= 0
resonance | BODY | -(ABSORBED) | a resonance | resonance_mass_{x} >= 0
""",
)
# Between storages, and from the surroundings. What the other storage loses by it is an
# effect of its own, in that one's equation.
OVERFLOWS = _laws(
    "F",
    "overflow from {s} | | max({s_e} - limit, 0) | an overflow | overflow_{s}_{x} >= 0",
)
HEAT_EXCHANGES = _laws(
    "F",
    "heat exchange with {s} | HEAT | {s_e} - {e} | an exchange of heat",
    "heat_exchange_{s}_{x} >= 0",
)
# What acts between two states, and takes from the one what the other gets.
BETWEEN = _laws(
    "R",
    """
damper between {x1} and {x2} | BODY | 1 | a loss between two bodies
dry friction between {x1} and {x2} | BODY | DRY | a loss between two bodies
exchange of heat between {x1} and {x2} | HEAT | 1 | an exchange of heat
connection between {x1} and {x2} | TANK | ({e}**2 + e0**2)**(-0.25) | a connection
""",
    "{name} >= 0",
)
# As an entry of S between two momenta does, without loss.
EXCHANGES = _laws(
    "F",
    "gyroscopic coupling between {x1} and {x2} | BODY | 1 | a coupling without loss",
    "{name}",
)
SPILLS = _laws(
    "F",
    "spill from {s} into {x} | | max({s_e} - limit, 0) | an overflow",
    "{name} >= 0",
)
# What a sensor adds to the state: measured = state + sensor terms.
SENSORS = _laws(
    "sensor",
    """
sensor offset | | 1 | READING
sensor gain | | {x} | READING
sensor drift | | t | READING
sensor clipping | | min(max({x}, -clipping_{x}), clipping_{x}) - {x} | READING | formula
sensor delay | | LATE_READING | a delay of the sensor | formula
""",
)


TABLES = (
    *(LOSSES, ENERGIES, FORCES, INPUTS, LASTING),
    *(OVERFLOWS, HEAT_EXCHANGES, BETWEEN, EXCHANGES, SPILLS, SENSORS),
)
# Names that stand for those of any model.
ANY_MODEL = {"e": "e", "q": "q", "angle": "q", "x": "x", "u": "u", "omega": "omega"}
ANY_MODEL |= {"s": "x2", "s_e": "e2", "q1": "q1", "q2": "q2", "x1": "x1", "x2": "x2"}
ANY_MODEL |= {"source": "force", "of_u": "", "dF": "dF/du "}


def laws_told() -> dict[str, str]:
    """What each law of the catalogue adds, by its name, in the names of any model."""
    told = {}
    for law in chain(*TABLES):
        name = law.name.format_map(ANY_MODEL)
        told[name] = said_of(name).adds.format_map(ANY_MODEL)
    return told


def is_second_storage(effect: Effect) -> bool:
    """Whether an effect splits a storage in two.

    Half of it gone, the capacity of the model means another thing: a linearisation of
    the model without the effect says nothing about it.
    """
    return effect.family == SECOND_STORAGE
