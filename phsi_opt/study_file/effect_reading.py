"""Effects of a study file: those of the user's own, and the names of the catalogue."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.choice import EffectChoice
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.slots import SLOTS
from phsi_opt.model.terms import Dictionary
from phsi_opt.study_file.keys import DEFAULT_MAX_STEPS
from phsi_opt.study_file.model_reading import ModelReading
from phsi_opt.study_file.part import Part

ON = " on "  # between the name of an effect and its equation


@dataclass(frozen=True)
class StudySection:
    """The section [study].

    Attributes:
        added: names of the effects added so far, the oldest first.
        effects: names of those to consider; None: the catalogue, and the user's own.
        without: names of those never to consider.
        max_steps: how many ``--auto`` adds at most.
    """

    added: tuple[str, ...] = ()
    effects: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    max_steps: int = DEFAULT_MAX_STEPS


def read_study(file: Part) -> StudySection:
    """The section [study]."""
    part = file.part("study")
    example = '["coulomb friction on p"]'
    effects = None
    if "effects" in part.content:
        effects = part.texts("effects", example)
    return StudySection(
        added=part.texts("added", example),
        effects=effects,
        without=part.texts("without", example),
        max_steps=part.whole("max_steps", DEFAULT_MAX_STEPS) or DEFAULT_MAX_STEPS,
    )


def read_own_effects(file: Part, reading: ModelReading) -> tuple[Effect, ...]:
    """The effects of the sections [[effects]]; what is wrong is noted."""
    listed = file.content.get("effects", [])
    if not isinstance(listed, list):
        file.complain("effects", "expected sections [[effects]], with two brackets.")
        return ()
    found = []
    for number, content in enumerate(listed):
        key = f"effects[{number}]"
        if not isinstance(content, Mapping):
            file.complaints.add(key, "expected a section [[effects]].", content)
            continue
        effect = _own_effect(Part(key, content, file.complaints), reading)
        if effect is not None:
            found.append(effect)
    return tuple(found)


def _own_effect(part: Part, reading: ModelReading) -> Effect | None:
    part.check_known("effects")
    for name in ("name", "slot", "equation", "term"):
        if not part.content.get(name):
            part.complaints.add(part.path(name), "an effect needs it.")
            return None
    slot = part.one_of("slot", SLOTS, "F")
    equation = part.text("equation")
    if equation not in reading.states:
        hint = did_you_mean(equation, reading.states)
        part.complain("equation", f"there is no such state.{hint}")
        return None
    section = part.part("memory", "model.F")
    states = (*reading.states, *section.content)
    larger = ModelReading(states, reading.inputs, reading.parameters, reading.used)
    memory = {}
    for state in section.content:
        memory[state] = larger.terms.read(section, state, "F")
    return _made(part, slot, larger.terms.read(part, "term", slot), memory)


def _made(
    part: Part, slot: str, term: Dictionary, memory: Mapping[str, Dictionary]
) -> Effect | None:
    name = part.text("name")
    equation = part.text("equation")
    try:
        return Effect(name, slot, equation, term, memory, part.text("family"))
    except ModelError as error:
        part.complaints.add(part.key, str(error))
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
    for effect in own:
        if name in (effect.name, str(effect)):
            return effect
    before, _, equation = name.rpartition(ON)
    if before and equation in model.states:
        return effect_named(model, before, equation, units)
    return effect_named(model, name, units=units)


def grown(
    model: Model,
    added: Sequence[str],
    own: Sequence[Effect],
    units: Mapping[str, str],
) -> Model:
    """The model with the effects added, one after the other.

    Raises:
        ModelError: one of them is unknown, or the model has it already.
    """
    for name in added:
        model = model.add(meant_effect(model, name, own, units))
    return model


def check_effects(
    file: Part, model: Model, own: Sequence[Effect], units: Mapping[str, str]
) -> None:
    """Note every name of the section [study] that stands for no effect."""
    study = read_study(file)
    part = file.part("study")
    larger = model
    for name in study.added:
        try:
            larger = larger.add(meant_effect(larger, name, own, units))
        except ModelError as error:
            file.complaints.add(part.path("added"), str(error), name)
    for key, names in (("effects", study.effects or ()), ("without", study.without)):
        for name in names:
            _check_choice(part, key, name, model, own, units)


def _check_choice(
    part: Part,
    key: str,
    name: str,
    model: Model,
    own: Sequence[Effect],
    units: Mapping[str, str],
) -> None:
    if any(name in (effect.name, str(effect)) for effect in own):
        return
    choice = EffectChoice([name]) if key == "effects" else EffectChoice(None, [name])
    try:
        choice.checked(model, units)
    except ModelError as error:
        part.complaints.add(part.path(key), str(error), name)
