"""The catalogue of physical effects: those that apply to a model, by name.

An effect is a term in a slot of an equation. The tables of ``laws`` write them down;
here their names are filled in for each equation of a model. What a model can do already
is left out.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import chain, combinations, permutations, product
from typing import Any

from phsi_opt.arguments import require_known, typed
from phsi_opt.errors import ModelError, did_you_mean, some_of
from phsi_opt.model.base import BaseModel
from phsi_opt.model.directions import normal_direction
from phsi_opt.model.effect import Effect, EffectList
from phsi_opt.model.expressions import divisors, names_of
from phsi_opt.model.functions import NAME, function_named
from phsi_opt.model.kinds import KINDS, RADIANS, ZEROS
from phsi_opt.model.laws import LAWS, STORAGES, Law, law_of
from phsi_opt.model.parameter_units import drive_of, parameter_units, state_units
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import place_of
from phsi_opt.model.structure import (
    Role,
    effort_of,
    forced_rows,
    kind_of,
    position_of_momentum,
    role_of,
    storage_states,
    with_kinds_of_units,
)
from phsi_opt.model.symbolic import is_redundant, stands_in
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.presentation.units import are_alike, rate_unit


@typed
def catalogue(
    model: BaseModel, units: Mapping[str, str] | None = None, called: str = ""
) -> EffectList:
    """The effects that apply to the model, each with its slot and equation.

    The list prints as a table.

    Effects that the model contains or can represent are omitted. The kind of a state
    decides which effects are offered, and their names; if it is unknown, losses have
    the names that are usual for bodies and tanks, each law once.

    Args:
        model: the model.
        units: of its states, as `Measurements.units`; they determine kinds that the
            model does not give, and which mass or capacity divides effects.
        called: only the effects of this name, or of this other name, such as "air drag"
            for quadratic drag; default: all.

    Examples:
        >>> effects = ph.catalogue(model, data.units)
        >>> [effect.name for effect in effects][:3]
        ['coulomb friction', 'quadratic drag', 'cubic drag']
        >>> ph.catalogue(model, data.units, called="air drag")[0]
        Effect('quadratic drag on p')
    """
    offered = EffectList(effect for effect, _ in effects_told(model, units))
    return EffectList(_called(called, None, offered)) if called else offered


def effects_told(
    model: BaseModel, units: Mapping[str, str] | None = None
) -> Iterator[tuple[Effect, str]]:
    """The effects of the catalogue, each with what it adds, in the model's names."""
    units = units or {}
    known = with_kinds_of_units(model, units)
    inertias = dict.fromkeys(model.states, "")
    if not model.has_energy:
        for x in model.states:
            inertias[x] = inertia_of(model, x, units)
    for laws, names in _places(known, units):
        names = {"inertia": inertias[names["x"]], **names}
        role = role_of(known, names["x"])
        for law in laws:
            is_of_role = not law.roles or role in law.roles
            effect = law.effect(known, names) if is_of_role else None
            if effect is not None and not is_redundant(known, effect):
                adds = law.adds.format_map(names)
                over_inertia = f"/{names['inertia']}"
                if effect.term.terms[-1].body.endswith(over_inertia):
                    adds = (f"({adds})" if " + " in adds else adds) + over_inertia
                yield effect, adds


def every_name(model: BaseModel, units: Mapping[str, str] | None = None) -> EffectList:
    """The effects of the catalogue under the names of all kinds, the model's first.

    One term may stand there under several names. What the units rule out comes last: by
    its name it may still be meant.
    """
    found = catalogue(model, units)
    known = set(map(str, found))
    kinds: tuple[Any, ...] = ({}, *KINDS)
    others = [catalogue(replace(model, kind=kind), units) for kind in kinds]
    for effect in chain(*others, catalogue(model)):
        if str(effect) not in known:
            known.add(str(effect))
            found.append(effect)
    return found


