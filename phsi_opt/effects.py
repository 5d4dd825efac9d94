"""The catalogue of physical effects: a named phenomenon is a term in a slot of an equation."""

from dataclasses import dataclass

import numpy as np

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.missing import forced_rows, positions
from phsi_opt.model import FirstOrder, Model
from phsi_opt.terms import Dictionary, Parameter, Scan, Share, Term

# Dry friction turns over within this share of the typical velocity: sharp beside the motion, smooth for the solver. The
# fourth powers make its plateau flat, so that the share costs no friction at the velocities beyond it.
TURNOVER = 0.06


@dataclass(frozen=True)
class Effect:
    """A named effect: ``term`` acts in ``slot`` ('H', 'R' or 'F') of ``equation`` (a state)."""

    name: str
    slot: str
    equation: str
    term: Dictionary

    def __post_init__(self) -> None:
        if self.slot not in ("H", "R", "F"):
            raise ModelError(f"effect {self.name!r}: slot {self.slot!r} is unknown; expected 'H', 'R' or 'F'.")
        if not isinstance(self.term, Dictionary) or not self.term.terms:
            raise ModelError(f"effect {self.name!r} has no term; write it with formula(...) or polynomials(...).")

    def __str__(self) -> str:
        return f"{self.name} on {self.equation}"


def catalogue(model: Model) -> list[Effect]:
    """The effects that apply to the model, each with the slot and equation it acts in; those it has are left out."""
    effects: list[Effect] = []
    moved_by = _position_of(model)
    for i in forced_rows(model):
        name = model.states[i]
        effects += _losses(model, name) + _forces(name, model)
        if name in moved_by:
            effects += _energies(moved_by[name], name)
    return [effect for effect in effects if not _is_in(model, effect)]


def effect_named(model: Model, name: str, equation: str) -> Effect:
    """The catalogue's effect of that name on that equation; raises `ModelError` with the nearest name otherwise."""
    model.index(equation, f"equation of effect {name!r}:")
    listed = catalogue(model)
    for effect in listed:
        if effect.name == name and effect.equation == equation:
            return effect
    names = sorted({effect.name for effect in listed if effect.equation == equation})
    raise ModelError(
        f"effect {name!r} on {equation!r} is not in the catalogue of this model (or the model has it already); "
        f"available there: {', '.join(names)}.{did_you_mean(name, names)}"
    )


def _position_of(model: Model) -> dict[str, str]:
    """Position q of each momentum p of a canonical pair."""
    found = {}
    for i in positions(model):
        (j,) = (j for j, s in enumerate(model.S[i]) if s)
        found[model.states[j]] = model.states[i]
    return found


def _losses(model: Model, name: str) -> list[Effect]:
    effort = name if isinstance(model, FirstOrder) else f"dH_d{name}"
    turnover = Parameter(None, lower=0.0, fixed=True, guess=Share(effort, TURNOVER))
    dry = f"({effort}**4 + v0**4)**(-0.25)"

    def loss(kind: str, body: str, inner: dict[str, Parameter] | None = None) -> Effect:
        term = Term(body, Parameter(None, lower=0.0), inner or {}, f"{kind.replace(' ', '_')}_{name}")
        return Effect(kind, "R", name, Dictionary((term,)))

    return [
        loss("viscous damping", "1"),
        loss("coulomb friction", dry, {"v0": turnover}),
        loss("quadratic drag", f"abs({effort})"),
    ]


def _energies(q: str, p: str) -> list[Effect]:
    def energy(kind: str, body: str) -> Effect:
        return Effect(kind, "H", p, Dictionary((Term(body, Parameter(), {}, f"{kind.replace(' ', '_')}_{q}"),)))

    return [
        energy("linear stiffness", f"{q}**2/2"),
        energy("quadratic stiffness", f"{q}**3/3"),
        energy("cubic stiffness", f"{q}**4/4"),
        energy("gravity torque", f"-cos({q})"),
    ]


def _forces(p: str, model: Model) -> list[Effect]:
    omega = "omega"
    while f"F_{p}.{omega}" in model.entries:
        omega += "_"
    inner = {omega: Parameter(None, lower=0.0, unit="rad/s", guess=Scan("t"))}
    waves = tuple(Term(f"{wave}({omega}*t)", Parameter(), inner) for wave in ("sin", "cos"))
    return [
        Effect("constant force", "F", p, Dictionary((Term("1", Parameter(), {}, f"constant_force_{p}"),))),
        Effect("harmonic force", "F", p, Dictionary(waves)),
    ]


def _is_in(model: Model, effect: Effect) -> bool:
    """Whether the model can do already what the effect does: a term of the same body, or the same change of dx/dt."""
    terms = model.H if effect.slot == "H" else getattr(model, effect.slot).get(effect.equation, Dictionary())
    bodies = {term.body for term in terms}
    if any(term.body in bodies or term.name in model.entries for term in effect.term):
        return True
    scanned = any(isinstance(p.guess, Scan) for term in effect.term for p in term.inner.values())
    return bool(model.free) and not scanned and _is_spanned(model, effect)


def _is_spanned(model: Model, effect: Effect) -> bool:
    """Whether the slope of dx/dt in the effect's coefficient is a sum of slopes in the model's own parameters.

    Looked at in random states and at random parameter values (fixed seed): an identity holds in all of them.
    """
    larger = model.add(effect)
    rng = np.random.default_rng(0)
    slopes = larger.rhs().jacobian()
    # The same values for the whole test: the model's parameters must explain the effect at one point of theta.
    theta = np.array([model.values.get(n) or rng.uniform(0.5, 1.5) for n in larger.free])
    rows = []
    for _ in range(4 * len(theta) + 20):
        x, u, t = rng.normal(size=model.n_states), rng.normal(size=model.n_inputs), rng.uniform(0, 3)
        rows.append(np.array(slopes(x, u, t, theta, np.zeros(model.n_states))[3]))
    columns = np.nan_to_num(np.vstack(rows))
    new = [i for i, name in enumerate(larger.free) if name not in model.entries]
    own = columns[:, [i for i in range(len(theta)) if i not in new]]
    left = columns[:, new] - own @ np.linalg.lstsq(own, columns[:, new], rcond=None)[0]
    return bool(np.linalg.norm(left) < 1e-8 * np.linalg.norm(columns[:, new]))
