"""Dry friction among other candidates: which of its kinds is tried when.

Coulomb's and Stribeck's friction on one equation explain nearly the same. The simpler
one is tried first, and pairs hold the simplest alone: with all kinds half of the pairs
would be each pair twice. The best pair is then tried with the other kinds.
"""

from collections.abc import Sequence

from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share
from phsi_opt.screening.prospects import Prospect


def is_dry(effect: Effect) -> bool:
    """Whether an effect has a corner that is to be sharpened."""
    for term in effect.term:
        for parameter in term.inner.values():
            guess = parameter.guess
            if isinstance(guess, Share) and guess.sharper:
                return True
    return False


def new_corners(model: Model, base: Model) -> dict[str, Share]:
    """Widths of corners that a model has and its base has not, with their guesses."""
    found = {}
    for name, guess in corner_widths(model).items():
        if name not in base.entries:
            found[name] = guess
    return found


def simple_first(rows: Sequence[Prospect]) -> list[Prospect]:
    """The same order, but the simplest dry friction on an equation comes first."""
    ordered = list(rows)
    for equation in {one.effect.equation for one in rows}:
        places = []
        for place, one in enumerate(rows):
            if one.effect.equation == equation and is_dry(one.effect):
                places.append(place)
        by_size = sorted((rows[i] for i in places), key=lambda one: one.n_free)
        for place, one in zip(places, by_size, strict=True):
            ordered[place] = one
    return ordered


def simplest_dry(found: Sequence[Prospect]) -> list[Prospect]:
    """All, but of dry frictions on an equation the one with fewest parameters."""
    dry = [one for one in found if is_dry(one.effect)]
    dry.sort(key=lambda one: -one.n_free)
    simplest = {one.effect.equation: one for one in dry}
    kept = []
    for one in found:
        if not is_dry(one.effect) or one is simplest[one.effect.equation]:
            kept.append(one)
    return kept


def other_kinds(
    pair: tuple[Effect, Effect], found: Sequence[Prospect]
) -> list[list[Prospect]]:
    """The pair with another kind of dry friction on the same equation."""
    variants = []
    for effect, partner in (pair, pair[::-1]):
        partners = [one for one in found if one.effect == partner]
        for other in found:
            if _is_other_kind(other.effect, effect):
                variants.append([other, *partners])
    return variants


def _is_other_kind(other: Effect, effect: Effect) -> bool:
    if other == effect or other.equation != effect.equation:
        return False
    return is_dry(effect) and is_dry(other)