def effect_named(
    model: BaseModel,
    name: str,
    equation: str | None = None,
    units: Mapping[str, str] | None = None,
) -> Effect:
    """The catalogue's effect of that name."""
    own = catalogue(model, units)
    before, _, place = name.rpartition(" on ")
    is_function = NAME.fullmatch(before) is not None
    if equation is None and before and (place in model.states or is_function):
        name, equation = before, place
    if equation is not None and (function := function_named(model, name, equation)):
        return function
    if equation is not None and equation not in [one.equation for one in own]:
        model.index(equation, f"equation of effect {name!r}:")
    found = _called(name, equation, own)
    found = found or _called(name, equation, every_name(model, units))
    if not found:
        raise ModelError(_not_in_catalogue(model, name, equation, own))
    names = list(dict.fromkeys(effect.name for effect in found))
    if len(names) > 1:
        raise ModelError(f"{name!r} may be {' or '.join(names)}; say which.")
    if len(found) > 1 and equation is None:
        equations = ", ".join(effect.equation for effect in found)
        raise ModelError(
            f"effect {name!r} can act in several equations: {equations}; "
            f"say which, such as {str(found[0])!r}."
        )
    return found[0]


def _called(name: str, equation: str | None, effects: list[Effect]) -> list[Effect]:
    """Those of a name, or else those called so, in an equation or in any."""
    asked = name.lower()
    there = [one for one in effects if equation in (None, one.equation)]
    named = [one for one in there if one.name.lower() == asked]
    return named or [one for one in there if asked in law_of(one.name).others]


def _not_in_catalogue(
    model: BaseModel, name: str, equation: str | None, own: list[Effect]
) -> str:
    place = "" if equation is None else f" on {equation}"
    # Whether it would be offered if the model had neither losses nor forces.
    bare = replace(model, F={}, R={})
    if _called(name, equation, every_name(bare)):
        return (
            f"the model has {name!r}{place} already, or terms that can represent it; "
            "choose another effect."
        )
    there = [one for one in own if equation in (None, one.equation)]
    elsewhere = [one.equation for one in _called(name, None, own)]
    hint = f" It can act on {some_of(elsewhere)}." if elsewhere else _hint(name, there)
    return (
        f"there is no effect {name!r}{place} in the catalogue.{hint} "
        "ph.catalogue(model), or phsi-opt effects, lists all."
    )


def _hint(name: str, effects: Sequence[Effect]) -> str:
    """Effects of a like name, or with a word in common in one of their names."""
    names = {
        one.name: " ".join((one.name, *law_of(one.name).others)) for one in effects
    }
    alike = get_close_matches(name.lower(), names, 1, 0.85)  # a misspelt name
    asked = set(name.lower().split())
    if not alike:
        alike = [known for known, words in names.items() if asked & set(words.split())]
    quoted = " or ".join(map(repr, alike[:4]))
    return f" Did you mean {quoted}?" if alike else did_you_mean(name, names)


def inertia_of(model: BaseModel, x: str, units: Mapping[str, str]) -> str:
    """What the equation of x divides forces by, such as its mass; "": it tells none."""
    drive = drive_of(state_units(model, units)[x])
    texts = [divisors(term.body) for term in model.terms_at("F", x)]
    shared = set(model.names_in_formulas)
    for divisor in dict.fromkeys(chain.from_iterable(texts)) if drive else ():
        if names_of(divisor) <= shared:  # no state, no input
            inertia = f"({divisor})" if " " in divisor else divisor
            force = Dictionary((Term(f"1/{inertia}", Parameter(), name="force"),))
            pushed = model.add(Effect("force", "F", x, force))
            if parameter_units(pushed, units)["force"] == drive:
                return inertia
    return ""


