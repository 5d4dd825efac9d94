"""Effects of a study file by their names: the user's own, and the catalogue's."""

from collections.abc import Mapping, Sequence

from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.choice import EffectChoice
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.study_file.complaints import Complaints
from phsi_opt.study_file.sections import StudySection


def own_effect(name: str, own: Sequence[Effect]) -> Effect | None:
    """The effect of the user's own that is called so, with its place or without."""
    return next((one for one in own if name in (one.name, str(one))), None)


def check_effects(
    steps: StudySection,
    model: Model,
    own: Sequence[Effect],
    units: Mapping[str, str],
    found: Complaints,
) -> None:
    """Note every name of the section [study] that stands for no effect."""
    larger = model
    for name in steps.added:
        with found.noting("study", "added", value=name):
            effect = own_effect(name, own) or effect_named(larger, name, units=units)
            larger = larger.add(effect)
    for key in ("effects", "without"):
        for name in getattr(steps, key) or ():
            if own_effect(name, own) is None:
                with found.noting("study", key, value=name):
                    EffectChoice(**{key: (name,)}).checked(model, units)
