"""Model, effects and loss as what a study file holds: texts, numbers, lists, tables.

The counterpart of the modules that read. What a study file has no form for is refused
by name.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.study_file.loss_reading import SETTINGS
from phsi_opt.study_file.model_reading import TYPES
from phsi_opt.transcription.losses import MaximumLikelihood

Content = dict[str, Any]


def parameter_content(parameter: Parameter) -> Content | float:
    """A parameter: a plain number where it is known and nothing else is told of it."""
    content: Content = {}
    if parameter.value is not None:
        content["value" if parameter.fixed else "start"] = parameter.value
    for name in ("lower", "upper"):
        bound = getattr(parameter, name)
        if np.isfinite(bound):
            content[name] = bound
    if parameter.unit:
        content["unit"] = parameter.unit
    if parameter.per_trajectory:
        content["per_trajectory"] = True
    if parameter.fixed and parameter.value is None:
        content["fixed"] = True
    if parameter.guess is not None:
        content["guess"] = _guess_content(parameter.guess)
    if list(content) == ["value"]:
        return float(content["value"])
    return content


def _guess_content(guess: Any) -> Content:
    content: Content = {"kind": type(guess).__name__}
    for one in fields(guess):
        value = getattr(guess, one.name)
        if one.default is MISSING or value != one.default:
            content[one.name] = list(value) if isinstance(value, tuple) else value
    return content


def term_content(term: Term) -> str | Content:
    """A formula as text; a term with a coefficient as a table."""
    if term.coefficient is None:
        return term.body
    content: Content = {"body": term.body}
    coefficient = parameter_content(term.coefficient)
    if coefficient != {}:
        content["coefficient"] = coefficient
    if term.inner:
        inner = {name: parameter_content(p) for name, p in term.inner.items()}
        content["inner"] = inner
    if term.name:
        content["name"] = term.name
    return content


def terms_content(terms: Dictionary) -> Any:
    """A sum of terms: the term itself where there is one, else a list."""
    listed = [term_content(term) for term in terms]
    return listed[0] if len(listed) == 1 else listed


@dataclass(frozen=True)
class ModelContent:
    """A model for the sections [model] and [parameters].

    Attributes:
        head: the keys of [model].
        slots: [model.R], [model.F], [model.sensor]: terms by state, those that are not
            empty.
        parameters: [parameters].
    """

    head: Content
    slots: Mapping[str, Content]
    parameters: Content


def model_content(model: Model, own_effects: Sequence[Effect]) -> ModelContent:
    """A model, with the parameters of its formulas and of the effects' formulas.

    Raises:
        ModelError: one name stands for two different parameters.
    """
    head: Content = {
        "type": TYPES[0] if model.has_energy else TYPES[1],
        "states": list(model.states),
    }
    if model.inputs:
        head["inputs"] = list(model.inputs)
    if model.memory:
        head["memory"] = list(model.memory)
    if model.kind:
        head["kind"] = dict(model.kind)
    if model.has_energy:
        head.update(structure_content(model))
        head["H"] = terms_content(model.H)
    slots = {}
    for slot in BY_EQUATION:
        by_equation = getattr(model, slot)
        if by_equation:
            slots[slot] = {name: terms_content(ts) for name, ts in by_equation.items()}
    parameters: Content = {}
    for name, parameter in shared_parameters(model, own_effects).items():
        parameters[name] = parameter_content(parameter)
    return ModelContent(head, slots, parameters)


def structure_content(model: Model) -> Content:
    """The structure as pairs where it is nothing but pairs, else as a matrix."""
    S = np.array(model.S)
    pairs = []
    for row, column in np.argwhere(S > 0).tolist():
        pairs.append([model.states[row], model.states[column]])
    of_pairs = np.all(np.isin(S, (-1.0, 0.0, 1.0)))
    return {"pairs": pairs} if of_pairs else {"S": S.tolist()}


def shared_parameters(
    model: Model, own_effects: Sequence[Effect]
) -> dict[str, Parameter]:
    """The parameters of all formulas, by name, in the order of the model.

    Raises:
        ModelError: one name stands for two different parameters.
    """
    found: dict[str, Parameter] = {}
    for terms in _all_sums(model, own_effects):
        for term in terms:
            if term.is_formula:
                for name, parameter in term.inner.items():
                    _check_same(name, found.setdefault(name, parameter), parameter)
    return found


def _all_sums(model: Model, own_effects: Sequence[Effect]) -> Iterable[Dictionary]:
    yield model.H
    for slot in BY_EQUATION:
        yield from getattr(model, slot).values()
    for effect in own_effects:
        yield effect.term
        yield from effect.memory.values()


def _check_same(name: str, known: Parameter, parameter: Parameter) -> None:
    if known != parameter:
        raise ModelError(
            f"parameter {name!r} of one of the effects is another one than that of the "
            "model; a study file has one parameter of a name. Rename one."
        )


def effect_content(effect: Effect) -> Content:
    """A section [[effects]]."""
    content: Content = {
        "name": effect.name,
        "slot": effect.slot,
        "equation": effect.equation,
        "term": terms_content(effect.term),
    }
    if effect.memory:
        memory = {name: terms_content(terms) for name, terms in effect.memory.items()}
        content["memory"] = memory
    if effect.family:
        content["family"] = effect.family
    return content


def loss_content(loss: MaximumLikelihood) -> Content:
    """The settings that differ from the default.

    Raises:
        ModelError: the loss has a noise, which stands beside the columns.
    """
    if loss.noise is not None:
        raise ModelError(
            f"loss: noise={dict(loss.noise)!r} has its place beside the columns of a "
            "study file; give it to the channels, and leave it out of the loss."
        )
    default = MaximumLikelihood()
    content = {}
    for name in SETTINGS:
        if getattr(loss, name) != getattr(default, name):
            content[name] = getattr(loss, name)
    return content