def lacking_quantity(
    model: BaseModel, x: str, units: Mapping[str, str], inertia: str
) -> str:
    """What is missing in the equation of x: a force, a voltage, a flow per capacity.

    It follows from the role of x and, where several are possible, from the unit of what
    drives it; a plain "term" for others.
    """
    known = with_kinds_of_units(model, units)
    unit = state_units(known, units)[x]
    drive = drive_of(unit) or rate_unit(unit, units.get("t", ""))
    role = role_of(known, x)
    *_, per, found = role.value
    if role is Role.BODY and drive == "N m":
        found = "torque"
    elif role is Role.CIRCUIT:
        alike = {"V": Role.COIL, "A": Role.CAPACITOR}.get(drive, role)
        *_, per, found = alike.value
    if found and not inertia and _has_rates(known, x, units):
        return f"{found} per {per}"
    return found or "term"


def _has_rates(model: BaseModel, x: str, units: Mapping[str, str]) -> bool:
    """Whether the equation of x is one of a rate, whatever forces are divided by."""
    return not model.has_energy and bool(drive_of(state_units(model, units)[x]))


def inertia_words(model: BaseModel, effect: Effect, units: Mapping[str, str]) -> str:
    """Such as ", per inertia", where the size is no force but a rate."""
    term = effect.term.terms[-1]
    is_rate = effect.slot in "RF" and term.coefficient is not None
    if not is_rate or names_of(term.body) & set(model.variables.slopes):
        return ""
    known = with_kinds_of_units(model, units)
    x = known.states[known.rows(effect.equation)[0]]
    if not _has_rates(known, x, units) or inertia_of(known, x, units):
        return ""
    return f", per {role_of(known, x).value[3]}"


def _places(
    model: BaseModel, units: Mapping[str, str]
) -> Iterator[tuple[Sequence[Law], dict[str, str]]]:
    """Laws that may be offered, and their names, place by place."""
    for row in forced_rows(model):
        names = _names(model, model.states[row], units)
        yield (*LAWS["losses"], *LAWS["forces"]), names
        for u in model.inputs:
            yield LAWS["inputs"], names | _names_of_input(model, u, names)
        yield (*LAWS["energies"], *LAWS["lasting"]), names
    for source, x in permutations(storage_states(model), 2):
        names = _names_of_source(model, source, x)
        yield LAWS["overflows"], names
        ratio = {"along": f"{x} - ratio*{source}", "ratio": "ratio", "inertia": ""}
        yield LAWS["spills"], names | ratio
    for source, x in permutations(model.states, 2):
        if role_of(model, source) is Role.HEAT:
            yield LAWS["heat exchanges"], _names_of_source(model, source, x)
    for source, x in product(model.inputs, model.states):
        unit = units.get(source, "")
        if not unit or are_alike(unit, "K"):
            yield LAWS["heat exchanges"], _names_of_source(model, source, x)
    for (p1, q1), (p2, q2) in combinations(position_of_momentum(model).items(), 2):
        # Without an energy the masses of the two may be anything.
        if kind_of(model, p1) == kind_of(model, p2):
            yield LAWS["energies"], {"x": p1, "q1": q1, "q2": q2}
    forced = [model.states[row] for row in forced_rows(model)]
    for x1, x2 in combinations(forced, 2):
        if role_of(model, x1) is role_of(model, x2):
            names = _names_between(model, x1, x2, units)
            yield LAWS["between"], names
            if model.has_energy:
                along = f"dH_d{x2}*{x1} - dH_d{x1}*{x2}"
                yield LAWS["exchanges"], names | {"along": along}
    for x in model.states:
        if x not in model.memory:
            yield LAWS["sensors"], {"x": x}


