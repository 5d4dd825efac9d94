"""The catalogue of physical effects: those that apply to a model, by name.

An effect is a term in a slot of an equation; the files ``catalogue_losses``,
``catalogue_energies``, ``catalogue_forces``, ``catalogue_actuators`` and
``catalogue_sensors`` write them down, with the values that are tried before a Stribeck
speed, a play or a delay is optimised. What a model can do already is left out.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, permutations

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_actuators import actuators
from phsi_opt.model.catalogue_energies import coupling, energies
from phsi_opt.model.catalogue_forces import forces, hysteresis, parametric_stiffness
from phsi_opt.model.catalogue_losses import (
    heat_from,
    losses,
    overflow_into,
)
from phsi_opt.model.catalogue_sensors import sensors
from phsi_opt.model.catalogue_storages import second_storages
from phsi_opt.model.effect import Effect
from phsi_opt.model.effect_list import EffectList
from phsi_opt.model.kinds import KINDS, TEMPERATURES, plain_unit
from phsi_opt.model.redundancy import is_redundant
from phsi_opt.model.roles import Role, role_of
from phsi_opt.model.structure import (
    forced_rows,
    kind_of,
    position_of_momentum,
    storage_states,
    with_kinds_of_units,
)


def catalogue(model: BaseModel, units: Mapping[str, str] | None = None) -> EffectList:
    """The effects that apply to the model, each with the slot and equation it acts in.

    The list prints as a table.

    Those that the model has, or can do already, are left out. What is offered for a
    state, and its name, follows from the state's kind; where that is unknown, losses
    are offered under the names of bodies and of tanks, each law once.

    Args:
        model: the model.
        units: of its states, as `Measurements.units`; they tell the kinds that the
            model does not tell.
    """
    units = units or {}
    known = with_kinds_of_units(model, units)
    effects = [
        *_in_equations(known, units),
        *_between_storages(known),
        *_from_surroundings(known, units),
        *_between_positions(known),
        *_in_sensors(known),
    ]
    return EffectList(effect for effect in effects if not is_redundant(known, effect))


def every_name(model: BaseModel, units: Mapping[str, str] | None = None) -> EffectList:
    """The effects of the catalogue under the names of all kinds, the model's first.

    One term may stand there under several names. What the units rule out comes last: by
    its name it may still be meant.
    """
    found = catalogue(model, units)
    known = {str(effect) for effect in found}
    untold = replace(model, kind={})
    others = (untold, *(replace(model, kind=kind) for kind in KINDS))
    for further in (*(catalogue(other, units) for other in others), catalogue(model)):
        for effect in further:
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
    """The catalogue's effect of that name.

    The names of all kinds are known: what a model of tanks calls a linear leak may be
    added as viscous damping.

    Args:
        model: the model to which it could be added.
        name: such as ``"coulomb friction"``.
        equation: the state in whose equation it acts; not needed where the effect
            applies to one equation only.
        units: of the states, as in `catalogue`.

    Raises:
        ModelError: no effect of that name applies there, or it applies to several
            equations and none is given.
    """
    if equation is not None:
        model.index(equation, f"equation of effect {name!r}:")
    own = [e for e in catalogue(model, units) if equation in (None, e.equation)]
    found = _called(name, own)
    if not found:
        every = every_name(model, units)
        there = [e for e in every if equation in (None, e.equation)]
        found = _called(name, there)
    if not found:
        raise ModelError(_not_in_catalogue(model, name, equation, own))
    if len(found) > 1 and equation is None:
        equations = ", ".join(effect.equation for effect in found)
        raise ModelError(
            f"effect {name!r} can act in several equations: {equations}; "
            f"say which, such as ({name!r}, {found[0].equation!r})."
        )
    return found[0]


def _called(name: str, effects: list[Effect]) -> list[Effect]:
    """Those of a name, in small letters or large ones."""
    return [effect for effect in effects if effect.name.lower() == name.lower()]


def _not_in_catalogue(
    model: BaseModel, name: str, equation: str | None, there: list[Effect]
) -> str:
    place = "" if equation is None else f" on {equation}"
    if _is_had(model, name, equation):
        return (
            f"the model has {name!r}{place} already, or can do the same by its own "
            "terms; give another effect."
        )
    names = sorted({effect.name for effect in there})
    hint = did_you_mean(name, names)
    where = "this model" if equation is None else f"the equation of {equation}"
    return (
        f"there is no effect {name!r}{place} in the catalogue.{hint} "
        f"For {where} there are: {', '.join(names)}."
    )


def _is_had(model: BaseModel, name: str, equation: str | None) -> bool:
    """Whether it would be offered if the model had neither losses nor forces."""
    bare = replace(model, R={}, F={}) if model.has_energy else replace(model, F={})
    there = [e for e in every_name(bare) if equation in (None, e.equation)]
    return bool(_called(name, there))


def _in_equations(model: BaseModel, units: Mapping[str, str]) -> list[Effect]:
    """Losses, forces, actuators and energies of each equation."""
    positions = position_of_momentum(model)
    effects = []
    for row in forced_rows(model):
        state = model.states[row]
        position = positions.get(state)
        effects += losses(model, state, position, units.get(state, ""))
        effects += forces(model, state)
        effects += actuators(model, state)
        effects += energies(model, state, position, units.get(position or "", ""))
        effects += second_storages(model, state)
        if position is not None:
            effects.append(parametric_stiffness(model, position, state))
            effects.append(hysteresis(model, position, state))
    return effects


def _between_storages(model: BaseModel) -> list[Effect]:
    """What runs from one tank into another, and heat between two storages."""
    tanks = permutations(storage_states(model), 2)
    overflows = [overflow_into(model, state, source) for source, state in tanks]
    heat = []
    for source, state in permutations(model.states, 2):
        if Role.HEAT == role_of(model, source) == role_of(model, state):
            heat.append(heat_from(model, state, source))
    return [*overflows, *heat]


def _from_surroundings(model: BaseModel, units: Mapping[str, str]) -> list[Effect]:
    """Heat from inputs that are, or may be, temperatures."""
    found = []
    for u in model.inputs:
        unit = plain_unit(units.get(u, ""))
        if unit and unit not in TEMPERATURES:
            continue
        for state in model.states:
            if role_of(model, state) is Role.HEAT:
                found.append(heat_from(model, state, u))
    return found


def _between_positions(model: BaseModel) -> list[Effect]:
    """Springs between two positions of one kind.

    None without an energy, where the masses of the two may be anything.
    """
    found: list[Effect] = []
    if not model.has_energy:
        return found
    for (p1, q1), (p2, q2) in combinations(position_of_momentum(model).items(), 2):
        if kind_of(model, p1) == kind_of(model, p2):
            found.append(coupling(model, q1, q2, p1))
    return found


def _in_sensors(model: BaseModel) -> list[Effect]:
    effects = []
    for state in model.states:
        if state not in model.memory:
            effects += sensors(state)
    return effects
