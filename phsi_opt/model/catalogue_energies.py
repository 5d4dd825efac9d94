"""Effects that store energy: springs, gravity, free play and couplings.

They are terms of H in the positions, and act as forces in the equations of the momenta.
A coil or a capacitor that saturates has a term in its own state.
"""

from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_parts import (
    LARGEST_SHARE,
    one_term,
    tried,
    underscored,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.roles import Role, role_of

POSITION_FORCE = "a force that depends on the position"
VOLUME_PRESSURE = "a pressure that depends on the volume"
CHARGE_VOLTAGE = "a voltage that depends on the charge"
SATURATION = "a storage that saturates"
# Energies of a position q, by the role of its momentum.
POWERS_OF_POSITION = ("{q}**2/2", "{q}**3/3", "{q}**4/4")
STIFFNESSES = ("linear stiffness", "quadratic stiffness", "cubic stiffness")
ELASTANCES = ("linear elastance", "quadratic elastance", "cubic elastance")
COUPLINGS = {
    Role.BODY: ("coupling stiffness", "a coupling of two positions"),
    Role.PIPE: ("coupling stiffness", "a coupling of two volumes"),
    Role.COIL: ("coupling capacitance", "a coupling of two charges"),
}

# Free plays of a gap to try, as shares of the largest position.
PLAYS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9)


def energies(model: BaseModel, state: str, position: str | None) -> list[Effect]:
    """The energies that a momentum and its position q may have, in their field's words.

    ::

        stiffness, elastance    c q^2/2, c q^3/3, c q^4/4
        gravity torque          -c cos(q)
        gap                     c max(|q| - play, 0)^2/2
        saturation              c x^4/4 of a coil's flux x, or of a circuit's storage

    """
    role = role_of(model, state)
    if role is Role.BODY and position is not None:
        stiffnesses = _springs(STIFFNESSES, position, state, POSITION_FORCE)
        gravity = _energy("gravity torque", position, state, f"-cos({position})")
        return [*stiffnesses, gravity, _gap(position, state)]
    if role is Role.PIPE and position is not None:
        return _springs(STIFFNESSES, position, state, VOLUME_PRESSURE)
    if role is Role.COIL and position is not None:
        elastances = _springs(ELASTANCES, position, state, CHARGE_VOLTAGE)
        return [*elastances, _saturation("coil saturation", state)]
    if role is Role.CIRCUIT and model.has_energy:
        return [_saturation("coil or capacitor saturation", state)]
    return []


def coupling(model: BaseModel, q1: str, q2: str, p1: str) -> Effect:
    """A spring between two positions; p1 is the momentum of the first one."""
    name, family = COUPLINGS[role_of(model, p1)]
    term = one_term(f"({q1} - {q2})**2/2", f"{underscored(name)}_{q1}_{q2}")
    return Effect(name, "H", p1, term, family=family)


def _springs(names: tuple[str, ...], q: str, p: str, family: str) -> list[Effect]:
    found = []
    for name, power in zip(names, POWERS_OF_POSITION, strict=True):
        found.append(_energy(name, q, p, power.format(q=q), family))
    return found


def _saturation(name: str, state: str) -> Effect:
    return _energy(name, state, state, f"{state}**4/4", SATURATION)


def _energy(
    name: str, of: str, equation: str, body: str, family: str = POSITION_FORCE
) -> Effect:
    term = one_term(body, f"{underscored(name)}_{of}")
    return Effect(name, "H", equation, term, family=family)


def _gap(q: str, p: str) -> Effect:
    """A spring with free play, to both sides."""
    inner = {"play": tried(q, PLAYS, LARGEST_SHARE)}
    body = f"max(abs({q}) - play, 0)**2/2"
    term = one_term(body, f"gap_{q}", inner, lower=0.0)
    return Effect("gap", "H", p, term, family=POSITION_FORCE)