def _names(model: BaseModel, x: str, units: Mapping[str, str]) -> dict[str, str]:
    """The names of the laws in the equation of x, see ``laws``."""
    source, grows_with, place, *_ = role_of(model, x).value
    article = "an" if source[0] in "aeiou" else "a"
    e = effort_of(model, x)
    omega = "omega"  # of a wave, that is not taken
    while f"{place_of('F', x)}.{omega}" in model.entries:
        omega += "_"
    names = {
        "x": x,
        "own": x,
        "e": e,
        "level": e,
        "omega": omega,
        "source": source,
        "a_source": f"{article} {source}",
        "grows_with": grows_with,
        "place": place,
    }
    zero = ZEROS.get(units.get(x, ""), 0.0)
    if not zero:
        names["radiation"] = f"abs({e})**3"
    elif not model.has_energy:  # else the effort is not in the unit of the state
        # ((x + z)^4 - z^4)/x multiplied out; the zero of the scale is at z degrees.
        powers = (f"{x}**3", f"{4 * zero:.8g}*{x}**2", f"{6 * zero**2:.10g}*{x}")
        names["radiation"] = " + ".join((*powers, f"{4 * zero**3:.12g}"))
    position = position_of_momentum(model).get(x)
    if position is not None:
        names["q"] = position
        unit = units.get(position, "")
        if not are_alike(unit, "m"):
            names["angle"] = RADIANS.get(unit, "{q}").format(q=position)
    return names


def _names_of_input(
    model: BaseModel, u: str, names: Mapping[str, str]
) -> dict[str, str]:
    """The further names of the laws between an input and its force."""
    size = "an error in the size of the input"
    terms = model.terms_at("F", names["x"])
    is_used = any(u in names_of(term.body) for term in terms)
    return {
        "u": u,
        "of_u": "" if len(model.inputs) == 1 else f" of {u}",
        "input_size": f"{size}'s force" if names["source"] == "force" else size,
        "dF": f"dF/d{u} " if is_used else "",
        **({"slope": f"dF_d{u}"} if is_used else {"new": u}),
    }


def _names_of_source(model: BaseModel, source: str, x: str) -> dict[str, str]:
    """The names of a law by which x gets something from a storage or an input."""
    s_e = source if source in model.inputs else effort_of(model, source)
    return {"x": x, "e": effort_of(model, x), "s": source, "s_e": s_e, "level": s_e}


def _names_between(
    model: BaseModel, x1: str, x2: str, units: Mapping[str, str]
) -> dict[str, str]:
    """The names of a law between two states.

    Without an energy, what it adds is divided by what each equation divides forces by;
    where one does not tell, their ratio is to be found.
    """
    difference = f"({effort_of(model, x1)} - {effort_of(model, x2)})"
    names = {"x": x1, "x1": x1, "x2": x2, "e": difference, "inertia": ""}
    along = f"{x1} - {x2}"
    if not model.has_energy:
        first, second = (inertia_of(model, x, units) for x in (x1, x2))
        along = f"{x1}/{first} - {x2}/{second}"
        if not (first and second):
            names["ratio"] = "ratio"
            along = f"{x1} - ratio*{x2}"
    return names | {"along": normal_direction(along, model.states)}


Given = Sequence[Effect | str]
EFFECT_KINDS = ("catalogue", "couplings", "functions", "storages")


def effect_kind(effect: Effect) -> str:
    """The kind of an effect, one of `EFFECT_KINDS`."""
    if NAME.fullmatch(effect.name):
        return "functions"
    if not effect.equation.isidentifier():
        return "couplings"
    return "storages" if effect.family in STORAGES else "catalogue"


