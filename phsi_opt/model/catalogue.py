"""The catalogue of physical effects: those that apply to a model, by name.

An effect is a term in a slot of an equation; the files ``catalogue_losses``,
``catalogue_energies``, ``catalogue_forces``, ``catalogue_actuators`` and
``catalogue_sensors`` write them down, with the values that are tried before a Stribeck
speed, a play or a delay is optimised. What a model can do already is left out.
"""

from itertools import combinations, permutations

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_actuators import actuators
from phsi_opt.model.catalogue_energies import coupling, energies
from phsi_opt.model.catalogue_forces import forces, hysteresis, parametric_stiffness
from phsi_opt.model.catalogue_losses import losses, overflow_into
from phsi_opt.model.catalogue_sensors import sensors
from phsi_opt.model.effect import Effect
from phsi_opt.model.redundancy import is_redundant
from phsi_opt.model.structure import forced_rows, position_of_momentum, storage_states


def catalogue(model: BaseModel) -> list[Effect]:
    """The effects that apply to the model, each with the slot and equation it acts in.

    Those that the model has, or can do already, are left out.
    """
    effects = [
        *_in_equations(model),
        *_between_storages(model),
        *_between_positions(model),
        *_in_sensors(model),
    ]
    return [effect for effect in effects if not is_redundant(model, effect)]


def effect_named(model: BaseModel, name: str, equation: str | None = None) -> Effect:
    """The catalogue's effect of that name.

    Args:
        model: the model to which it could be added.
        name: such as ``"coulomb friction"``.
        equation: the state in whose equation it acts; not needed where the effect
            applies to one equation only.

    Raises:
        ModelError: no effect of that name applies there, or it applies to several
            equations and none is given.
    """
    if equation is not None:
        model.index(equation, f"equation of effect {name!r}:")
    there = [e for e in catalogue(model) if equation in (None, e.equation)]
    found = [effect for effect in there if effect.name == name]
    if not found:
        raise ModelError(_not_in_catalogue(name, equation, there))
    if len(found) > 1 and equation is None:
        equations = ", ".join(effect.equation for effect in found)
        raise ModelError(
            f"effect {name!r} can act in several equations: {equations}; "
            f"say which, such as ({name!r}, {found[0].equation!r})."
        )
    return found[0]


def _not_in_catalogue(name: str, equation: str | None, there: list[Effect]) -> str:
    place = "" if equation is None else f" on {equation!r}"
    names = sorted({effect.name for effect in there})
    return (
        f"effect {name!r}{place} is not in the catalogue of this model "
        "(or the model has it already); "
        f"available there: {', '.join(names)}.{did_you_mean(name, names)}"
    )


def _in_equations(model: BaseModel) -> list[Effect]:
    """Losses, forces and actuators of each equation, energies of each momentum."""
    positions = position_of_momentum(model)
    effects = []
    for row in forced_rows(model):
        state = model.states[row]
        position = positions.get(state)
        effects += losses(model, state, position)
        effects += forces(model, state)
        effects += actuators(model, state)
        if position is not None:
            effects += energies(position, state)
            effects.append(parametric_stiffness(model, position, state))
            effects.append(hysteresis(position, state))
    return effects


def _between_storages(model: BaseModel) -> list[Effect]:
    pairs = permutations(storage_states(model), 2)
    return [overflow_into(model, state, source) for source, state in pairs]


def _between_positions(model: BaseModel) -> list[Effect]:
    pairs = combinations(position_of_momentum(model).items(), 2)
    return [coupling(q1, q2, p1) for (p1, q1), (_, q2) in pairs]


def _in_sensors(model: BaseModel) -> list[Effect]:
    effects = []
    for state in model.states:
        if state not in model.memory:
            effects += sensors(state)
    return effects
