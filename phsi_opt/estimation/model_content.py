"""A model as numbers, texts, lists and mappings, for files, and back.

Formulas stay text. Reading one goes through the whitelist of `expressions`, when the
model checks its terms.
"""

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
        by_equation = getattr(model, slot).items()
        content[slot] = {
            name: _dictionary_content(terms) for name, terms in by_equation
        }
    return content


def _dictionary_content(terms: Dictionary) -> list[Content]:
    found = []
    for term in terms:
        inner = {name: _parameter_content(one) for name, one in term.inner.items()}
        coefficient = term.coefficient and _parameter_content(term.coefficient)
        found.append({**vars(term), "coefficient": coefficient, "inner": inner})
    return found


def _parameter_content(parameter: Parameter) -> Content:
    guess = parameter.guess and [
        type(parameter.guess).__name__,
        *vars(parameter.guess).values(),
    ]
    return {**vars(parameter), "guess": guess}


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
        by_equation = content.get(slot, {}).items()
        parts[slot] = {name: _dictionary_from(terms) for name, terms in by_equation}
    if content["kind"] == "PseudoHamiltonian":
        parts["S"] = content["S"]
        parts["H"] = _dictionary_from(content["H"])
    return KINDS[content["kind"]](**parts)


def _dictionary_from(content: list[Content]) -> Dictionary:
    terms = []
    for term in content:
        coefficient = term["coefficient"]
        if coefficient is not None:
            coefficient = _parameter_from(coefficient)
        inner = {name: _parameter_from(one) for name, one in term["inner"].items()}
        terms.append(Term(term["body"], coefficient, inner, term["name"]))
    return Dictionary(tuple(terms))


def _parameter_from(content: Content) -> Parameter:
    guess = None
    if content["guess"] is not None:
        kind, *settings = content["guess"]
        guess = GUESSES[kind](*settings)
    return Parameter(**{**content, "guess": guess})