@typed
@dataclass(frozen=True)
class EffectChoice:
    """The effects that a diagnosis considers.

    Args:
        effects: those to consider, each an `Effect`, a name, or a name with its place
            such as ``"coulomb friction on p"``; None: all of the catalogue. A name
            without a place means every equation in which the catalogue has it.
        without: those never considered, in the same words.
        kinds: those of which effects are considered; None: all, and of ``effects`` that
            are given no unknown functions.

    Raises:
        ModelError: something else than a list of effects and names; an unknown kind.
    """

    effects: Given | None = None
    without: Given = ()
    kinds: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for kind in self.kinds or ():
            require_known(kind, EFFECT_KINDS, f"kind {kind!r} of effects is unknown")
        object.__setattr__(self, "without", tuple(self.without))
        if self.effects is not None:
            object.__setattr__(self, "effects", tuple(self.effects))

    @property
    def has_functions(self) -> bool:
        """Whether unknown functions are considered too."""
        if self.kinds is None:
            return self.effects is None
        return "functions" in self.kinds

    def checked(
        self, model: BaseModel, units: Mapping[str, str] | None = None
    ) -> "EffectChoice":
        """The choice itself, if all that it names could be candidates.

        Effects of the catalogue become names, for what they add may change with what
        the model has already. Names of another kind become those that the catalogue of
        the model uses.

        Raises:
            ModelError: a name that the catalogue of the model does not have, an effect
                to leave out that is no candidate, or one that the model has.
        """
        offered: list[Effect] = catalogue(model, units)
        effects: list[Effect | str] = []
        for one in self.effects or ():
            effects += _as_offered(one, offered, model, units, "effects")
        considered = _all_meant(effects, offered)
        for effect in considered:
            if stands_in(model, effect):
                raise ModelError(
                    f"effect {str(effect)!r} in effects is in the model already; "
                    "remove it from the list."
                )
        without: list[Effect | str] = []
        for one in self.without:
            every = [*considered, *offered]
            without += _as_offered(one, every, model, units, "without")
        return replace(
            self, effects=None if self.effects is None else effects, without=without
        )

    def candidates(
        self, model: BaseModel, units: Mapping[str, str] | None = None
    ) -> list[Effect]:
        """The effects that are considered, but for those that the model has."""
        considered: list[Effect] = catalogue(model, units)
        if self.effects is not None:
            considered = _all_meant(self.effects, considered)
        kept: list[Effect] = []
        for effect in considered:
            is_out = any(_meant(one, [effect]) for one in self.without)
            is_out |= self.kinds is not None and effect_kind(effect) not in self.kinds
            if not is_out and not stands_in(model, effect) and effect not in kept:
                kept.append(effect)
        return kept


def _meant(one: Effect | str, effects: Iterable[Effect]) -> list[Effect]:
    """The effects of a name, or of an effect's name and place."""
    name = str(one)
    is_name = isinstance(one, str)
    return [e for e in effects if name == str(e) or (is_name and name == e.name)]


def _all_meant(given: Given, offered: list[Effect]) -> list[Effect]:
    """The effects themselves, and those of the catalogue that names stand for."""
    found = []
    for one in given:
        found += [one] if isinstance(one, Effect) else _meant(one, offered)
    return found


def _as_offered(
    one: Effect | str,
    offered: list[Effect],
    model: BaseModel,
    units: Mapping[str, str] | None,
    what: str,
) -> list[Effect | str]:
    """What a user gave, as the catalogue calls it; an effect of one's own as it is."""
    if one in offered:
        return [str(one)]
    if isinstance(one, str) and NAME.fullmatch(one.rpartition(" on ")[0]):
        return [effect_named(model, one)]
    is_own = isinstance(one, Effect) and what == "effects"
    if is_own or _meant(one, offered):
        return [one]
    found: list[Effect | str] = []
    if isinstance(one, str):
        name, _, place = one.rpartition(" on ") if " on " in one else (one, "", None)
        for alias in _called(name, place, every_name(model, units)):
            found += [str(e) for e in offered if _term_of(e) == _term_of(alias)]
        # What the units rule out may still be meant.
        found = found or [*_meant(one, catalogue(model))]
    if found:
        return found
    names = sorted({effect.name for effect in offered})
    with_places = list(map(str, offered))
    hint = did_you_mean(str(one), with_places if " on " in str(one) else names)
    raise ModelError(
        f"effect {str(one)!r} in {what} is not in the catalogue of this model "
        "(or the model has it already); "
        f"available are {some_of(names)}.{hint}"
    )


def _term_of(effect: Effect) -> tuple[object, ...]:
    return (effect.slot, effect.equation, [term.body for term in effect.term])
