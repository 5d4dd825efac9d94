"""Effects that take energy: damping, friction and drag, leaks, resistances, heat loss.

They are terms of R_ii(x) >= 0. The loss is R_ii dH/dx_i, so that a force c f(v) against
the velocity v has R_ii = c f(v)/v. Velocities are the efforts of momenta and flows,
levels those of storages. What passes from one storage to another is a term of F.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_parts import (
    LARGEST_SHARE,
    LIMITS,
    one_term,
    tried,
    underscored,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.kinds import ZEROS, plain_unit
from phsi_opt.model.parameters import Parameter, Share
from phsi_opt.model.roles import WORDS, Role, role_of
from phsi_opt.model.structure import effort_of

DRY_FRICTION = "dry friction"
VOLTAGE_DROP = "a constant voltage drop"
OVERFLOW = "an overflow"
HEAT_EXCHANGE = "an exchange of heat"
RADIATION = "radiation"
# What a role's losses are called, and their laws: the loss is c e for the linear one of
# the effort e, c |e| e for the quadratic, c e^3 for the cubic and c |e|^3 e for the
# quartic one; the others see `losses`. Of one equation no law has two names.
LAWS: Mapping[Role, Mapping[str, str]] = {
    Role.BODY: {
        "viscous damping": "linear",
        "coulomb friction": "dry",
        "quadratic drag": "quadratic",
        "cubic drag": "cubic",
        "stribeck friction": "stribeck",
    },
    Role.PIPE: {
        "laminar pipe friction": "linear",
        "turbulent pipe friction": "quadratic",
    },
    Role.TANK: {
        "linear leak": "linear",
        "quadratic leak": "quadratic",
        "turbulent leak": "square root",
        "saturating leak": "saturating",
        "overflow": "overflow",
    },
    Role.COIL: {
        "linear resistance": "linear",
        "contact voltage drop": "dry",
        "quadratic resistance": "quadratic",
    },
    Role.CAPACITOR: {
        "leakage conductance": "linear",
        "quadratic conductance": "quadratic",
    },
    Role.CIRCUIT: {
        "linear resistance": "linear",
        "contact voltage drop": "dry",
        "quadratic resistance": "quadratic",
    },
    Role.HEAT: {
        "heat loss": "linear",
        "quadratic heat loss": "quadratic",
        RADIATION: "quartic",
    },
    Role.UNKNOWN: {
        "linear leak": "linear",
        "coulomb friction": "dry",
        "quadratic drag": "quadratic",
        "cubic drag": "cubic",
        "stribeck friction": "stribeck",
        "turbulent leak": "square root",
        "saturating leak": "saturating",
        "overflow": "overflow",
    },
}
# Damping that depends on the position of a pair, by the role of the momentum.
POSITION_DAMPING = {
    Role.BODY: ("position-dependent damping", "damping that depends on the position"),
    Role.COIL: ("charge-dependent resistance", "a resistance that depends on a charge"),
}

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


def losses(
    model: BaseModel, state: str, position: str | None, unit: str = ""
) -> list[Effect]:
    """The losses that the equation of a state may lack, in the words of its field.

    ::

        dry            c sign(e), rounded
        stribeck       (c + s exp(-(e/v_s)^2)) sign(e), rounded
        square root    c sign(e) sqrt(|e|), linear below a small level
        saturating     c e/(1 + |e|/half)
        overflow       c sign(e) max(|e| - limit, 0)
        quartic        c |e|^3 e; of a temperature from the zero of its scale, which is
                       at z degrees: c ((e + z)^4 - z^4)

    Args:
        model: the model.
        state: in whose equation they act.
        position: the position of a momentum.
        unit: of the state.
    """
    role = role_of(model, state)
    zero = ZEROS.get(plain_unit(unit), 0.0)
    found = []
    for name, law in LAWS[role].items():
        if law == "stribeck":
            found.append(_stribeck_friction(model, state, name))
        elif law == "quartic" and zero:
            # The effort of a model with an energy is not in the unit of the state.
            if not model.has_energy:
                found.append(
                    _loss(name, state, _radiation(state, zero), _family(role, law))
                )
        else:
            body = _body(law, effort_of(model, state))
            found.append(_loss(name, state, body, _family(role, law)))
    if position is not None and role in POSITION_DAMPING:
        name, family = POSITION_DAMPING[role]
        found.append(_loss(name, state, _Body(f"{position}**2"), family))
    return found


def overflow_into(model: BaseModel, state: str, source: str) -> Effect:
    """What overflows from one storage, the source, runs into another one."""
    level = effort_of(model, source)
    inner = {"limit": tried(level, LIMITS, LARGEST_SHARE)}
    name = f"overflow_{source}_{state}"
    term = one_term(f"max({level} - limit, 0)", name, inner, lower=0.0)
    return Effect(f"overflow from {source}", "F", state, term, family=OVERFLOW)


def heat_from(model: BaseModel, state: str, source: str) -> Effect:
    """The heat that a storage takes from a source of the temperature T_s: c (T_s - T).

    The source is another storage, or an input such as the surroundings. What a storage
    loses by it is an effect of its own in the source's equation.
    """
    T_s = source if source in model.inputs else effort_of(model, source)
    difference = f"{T_s} - {effort_of(model, state)}"
    term = one_term(difference, f"heat_exchange_{source}_{state}", lower=0.0)
    name = f"heat exchange with {source}"
    return Effect(name, "F", state, term, family=HEAT_EXCHANGE)


@dataclass(frozen=True)
class _Body:
    """R_ii = loss/effort as text, with its inner parameters."""

    text: str
    inner: Mapping[str, Parameter] = field(default_factory=dict)


def _loss(name: str, state: str, body: _Body, family: str) -> Effect:
    coefficient = f"{underscored(name)}_{state}"
    term = one_term(body.text, coefficient, body.inner, lower=0.0)
    return Effect(name, "R", state, term, family=family)


def _family(role: Role, law: str) -> str:
    if law == "overflow":
        return OVERFLOW
    if law == "dry":
        is_electrical = role in (Role.COIL, Role.CIRCUIT)
        return VOLTAGE_DROP if is_electrical else DRY_FRICTION
    return f"a loss that grows with {WORDS[role].grows_with}"


def _body(law: str, e: str) -> _Body:
    """The body of a law in the effort e."""
    if law == "dry":
        return _Body(_dry_friction(e), {"v0": _turnover(e)})
    if law == "square root":
        laminar = Parameter(lower=0.0, fixed=True, guess=Share(e, LAMINAR_LEVEL))
        return _Body(f"({e}**2 + e0**2)**(-0.25)", {"e0": laminar})
    if law == "saturating":
        half = tried(e, HALF_LEVELS)
        return _Body(f"1/(1 + abs({e})/half)", {"half": half})
    if law == "overflow":
        limit = tried(e, LIMITS, LARGEST_SHARE)
        beyond = f"max(abs({e}) - limit, 0)/max(abs({e}), limit)"
        return _Body(beyond, {"limit": limit})
    powers = {
        "linear": "1",
        "quadratic": f"abs({e})",
        "cubic": f"{e}**2",
        "quartic": f"abs({e})**3",
    }
    return _Body(powers[law])


def _radiation(T: str, zero: float) -> _Body:
    """((T + z)^4 - z^4)/T multiplied out; the zero of the scale is at z degrees."""
    powers = (f"{T}**3", f"{4 * zero:.8g}*{T}**2", f"{6 * zero**2:.10g}*{T}")
    return _Body(" + ".join((*powers, f"{4 * zero**3:.12g}")))


def _dry_friction(v: str) -> str:
    """sign(v)/v, rounded within the turnover velocity v0."""
    return f"({v}**4 + v0**4)**(-0.25)"


def _turnover(v: str) -> Parameter:
    guess = Share(v, FRICTION_TURNOVER, SHARPER_TURNOVERS)
    return Parameter(lower=0.0, fixed=True, guess=guess)


def _stribeck_friction(model: BaseModel, state: str, name: str) -> Effect:
    """Dry friction that is larger at low speed: f_c + f_s exp(-(v/v_s)^2).

    Where the model has the level f_c already, only the rest is added.
    """
    v = effort_of(model, state)
    dry = _dry_friction(v)
    turnover = _turnover(v)
    speed = tried(v, STRIBECK_SPEEDS, LARGEST_STRIBECK_SPEED)
    rise = one_term(
        f"{dry}*exp(-({v}/v_s)**2)",
        f"stribeck_friction_{state}",
        {"v0": turnover, "v_s": speed},
        lower=0.0,
    )
    level = one_term(dry, f"coulomb_friction_{state}", {"v0": turnover}, lower=0.0)
    known = {term.body for term in model.terms_at("R", state)}
    term = rise if dry in known else level + rise
    return Effect(name, "R", state, term, family=DRY_FRICTION)
