"""The laws of the catalogue as tables: one row per law, with names to fill in.

In the texts of a row stand names in braces, which the ``catalogue`` fills in:

- ``{x}`` the state of the equation, ``{own}`` the same where nothing else is beside it;
- ``{e}`` its effort: a velocity, a flow, a level;
- ``{q}`` the position of a momentum, ``{angle}`` the same in radians;
- ``{u}`` an input, ``{slope}`` the slope of the model's own force in it, ``{new}`` an
  input that the equation does not use yet, ``{of_u}`` its name where there are several;
- ``{s}`` another storage or input, ``{s_e}`` its effort; ``{q1}``, ``{q2}`` positions;
- ``{source}``, ``{a_source}``, ``{grows_with}``, ``{input_size}`` words of the field.

A row that needs a name which an equation does not have is not offered there. A loss is
R_ii dH/dx_i, so that a force c f(v) against the velocity v has R_ii = c f(v)/v.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.effect import Effect
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.roles import Role
from phsi_opt.model.terms import Dictionary, Term

HYSTERESIS = "hysteresis"
SECOND_STORAGE = "a storage that nobody measures"
POSITION_FORCE = "a force that depends on the position"
CHANGING_STIFFNESS = "a stiffness that changes with the time"
WRONG_READING = "an error of the sensor"

# ---- values that are tried before a parameter is optimised ---------------------------

# Upper bound, as a share of the largest value: no rim, play or limit beyond it does
# anything.
LARGEST_SHARE = 1.0
# Rims and clipping limits to try, as shares of the largest level or value; closer to
# each other near the largest one, where a limit is passed briefly.
LIMITS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.94, 0.97)
# Lags and delays to try, in times between samples: from a share of one sample on, each
# about 1.6 times the last one.
DELAYS = (
    *(0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0),
    *(13.0, 21.0, 34.0, 55.0, 89.0, 144.0, 233.0),
)
# Dry friction turns over within this share of the typical (root mean square) velocity:
# sharp beside the motion, smooth for the solver. The fourth powers make its plateau
# flat, so that the share costs no friction at the velocities beyond it.
FRICTION_TURNOVER = 0.06
# Factors by which the turnover is then made sharper, where that fits better.
SHARPER_TURNOVERS = (0.25, 0.25, 0.25)
# Stribeck speeds to try, as shares of the largest velocity.
STRIBECK_SPEEDS = (0.05, 0.1, 0.2, 0.3, 0.45)
# Upper bound of the Stribeck speed, as such a share: a friction that falls over a
# longer range of velocities is Coulomb's.
LARGEST_STRIBECK_SPEED = 3.0
# A turbulent leak turns laminar below this share of the typical level, where its square
# root would be steep without end.
LAMINAR_LEVEL = 0.01
# Levels at which a saturating leak has half its conductance, to try, as shares of the
# largest level.
HALF_LEVELS = (0.03, 0.1, 0.3, 1.0)
# Free plays of a gap to try, as shares of the largest position.
PLAYS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9)
# Half widths of a dead zone to try, as shares of the largest input.
DEAD_ZONES = (0.005, 0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8)
# Limits of a saturation to try, as shares of the largest input.
SATURATIONS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
# Displacements over which a hysteresis yields, to try, as shares of the largest
# position.
YIELD_WIDTHS = (0.05, 0.1, 0.2, 0.4)
# The absolute value of the velocity in a hysteresis is rounded within this share of the
# typical (root mean square) velocity; that of its state z, which stays within -1 and 1,
# within 0.05.
ROUNDED_VELOCITY = 0.02
# Times in which a second storage follows, to try, as shares of the longest record; what
# takes longer than the record is told from a constant by nothing. A re-fit begins at
# the one in the middle: a second storage that follows soon is hardly different from the
# first, and a solver finds its way from there (a house and a cell: from 0.002 and 0.01;
# from 0.05 and 0.2, where the exchange begins at zero, the cell's ended there).
FOLLOWING_TIMES = (0.002, 0.003, 0.005, 0.01, 0.03, 0.1, 0.3)


def _tried(
    of: str, shares: tuple[float, ...], most: float = np.inf, unit: str = ""
) -> Parameter:
    """A positive parameter that starts at the best of several values."""
    return Parameter(lower=0.0, unit=unit, guess=Tried(of, shares, most))


def _width(of: str, share: float, sharper: tuple[float, ...] = ()) -> Parameter:
    """A width within which a corner is rounded: known, as a share of a typical size."""
    return Parameter(lower=0.0, fixed=True, guess=Share(of, share, sharper))


FREQUENCY = Parameter(lower=0.0, unit="rad/s", guess=Scan("t"))
LAG = _tried("dt", DELAYS, unit="s")


# ---- a law -------------------------------------------------------------------------


@dataclass(frozen=True)
class Law:
    """A law of the catalogue: the effect that it has in any equation.

    Args:
        name: of the effect.
        slot: where it acts.
        terms: the name of the coefficient by the body of each term; "": named by its
            place, None: the body is a formula that has none. The effect's own name is
            known there as ``{name}``. Terms that a model has already are left out.
        family: its class in words.
        roles: of the states in whose equations it is offered; empty: of all.
        inner: the parameters inside the bodies and rates, by name.
        lower: least value of the coefficients.
        memory: the rates of further states, by their names.
        force: of a law in H: what it is in F of a model without an energy; "": nothing.
    """

    name: str
    slot: str
    terms: Mapping[str, str | None]
    family: str
    roles: tuple[Role, ...] = ()
    inner: Mapping[str, Parameter] = field(default_factory=dict)
    lower: float = -np.inf
    memory: Mapping[str, str] = field(default_factory=dict)
    force: str = ""

    def effect(self, model: BaseModel, names: Mapping[str, str]) -> Effect | None:
        """The effect in the equation of ``{x}``; None where it is not offered."""
        try:
            return self._filled(model, names)
        except KeyError:  # the equation has no position, or no such input
            return None

    def _filled(self, model: BaseModel, names: Mapping[str, str]) -> Effect | None:
        name = self.name.format_map(names)
        names = {**names, "name": name.replace(" ", "_")}
        slot, terms = self.slot, self.terms
        if slot == "H" and not model.has_energy:
            slot = "F"
            terms = dict.fromkeys([self.force] if self.force else [], *terms.values())
        inner = {}
        for key, parameter in self.inner.items():
            inner[key] = (key.format_map(names), _of(parameter, names))

        def term(template: str, coefficient: str | None) -> Term:
            own = dict(one for key, one in inner.items() if key in template)
            body = template.format_map(names)
            if coefficient is None:
                return Term(body, None, own)
            free = Parameter(lower=self.lower)
            return Term(body, free, own, coefficient.format_map(names))

        known = {one.body for one in model.terms_at(slot, names["x"])}
        added = [term(*one) for one in terms.items()]
        added = [one for one in added if one.body not in known]
        memory = {}
        for state, rate in self.memory.items():
            memory[state.format_map(names)] = Dictionary((term(rate, None),))
        if not added:
            return None
        family = self.family.format_map(names)
        sum_of_terms = Dictionary(tuple(added))
        return Effect(name, slot, names["x"], sum_of_terms, memory, family)


def _of(parameter: Parameter, names: Mapping[str, str]) -> Parameter:
    """The parameter with the expression of its guess filled in."""
    guess = parameter.guess
    if not isinstance(guess, Share | Tried):
        return parameter
    return replace(parameter, guess=replace(guess, of=guess.of.format_map(names)))


# ---- losses: terms of R_ii >= 0 ------------------------------------------------------

# The name, the roles, R_ii = loss/effort, the family where it is none that grows. A
# turbulent leak is the square root of the level, linear below a small one.
LOSS_TABLE = """
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
stribeck friction | BODY, UNKNOWN | DRY + RISE | dry friction
turbulent leak | TANK, UNKNOWN | ({e}**2 + e0**2)**(-0.25)
saturating leak | TANK, UNKNOWN | 1/(1 + abs({e})/half)
overflow | TANK, UNKNOWN | max(abs({e}) - limit, 0)/max(abs({e}), limit) | an overflow
radiation | HEAT | {radiation}
position-dependent damping | BODY | {q}**2 | damping that depends on the position
charge-dependent resistance | COIL | {q}**2 | a resistance that depends on a charge
"""
# sign(e)/e, rounded within the turnover velocity v0.
DRY = "({e}**4 + v0**4)**(-0.25)"
SUMS = {
    "DRY": {DRY: "{name}_{x}"},
    # Dry friction that is larger at low speed: f_c + f_s exp(-(v/v_s)^2).
    "DRY + RISE": {
        DRY: "coulomb_friction_{x}",
        f"{DRY}*exp(-({{e}}/v_s)**2)": "stribeck_friction_{x}",
    },
}
LOSS_PARAMETERS = {
    "v0": _width("{e}", FRICTION_TURNOVER, SHARPER_TURNOVERS),
    "v_s": _tried("{e}", STRIBECK_SPEEDS, LARGEST_STRIBECK_SPEED),
    "e0": _width("{e}", LAMINAR_LEVEL),
    "half": _tried("{e}", HALF_LEVELS),
    "limit": _tried("{e}", LIMITS, LARGEST_SHARE),
}


def _rows(table: str) -> list[list[str]]:
    """The cells of a table, a list per line."""
    rows = []
    for line in table.strip().splitlines():
        rows.append([cell.strip() for cell in line.split("|")])
    return rows


def _roles(names: str) -> tuple[Role, ...]:
    return tuple(Role[name] for name in names.split(", "))


def _losses() -> Iterator[Law]:
    for name, roles, body, *family in _rows(LOSS_TABLE):
        said = family[0] if family else "a loss that grows with {grows_with}"
        terms = SUMS.get(body, {body: "{name}_{x}"})
        yield Law(name, "R", terms, said, _roles(roles), LOSS_PARAMETERS, lower=0.0)


LOSSES = tuple(_losses())

# ---- what comes from outside, in the time: terms of F --------------------------------

CHANGING = "{a_source} that changes with the time"
FORCES = (
    Law("constant {source}", "F", {"1": "{name}_{x}"}, "a constant {source}"),
    Law("drifting {source}", "F", {"t": "{name}_{x}"}, CHANGING),
    Law(
        "harmonic {source}",
        "F",
        dict.fromkeys(("sin({omega}*t)", "cos({omega}*t)"), ""),
        CHANGING,
        inner={"{omega}": FREQUENCY},
    ),
)

# ---- between an input and its force: terms of F --------------------------------------

INPUT_DELAY = "a delay of the input"


def _delayed(signal: str, tau: str, a: str) -> tuple[str, dict[str, str]]:
    """The change s(t - tau) - s(t) of a signal s, and the states that it remembers.

    Pade's approximation of order three has three states a, b = a', c = a''::

        c' = 120/tau^3 (s - a) - 60/tau^2 b - 12/tau c
        s(t - tau) = s - 2 (s - a) + tau^2/5 c

    The phase is right to 1 % up to tau times the frequency = 4.
    """
    b, c = f"{a}_rate", f"{a}_bend"
    jerk = f"120/{tau}**3*({signal} - {a}) - 60/{tau}**2*{b} - 12/{tau}*{c}"
    return f"2*({a} - {signal}) + {tau}**2/5*{c}", {a: b, b: c, c: jerk}


LATE_INPUT, INPUT_MEMORY = _delayed("{u}", "delay_{u}_{x}", "{u}_delayed_{x}")


def _on_input(
    name: str,
    body: str,
    coefficient: str | None = None,
    inner: Mapping[str, Parameter] | None = None,
    memory: Mapping[str, str] | None = None,
) -> Law:
    family = INPUT_DELAY if memory else "{input_size}"
    terms = {body: coefficient}
    name = f"{name}{{of_u}}"
    return Law(name, "F", terms, family, inner=inner or {}, memory=memory or {})


def _limited(limit: str) -> str:
    """The input within a limit to both sides."""
    return f"min(max({{u}}, -{limit}), {limit})"


INPUTS = (
    _on_input("quadratic input", "{u}**2", "quadratic_input_{u}_{x}"),
    _on_input("input gain", "{new}", "input_gain_{u}_{x}"),
    _on_input("input gain", "{slope}*{u}", "input_gain_{u}_{x}"),
    _on_input(
        "input dead zone",
        f"-{{slope}}*{_limited('dead_zone_{u}_{x}')}",
        inner={"dead_zone_{u}_{x}": _tried("{u}", DEAD_ZONES, LARGEST_SHARE)},
    ),
    _on_input(
        "input saturation",
        f"-{{slope}}*({{u}} - {_limited('saturation_{u}_{x}')})",
        inner={"saturation_{u}_{x}": _tried("{u}", SATURATIONS, LARGEST_SHARE)},
    ),
    # The force follows the lagged input z: lag dz/dt = u - z.
    _on_input(
        "input lag",
        "{slope}*({u}_lagged_{x} - {u})",
        inner={"lag_{u}_{x}": LAG},
        memory={"{u}_lagged_{x}": "({u} - {u}_lagged_{x})/lag_{u}_{x}"},
    ),
    _on_input(
        "input delay",
        f"{{slope}}*({LATE_INPUT})",
        inner={"delay_{u}_{x}": LAG},
        memory=INPUT_MEMORY,
    ),
)

# ---- what stores energy: terms of H, or without an energy their forces ---------------


# The name, the roles, the energy, the force without one, the coefficient, the family.
ENERGY_TABLE = """
linear stiffness | BODY | {q}**2/2 | -{q} | {name}_{q} | POSITION
quadratic stiffness | BODY | {q}**3/3 | -{q}**2 | {name}_{q} | POSITION
cubic stiffness | BODY | {q}**4/4 | -{q}**3 | {name}_{q} | POSITION
gravity torque | BODY | -cos({angle}) | -sin({angle}) | {name}_{q} | POSITION
linear stiffness | PIPE | {q}**2/2 | -{q} | {name}_{q} | VOLUME
quadratic stiffness | PIPE | {q}**3/3 | -{q}**2 | {name}_{q} | VOLUME
cubic stiffness | PIPE | {q}**4/4 | -{q}**3 | {name}_{q} | VOLUME
linear elastance | COIL | {q}**2/2 | -{q} | {name}_{q} | CHARGE
quadratic elastance | COIL | {q}**3/3 | -{q}**2 | {name}_{q} | CHARGE
cubic elastance | COIL | {q}**4/4 | -{q}**3 | {name}_{q} | CHARGE
coil saturation | COIL | {own}**4/4 | | {name}_{own} | SATURATION
coil or capacitor saturation | CIRCUIT | {own}**4/4 | | {name}_{own} | SATURATION
coupling stiffness | BODY | ({q1} - {q2})**2/2 | | {name}_{q1}_{q2} | POSITIONS
coupling stiffness | PIPE | ({q1} - {q2})**2/2 | | {name}_{q1}_{q2} | VOLUMES
coupling capacitance | COIL | ({q1} - {q2})**2/2 | | {name}_{q1}_{q2} | CHARGES
"""
FAMILIES_OF_ENERGIES = {
    "POSITION": POSITION_FORCE,
    "VOLUME": "a pressure that depends on the volume",
    "CHARGE": "a voltage that depends on the charge",
    "SATURATION": "a storage that saturates",
    "POSITIONS": "a coupling of two positions",
    "VOLUMES": "a coupling of two volumes",
    "CHARGES": "a coupling of two charges",
}


def _energies() -> Iterator[Law]:
    for name, roles, body, force, coefficient, family in _rows(ENERGY_TABLE):
        said = FAMILIES_OF_ENERGIES[family]
        terms = {body: coefficient}
        yield Law(name, "H", terms, said, _roles(roles), force=force)


# A spring with free play, to both sides.
GAP = Law(
    "gap",
    "H",
    {"max(abs({q}) - play, 0)**2/2": "gap_{q}"},
    POSITION_FORCE,
    (Role.BODY,),
    {"play": _tried("{q}", PLAYS, LARGEST_SHARE)},
    lower=0.0,
    force="-max({q} - play, 0) + max(-{q} - play, 0)",
)
ENERGIES = (*_energies(), GAP)

# ---- what remembers, or changes with the time: terms of F ----------------------------


def _second_storage(name: str, roles: tuple[Role, ...]) -> Law:
    """A second storage z beside the state x, such as the walls around a room's air.

    ::

        dx/dt = ... + c (z - x),  tau dz/dt = x - z

    With the capacities C1 and C2 and a resistance R between the two, c = 1/(R C1) and
    tau = R C2, so that C2/C1 = c tau. What the model had for both before is now for the
    first alone.
    """
    following_time = _tried("t", FOLLOWING_TIMES, most=1.0, unit="s")
    return Law(
        name,
        "F",
        {"({x}_second - {x})": "{name}_{x}"},
        SECOND_STORAGE,
        roles,
        {"following_time_{x}": following_time},
        lower=0.0,
        memory={"{x}_second": "({x} - {x}_second)/following_time_{x}"},
    )


def _parametric(name: str, roles: tuple[Role, ...], family: str) -> Law:
    """A stiffness that changes: the force -q (a sin(omega t) + b cos(omega t))."""
    waves = ("-{q}*sin({omega}*t)", "-{q}*cos({omega}*t)")
    inner = {"{omega}": FREQUENCY}
    return Law(name, "F", dict.fromkeys(waves, ""), family, roles, inner)


LASTING = (
    _second_storage("second heat storage", (Role.HEAT,)),
    _second_storage("second charge storage", (Role.CIRCUIT,)),
    _parametric("parametric stiffness", (Role.BODY, Role.PIPE), CHANGING_STIFFNESS),
    _parametric(
        "parametric elastance", (Role.COIL,), "a capacitance that changes with the time"
    ),
    # Bouc (1967) and Wen (1976) with n = 1, rounded: the force is -c z, with
    # w dz/dt = v - (|v| z + v |z|)/2, so that z stays within -1 and 1, and w is the
    # displacement over which it yields.
    Law(
        HYSTERESIS,
        "F",
        {"-hysteresis_{x}": "hysteresis_force_{x}"},
        HYSTERESIS,
        (Role.BODY, Role.PIPE, Role.COIL),
        {
            "hysteresis_width_{x}": _tried("{q}", YIELD_WIDTHS),
            "hysteresis_slow_{x}": _width("{e}", ROUNDED_VELOCITY),
        },
        lower=0.0,
        memory={
            "hysteresis_{x}": "({e} - (sqrt({e}**2 + hysteresis_slow_{x}**2)"
            "*hysteresis_{x} + {e}*sqrt(hysteresis_{x}**2 + 0.0025))/2)"
            "/hysteresis_width_{x}"
        },
    ),
)

# ---- between storages, and from the surroundings: terms of F -------------------------

OVERFLOW_INTO = Law(
    "overflow from {s}",
    "F",
    {"max({s_e} - limit, 0)": "overflow_{s}_{x}"},
    "an overflow",
    inner={"limit": _tried("{s_e}", LIMITS, LARGEST_SHARE)},
    lower=0.0,
)
# What the other storage loses by it is an effect of its own, in that one's equation.
HEAT_EXCHANGE = Law(
    "heat exchange with {s}",
    "F",
    {"{s_e} - {e}": "heat_exchange_{s}_{x}"},
    "an exchange of heat",
    (Role.HEAT,),
    lower=0.0,
)

# ---- what a sensor adds to the state: measured = state + sensor terms ----------------

LATE_READING, READING_MEMORY = _delayed("{x}", "sensor_delay_{x}", "{x}_delayed")
SENSORS = (
    Law("sensor offset", "sensor", {"1": "{name}_{x}"}, WRONG_READING),
    Law("sensor gain", "sensor", {"{x}": "{name}_{x}"}, WRONG_READING),
    Law("sensor drift", "sensor", {"t": "{name}_{x}"}, WRONG_READING),
    Law(
        "sensor clipping",
        "sensor",
        {"min(max({x}, -clipping_{x}), clipping_{x}) - {x}": None},
        WRONG_READING,
        inner={"clipping_{x}": _tried("{x}", LIMITS, LARGEST_SHARE)},
    ),
    Law(
        "sensor delay",
        "sensor",
        {LATE_READING: None},
        "a delay of the sensor",
        inner={"sensor_delay_{x}": LAG},
        memory=READING_MEMORY,
    ),
)


def is_second_storage(effect: Effect) -> bool:
    """Whether an effect splits a storage in two.

    With half of it gone, the capacity that the model had means another thing. So a
    linearisation of the model without the effect says nothing about it: it expected
    none of a house and of a cell in which a re-fit explains 39 and 77 % of the squared
    error above the noise floor.
    """
    return effect.family == SECOND_STORAGE
