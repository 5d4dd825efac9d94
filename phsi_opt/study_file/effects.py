"""Effects of a study file: those of the user's own, and the names of the catalogue."""

from collections.abc import Mapping, Sequence

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.choice import EffectChoice
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.study_file.complaints import Complaints, Part
from phsi_opt.study_file.model_reading import ModelReader
from phsi_opt.study_file.sections import StudySection

ON = " on "  # between the name of an effect and its equation


def read_own_effects(file: Part, reader: ModelReader) -> tuple[Effect, ...]:
    """The effects of the sections [[effects]]; what is wrong is noted."""
    found = []
    for number, content in enumerate(file.get("effects", [])):
        effect = _own_effect(
            Part(f"effects[{number}]", content, file.complaints), reader
        )
        if effect is not None:
            found.append(effect)
    return tuple(found)


def _own_effect(part: Part, reader: ModelReader) -> Effect | None:
    for name in ("name", "slot", "equation", "term"):
        part.need(name, "an effect needs it.")
    equation = part.get("equation", "")
    if equation and equation not in reader.states:
        hint = did_you_mean(equation, reader.states)
        part.complain("equation", f"there is no such state.{hint}")
    if part.complaints.about(part.key):
        return None
    slot = part.content["slot"]
    rates = part.part("memory")
    larger = reader.with_states(rates.content)
    memory = {state: larger.terms(rates, state, "F") for state in rates.content}
    term = larger.terms(part, "term", slot)
    try:
        return Effect(
            part.content["name"], slot, equation, term, memory, part.get("family", "")
        )
    except ModelError as error:
        part.complaints.add(part.key, error)
        return None


def own_effect(name: str, own: Sequence[Effect]) -> Effect | None:
    """The effect of the user's own that is called so, with its place or without."""
    for effect in own:
        if name in (effect.name, str(effect)):
            return effect
    return None


def meant_effect(
    model: Model, name: str, own: Sequence[Effect], units: Mapping[str, str]
) -> Effect:
    """The effect that a name such as ``"coulomb friction on p"`` stands for.

    Args:
        model: to which it could be added.
        name: with its place, or without where only one equation can have it.
        own: effects that are not in the catalogue; they come first.
        units: of the states, as in `catalogue`.

    Raises:
        ModelError: there is no such effect.
    """
    return own_effect(name, own) or effect_named(model, name, units=units)


def check_effects(
    steps: StudySection,
    model: Model,
    own: Sequence[Effect],
    units: Mapping[str, str],
    complaints: Complaints,
) -> None:
    """Note every name of the section [study] that stands for no effect."""
    larger = model
    for name in steps.added:
        try:
            larger = larger.add(meant_effect(larger, name, own, units))
        except ModelError as error:
            complaints.add("study.added", error, name)
    for key in ("effects", "without"):
        for name in getattr(steps, key) or ():
            try:
                if own_effect(name, own) is None:
                    EffectChoice(**{key: (name,)}).checked(model, units)
            except ModelError as error:
                complaints.add(f"study.{key}", error, name)
