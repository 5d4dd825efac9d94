"""A model as numbers, texts, lists and mappings, for files, and back.

Formulas stay text. Reading one goes through the whitelist of `expressions`, when the
model checks its terms.
"""

from collections.abc import Mapping
from typing import Any

from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary, Term

Content = dict[str, Any]

KINDS: dict[str, type[Model]] = {
    "PseudoHamiltonian": PseudoHamiltonian,
    "FirstOrder": FirstOrder,
}
GUESSES: dict[str, type[Scan | Share | Tried]] = {
    "Scan": Scan,
    "Share": Share,
    "Tried": Tried,
}


def model_content(model: Model) -> Content:
    """The content of a model."""
    content: Content = {
        "kind": type(model).__name__,
        "states": list(model.states),
        "inputs": list(model.inputs),
        "memory": list(model.memory),
        "kinds": dict(model.kind),
        "S": [list(row) for row in model.S],
        "H": _dictionary_content(model.H),
    }
    for slot in BY_EQUATION:
        content[slot] = _slot_content(getattr(model, slot))
    return content


def _slot_content(by_equation: Mapping[str, Dictionary]) -> Content:
    return {name: _dictionary_content(terms) for name, terms in by_equation.items()}


def _dictionary_content(terms: Dictionary) -> list[Content]:
    return [_term_content(term) for term in terms]


def _term_content(term: Term) -> Content:
    coefficient = None
    if term.coefficient is not None:
        coefficient = _parameter_content(term.coefficient)
    inner = {name: _parameter_content(p) for name, p in term.inner.items()}
    return {
        "body": term.body,
        "coefficient": coefficient,
        "inner": inner,
        "name": term.name,
    }


def _parameter_content(parameter: Parameter) -> Content:
    guess = None
    if parameter.guess is not None:
        guess = [type(parameter.guess).__name__, *vars(parameter.guess).values()]
    return {
        "value": parameter.value,
        "lower": parameter.lower,
        "upper": parameter.upper,
        "unit": parameter.unit,
        "fixed": parameter.fixed,
        "guess": guess,
        "per_trajectory": parameter.per_trajectory,
    }


def model_from(content: Content) -> Model:
    """The model of a content that `model_content` made.

    Raises:
        ModelError: A formula is not one, or the model contradicts itself.
        LookupError, TypeError, ValueError, AttributeError: The content is damaged.
    """
    parts: Content = {
        "states": content["states"],
        "inputs": content["inputs"],
        "memory": content.get("memory", []),
        "kind": content.get("kinds", {}),
    }
    for slot in BY_EQUATION:
        parts[slot] = _slot_from(content.get(slot, {}))
    if content["kind"] == "PseudoHamiltonian":
        parts["S"] = content["S"]
        parts["H"] = _dictionary_from(content["H"])
    return KINDS[content["kind"]](**parts)


def _slot_from(content: Content) -> dict[str, Dictionary]:
    return {name: _dictionary_from(terms) for name, terms in content.items()}


def _dictionary_from(content: list[Content]) -> Dictionary:
    return Dictionary(tuple(_term_from(term) for term in content))


def _term_from(content: Content) -> Term:
    coefficient = None
    if content["coefficient"] is not None:
        coefficient = _parameter_from(content["coefficient"])
    inner = {name: _parameter_from(p) for name, p in content["inner"].items()}
    return Term(content["body"], coefficient, inner, content["name"])


def _parameter_from(content: Content) -> Parameter:
    guess = None
    if content["guess"] is not None:
        kind, *settings = content["guess"]
        guess = GUESSES[kind](*settings)
    return Parameter(**{**content, "guess": guess})
