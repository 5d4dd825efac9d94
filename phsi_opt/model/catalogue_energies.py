"""Effects that store energy: springs, gravity, free play and couplings.

They are terms of H in the positions, and act as forces in the equations of the momenta;
in a model without an energy they are these forces, in the equations of the velocities.
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
from phsi_opt.model.kinds import LENGTHS, RADIANS, plain_unit
from phsi_opt.model.roles import Role, role_of

POSITION_FORCE = "a force that depends on the position"
VOLUME_PRESSURE = "a pressure that depends on the volume"
CHARGE_VOLTAGE = "a voltage that depends on the charge"
SATURATION = "a storage that saturates"
# Energies of a position q, and the forces that they make; the latter are what a model
# without an energy has.
POWERS_OF_POSITION = (
    ("{q}**2/2", "-{q}"),
    ("{q}**3/3", "-{q}**2"),
    ("{q}**4/4", "-{q}**3"),
)
STIFFNESSES = ("linear stiffness", "quadratic stiffness", "cubic stiffness")
ELASTANCES = ("linear elastance", "quadratic elastance", "cubic elastance")
COUPLINGS = {
    Role.BODY: ("coupling stiffness", "a coupling of two positions"),
    Role.PIPE: ("coupling stiffness", "a coupling of two volumes"),
    Role.COIL: ("coupling capacitance", "a coupling of two charges"),
}

# Free plays of a gap to try, as shares of the largest position.
PLAYS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9)


def energies(
    model: BaseModel, state: str, position: str | None, unit: str = ""
) -> list[Effect]:
    """The energies that a momentum and its position q may have, in their field's words.

    ::

        stiffness, elastance    c q^2/2, c q^3/3, c q^4/4
        gravity torque          -c cos(q), not of a length
        gap                     c max(|q| - play, 0)^2/2
        saturation              c x^4/4 of a coil's flux x, or of a circuit's storage

    Args:
        model: the model.
        state: the momentum, or what else may have an energy of its own.
        position: the position of a momentum.
        unit: of the position.
    """
    role = role_of(model, state)
    if role is Role.BODY and position is not None:
        return _springs_of_body(model, position, state, unit)
    if role is Role.PIPE and position is not None:
        return _powers(model, STIFFNESSES, position, state, VOLUME_PRESSURE)
    if role is Role.COIL and position is not None:
        elastances = _powers(model, ELASTANCES, position, state, CHARGE_VOLTAGE)
        if not model.has_energy:
            return elastances
        return [*elastances, _saturation("coil saturation", state)]
    if role is Role.CIRCUIT and model.has_energy:
        return [_saturation("coil or capacitor saturation", state)]
    return []


def coupling(model: BaseModel, q1: str, q2: str, p1: str) -> Effect:
    """A spring between two positions; p1 is the momentum of the first one."""
    name, family = COUPLINGS[role_of(model, p1)]
    term = one_term(f"({q1} - {q2})**2/2", f"{underscored(name)}_{q1}_{q2}")
    return Effect(name, "H", p1, term, family=family)


def _springs_of_body(model: BaseModel, q: str, p: str, unit: str) -> list[Effect]:
    """All that may hold a body at its position."""
    springs = _powers(model, STIFFNESSES, q, p, POSITION_FORCE)
    if plain_unit(unit) not in LENGTHS:
        angle = RADIANS.get(plain_unit(unit), "{q}").format(q=q)
        bodies = (f"-cos({angle})", f"-sin({angle})")
        gravity = _placed(model, "gravity torque", q, p, bodies, POSITION_FORCE)
        springs.append(gravity)
    return [*springs, _gap(model, q, p)]


def _powers(
    model: BaseModel, names: tuple[str, ...], q: str, p: str, family: str
) -> list[Effect]:
    found = []
    for name, (energy, force) in zip(names, POWERS_OF_POSITION, strict=True):
        bodies = (energy.format(q=q), force.format(q=q))
        found.append(_placed(model, name, q, p, bodies, family))
    return found


def _placed(
    model: BaseModel, name: str, q: str, p: str, bodies: tuple[str, str], family: str
) -> Effect:
    """An energy of q in H, or without one its force in the equation of p."""
    energy, force = bodies
    coefficient = f"{underscored(name)}_{q}"
    if model.has_energy:
        return Effect(name, "H", p, one_term(energy, coefficient), family=family)
    return Effect(name, "F", p, one_term(force, coefficient), family=family)


def _saturation(name: str, state: str) -> Effect:
    term = one_term(f"{state}**4/4", f"{underscored(name)}_{state}")
    return Effect(name, "H", state, term, family=SATURATION)


def _gap(model: BaseModel, q: str, p: str) -> Effect:
    """A spring with free play, to both sides."""
    inner = {"play": tried(q, PLAYS, LARGEST_SHARE)}
    body = f"max(abs({q}) - play, 0)**2/2"
    if not model.has_energy:
        body = f"-max({q} - play, 0) + max(-{q} - play, 0)"
    term = one_term(body, f"gap_{q}", inner, lower=0.0)
    slot = "H" if model.has_energy else "F"
    return Effect("gap", slot, p, term, family=POSITION_FORCE)
