"""Effects that take energy: damping, dry friction and drag, leaks and overflow.

They are terms of R_ii(x) >= 0. The loss is R_ii dH/dx_i, so that a force c f(v) against
the velocity v has R_ii = c f(v)/v. Velocities are the efforts of momenta and flows,
levels those of storages.
"""

from collections.abc import Mapping

from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_parts import (
    LARGEST_SHARE,
    LIMITS,
    one_term,
    tried,
    underscored,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.parameters import Parameter, Share
from phsi_opt.model.structure import effort_of, flow_states

SPEED_LOSS = "a loss that grows with speed"
POSITION_DAMPING = "damping that depends on the position"
DRY_FRICTION = "dry friction"
LEVEL_LOSS = "a loss that grows with the level"
OVERFLOW = "an overflow"
FAMILIES = {
    "viscous damping": SPEED_LOSS,
    "quadratic drag": SPEED_LOSS,
    "cubic drag": SPEED_LOSS,
    "position-dependent damping": POSITION_DAMPING,
    "coulomb friction": DRY_FRICTION,
    "stribeck friction": DRY_FRICTION,
    "linear leak": LEVEL_LOSS,
    "turbulent leak": LEVEL_LOSS,
    "saturating leak": LEVEL_LOSS,
    "overflow": OVERFLOW,
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


def losses(model: BaseModel, state: str, position: str | None) -> list[Effect]:
    """The losses that the equation of a state may lack.

    Args:
        model: the model.
        state: a momentum, a flow or a storage.
        position: the position of a momentum.
    """
    if position is not None:
        damping = _loss("position-dependent damping", state, f"{position}**2")
        return [*_frictions(model, state), damping]
    if state in flow_states(model):
        return [*_frictions(model, state), *_leaks(model, state)]
    return [_loss("linear leak", state, "1"), *_leaks(model, state)]


def overflow_into(model: BaseModel, state: str, source: str) -> Effect:
    """What overflows from one storage, the source, runs into another one."""
    level = effort_of(model, source)
    inner = {"limit": tried(level, LIMITS, LARGEST_SHARE)}
    name = f"overflow_{source}_{state}"
    term = one_term(f"max({level} - limit, 0)", name, inner, lower=0.0)
    return Effect(f"overflow from {source}", "F", state, term, family=OVERFLOW)


def _loss(
    kind: str, state: str, body: str, inner: Mapping[str, Parameter] | None = None
) -> Effect:
    name = f"{underscored(kind)}_{state}"
    term = one_term(body, name, inner, lower=0.0)
    return Effect(kind, "R", state, term, family=FAMILIES[kind])


def _frictions(model: BaseModel, state: str) -> list[Effect]:
    v = effort_of(model, state)
    return [
        _loss("viscous damping", state, "1"),
        _loss("coulomb friction", state, _dry_friction(v), {"v0": _turnover(v)}),
        _loss("quadratic drag", state, f"abs({v})"),
        _loss("cubic drag", state, f"{v}**2"),
        _stribeck_friction(model, state),
    ]


def _dry_friction(v: str) -> str:
    """sign(v)/v, rounded within the turnover velocity v0."""
    return f"({v}**4 + v0**4)**(-0.25)"


def _turnover(v: str) -> Parameter:
    guess = Share(v, FRICTION_TURNOVER, SHARPER_TURNOVERS)
    return Parameter(lower=0.0, fixed=True, guess=guess)


def _stribeck_friction(model: BaseModel, state: str) -> Effect:
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
    return Effect("stribeck friction", "R", state, term, family=DRY_FRICTION)


def _leaks(model: BaseModel, state: str) -> list[Effect]:
    level = effort_of(model, state)
    laminar = Parameter(lower=0.0, fixed=True, guess=Share(level, LAMINAR_LEVEL))
    half = tried(level, HALF_LEVELS)
    limit = tried(level, LIMITS, LARGEST_SHARE)
    square_root = f"({level}**2 + e0**2)**(-0.25)"
    saturation = f"1/(1 + abs({level})/half)"
    beyond = f"max(abs({level}) - limit, 0)/max(abs({level}), limit)"
    return [
        _loss("turbulent leak", state, square_root, {"e0": laminar}),
        _loss("saturating leak", state, saturation, {"half": half}),
        _loss("overflow", state, beyond, {"limit": limit}),
    ]
