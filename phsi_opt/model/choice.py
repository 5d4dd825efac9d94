"""Which effects are considered: the whole catalogue, a part of it, or one's own.

A choice holds names and effects as a user gave them. It is checked once, on the model
to which it was given; the candidates are then read from the model as it has become, so
that an effect that was added since is neither offered again nor called unknown.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue import catalogue, every_name
from phsi_opt.model.effect import Effect
from phsi_opt.model.redundancy import stands_in

Given = Sequence[Effect | str]


@dataclass(frozen=True)
class EffectChoice:
    """The effects that a diagnosis considers.

    Args:
        effects: those to consider, each an `Effect`, a name, or a name with its place
            such as ``"coulomb friction on p"``; None: all of the catalogue. A name
            without a place means every equation in which the catalogue has it.
        without: those never considered, in the same words.

    Raises:
        ModelError: something else than a list of effects and names.
    """

    effects: Given | None = None
    without: Given = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "without", _listed("without", self.without))
        if self.effects is not None:
            object.__setattr__(self, "effects", _listed("effects", self.effects))

    def narrowed(self, effects: Given | None, without: Given) -> "EffectChoice":
        """Of other effects, where there are any, and without more of them."""
        chosen = self.effects if effects is None else effects
        added = EffectChoice(None, without).without
        return EffectChoice(chosen, (*self.without, *added))

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
        considered = offered
        effects: list[Effect | str] | None = None
        if self.effects is not None:
            effects = []
            for one in self.effects:
                effects += _as_offered(one, offered, model, units, "effects")
            considered = _all_meant(effects, offered)
            for effect in considered:
                if stands_in(model, effect):
                    raise ModelError(
                        f"effect {str(effect)!r} in effects stands in the model "
                        "already; leave it out."
                    )
        without: list[Effect | str] = []
        for one in self.without:
            every = [*considered, *offered]
            without += _as_offered(one, every, model, units, "without")
        return EffectChoice(effects, without)

    def candidates(
        self, model: BaseModel, units: Mapping[str, str] | None = None
    ) -> list[Effect]:
        """The effects that are considered, but for those that the model has."""
        considered: list[Effect] = catalogue(model, units)
        if self.effects is not None:
            considered = _all_meant(self.effects, considered)
        kept: list[Effect] = []
        for effect in considered:
            is_out = any(_is_called(effect, one) for one in self.without)
            if not is_out and not stands_in(model, effect) and effect not in kept:
                kept.append(effect)
        return kept


def _listed(what: str, given: Any) -> tuple[Effect | str, ...]:
    """The effects and names as a tuple, if they are a list of such."""
    if isinstance(given, str | Effect) or not isinstance(given, Iterable):
        raise ModelError(
            f"{what}={given!r} must be a list of effects or of their names, "
            "such as ['coulomb friction', 'gap on p']."
        )
    listed = tuple(given)
    for one in listed:
        if not isinstance(one, str | Effect):
            raise ModelError(
                f"{one!r} in {what} is neither an Effect nor the name of one."
            )
    return listed


def _is_called(effect: Effect, one: Effect | str) -> bool:
    """Whether a name, or an effect of that name and place, means the effect."""
    if isinstance(one, str):
        return one in (effect.name, str(effect))
    return (one.name, one.equation) == (effect.name, effect.equation)


def _all_meant(given: Given, offered: list[Effect]) -> list[Effect]:
    """The effects themselves, and those of the catalogue that names stand for."""
    found = []
    for one in given:
        if isinstance(one, Effect):
            found.append(one)
        else:
            found += [effect for effect in offered if _is_called(effect, one)]
    return found


def _as_offered(
    one: Effect | str,
    offered: list[Effect],
    model: BaseModel,
    units: Mapping[str, str] | None,
    what: str,
) -> list[Effect | str]:
    """What a user gave, as the catalogue calls it; an effect of one's own as it is.

    Args:
        one: what was given.
        offered: effects that may be meant.
        model: to which it could be added.
        units: of its states.
        what: the argument that it was given as.
    """
    if one in offered:
        return [str(one)]
    is_own = isinstance(one, Effect) and what == "effects"
    if is_own or any(_is_called(effect, one) for effect in offered):
        return [one]
    found: list[Effect | str] = []
    if isinstance(one, str):
        aliases = [e for e in every_name(model, units) if _is_called(e, one)]
        for alias in aliases:
            found += [str(e) for e in offered if _term_of(e) == _term_of(alias)]
        # What the units rule out may still be meant.
        found = found or [e for e in catalogue(model) if _is_called(e, one)]
    if found:
        return found
    names = sorted({effect.name for effect in offered})
    with_places = list(map(str, offered))
    hint = did_you_mean(str(one), with_places if " on " in str(one) else names)
    raise ModelError(
        f"effect {str(one)!r} in {what} is not in the catalogue of this model "
        "(or the model has it already); "
        f"available are {', '.join(names)}.{hint}"
    )


def _term_of(effect: Effect) -> tuple[object, ...]:
    """What an effect adds, by whatever name."""
    return (effect.slot, effect.equation, [term.body for term in effect.term])
