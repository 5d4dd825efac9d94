"""The gallery: base models to begin with, as drafts that a user goes on to change.

What only a balance can tell (a mass, an inertia, an inductance) is a known value there,
since positions alone do not show it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from phsi_opt.page.drafts import (
    ENERGY,
    FIRST_ORDER,
    ModelDraft,
    ParameterDraft,
)


@dataclass(frozen=True)
class BaseModel:
    """One entry of the gallery.

    Attributes:
        title: such as "Spring".
        about: what it is, in a sentence.
        draft: as a fresh draft has it.
        units: of its states.
        driven: the equations in which an input acts, and how: ``{u}`` is its name.
        driven_parameters: parameters that come with an input.
    """

    title: str
    about: str
    draft: ModelDraft
    units: Mapping[str, str]
    driven: Mapping[str, str] = field(default_factory=dict)
    driven_parameters: tuple[ParameterDraft, ...] = ()

    def drafted(self, inputs: Sequence[str] = ()) -> ModelDraft:
        """A fresh draft; the first of the inputs acts in the driven equations."""
        base = self.draft
        draft = ModelDraft(
            self.title,
            base.type,
            base.states,
            ", ".join(inputs),
            base.pairs,
            base.H,
            dict(base.R),
            dict(base.F),
            [copied(one) for one in base.parameters],
            dict(base.further),
        )
        if inputs:
            for state, formula in self.driven.items():
                force = formula.format(u=inputs[0])
                known = draft.F.get(state, "")
                draft.F[state] = f"{known} + {force}" if known else force
            draft.parameters += [copied(one) for one in self.driven_parameters]
        return draft


def copied(one: ParameterDraft) -> ParameterDraft:
    """The same parameter as a draft of its own."""
    return ParameterDraft(
        one.name,
        one.value,
        one.is_known,
        one.lower,
        one.upper,
        one.unit,
        one.is_assumed,
    )


def _free(name: str, start: str, unit: str = "") -> ParameterDraft:
    """A positive number that is estimated."""
    return ParameterDraft(name, start, lower="0", unit=unit)


def _known(name: str, value: str, unit: str = "") -> ParameterDraft:
    return ParameterDraft(name, value, is_known=True, unit=unit, is_assumed=True)


SPRING = BaseModel(
    "Spring",
    "A mass on a spring, with viscous damping.",
    ModelDraft(
        type=ENERGY,
        states="q, p",
        pairs="q-p",
        H="k*q**2/2 + p**2/(2*m)",
        R={"p": "c"},
        parameters=[
            _free("k", "10", "N/m"),
            _known("m", "1", "kg"),
            _free("c", "", "N s/m"),
        ],
    ),
    {"q": "m", "p": "kg m/s"},
    {"p": "{u}"},
)
PENDULUM = BaseModel(
    "Pendulum",
    "A body that swings under gravity, with viscous damping in the bearing.",
    ModelDraft(
        type=ENERGY,
        states="q, p",
        pairs="q-p",
        H="p**2/(2*J) + g*(1 - cos(q))",
        R={"p": "c"},
        parameters=[
            _known("J", "1", "kg m2"),
            _free("g", "10", "N m"),
            _free("c", "", "N m s"),
        ],
    ),
    {"q": "rad", "p": "kg m2/s"},
    {"p": "{u}"},
)
TWO_MASSES = BaseModel(
    "Two masses",
    "Two masses in a row: wall, spring, mass, spring, mass.",
    ModelDraft(
        type=ENERGY,
        states="q1, q2, p1, p2",
        pairs="q1-p1, q2-p2",
        H="k1*q1**2/2 + k2*(q2 - q1)**2/2 + p1**2/(2*m1) + p2**2/(2*m2)",
        R={"p1": "c1", "p2": "c2"},
        parameters=[
            _free("k1", "10", "N/m"),
            _free("k2", "10", "N/m"),
            _known("m1", "1", "kg"),
            _known("m2", "1", "kg"),
            _free("c1", "", "N s/m"),
            _free("c2", "", "N s/m"),
        ],
    ),
    {"q1": "m", "q2": "m", "p1": "kg m/s", "p2": "kg m/s"},
    {"p2": "{u}"},
)
TANKS = BaseModel(
    "Tanks",
    "Two tanks in a row; each empties in proportion to its level.",
    ModelDraft(
        type=FIRST_ORDER,
        states="h1, h2",
        F={"h1": "-a1*h1", "h2": "a2*h1 - a3*h2"},
        parameters=[_free("a1", "0.1"), _free("a2", "0.1"), _free("a3", "0.1")],
        further={"kind": "hydraulic"},
    ),
    {"h1": "m", "h2": "m"},
    {"h1": "b*{u}"},
    (_free("b", "1"),),
)
RLC = BaseModel(
    "RLC circuit",
    "Capacitor, coil and resistor in one loop.",
    ModelDraft(
        type=ENERGY,
        states="q, phi",
        pairs="q-phi",
        H="q**2/(2*C) + phi**2/(2*L)",
        R={"phi": "Rs"},
        parameters=[
            _free("C", "1", "F"),
            _known("L", "1", "H"),
            _free("Rs", "", "Ohm"),
        ],
        further={"kind": "electrical"},
    ),
    {"q": "C", "phi": "Wb"},
    {"phi": "{u}"},
)
THERMAL_NETWORK = BaseModel(
    "Thermal network",
    "A room and its walls, which lose heat to surroundings of one temperature.",
    ModelDraft(
        type=FIRST_ORDER,
        states="Ti, Tw",
        F={"Ti": "a1*(Tw - Ti)", "Tw": "a2*(Ti - Tw) + a3*(Ta - Tw)"},
        parameters=[
            _free("a1", "0.1"),
            _free("a2", "0.1"),
            _free("a3", "0.1"),
            ParameterDraft("Ta", "20", unit="degC"),
        ],
        further={"kind": "thermal"},
    ),
    {"Ti": "degC", "Tw": "degC"},
    {"Ti": "b*{u}"},
    (_free("b", "1"),),
)
GALLERY = (SPRING, PENDULUM, TWO_MASSES, TANKS, RLC, THERMAL_NETWORK)
