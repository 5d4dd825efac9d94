"""Effects that store energy: springs, gravity, free play and couplings.

They are terms of H in the positions, and act as forces in the equations of the momenta.
"""

from phsi_opt.model.catalogue_parts import (
    LARGEST_SHARE,
    one_term,
    tried,
    underscored,
)
from phsi_opt.model.effect import Effect

POSITION_FORCE = "a force that depends on the position"
COUPLING = "a coupling of two positions"

# Free plays of a gap to try, as shares of the largest position.
PLAYS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9)


def energies(q: str, p: str) -> list[Effect]:
    """The energies that the position q of a momentum p may have."""
    return [
        _energy("linear stiffness", q, p, f"{q}**2/2"),
        _energy("quadratic stiffness", q, p, f"{q}**3/3"),
        _energy("cubic stiffness", q, p, f"{q}**4/4"),
        _energy("gravity torque", q, p, f"-cos({q})"),
        _gap(q, p),
    ]


def coupling(q1: str, q2: str, p1: str) -> Effect:
    """A spring between two positions; p1 is the momentum of the first one."""
    term = one_term(f"({q1} - {q2})**2/2", f"coupling_stiffness_{q1}_{q2}")
    return Effect("coupling stiffness", "H", p1, term, family=COUPLING)


def _energy(kind: str, q: str, p: str, body: str) -> Effect:
    term = one_term(body, f"{underscored(kind)}_{q}")
    return Effect(kind, "H", p, term, family=POSITION_FORCE)


def _gap(q: str, p: str) -> Effect:
    """A spring with free play, to both sides."""
    inner = {"play": tried(q, PLAYS, LARGEST_SHARE)}
    body = f"max(abs({q}) - play, 0)**2/2"
    term = one_term(body, f"gap_{q}", inner, lower=0.0)
    return Effect("gap", "H", p, term, family=POSITION_FORCE)
