"""The gallery: base models to begin with, as drafts that a user goes on to change."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from phsi_opt.page.drafts import ModelDraft


@dataclass(frozen=True)
class BaseModel:
    """One entry of the gallery (see ``gallery.toml``).

    Attributes:
        title: such as "Spring".
        about: what it is, in a sentence.
        units: of its states.
        model: sections of a study file, as are the ``parameters``.
        driven: the equations in which an input acts, and how: ``{u}`` is its name.
        driven_parameters: parameters that come with an input.
    """

    title: str
    about: str
    units: Mapping[str, str]
    model: Mapping[str, Any]
    parameters: Mapping[str, Any]
    driven: Mapping[str, str]
    driven_parameters: Mapping[str, Any] = field(default_factory=dict)

    def drafted(self, inputs: Sequence[str] = ()) -> ModelDraft:
        """A fresh draft; the first of the inputs acts in the driven equations."""
        parameters = {**self.parameters, **(self.driven_parameters if inputs else {})}
        content = {**self.model, "states": list(self.units), "inputs": list(inputs)}
        draft = ModelDraft.of(content, parameters)
        draft.title = self.title
        for one in draft.parameters:
            one.is_assumed = one.is_known
        for state, formula in self.driven.items() if inputs else ():
            terms = [draft.F.get(state, ""), formula.format(u=inputs[0])]
            draft.F[state] = " + ".join(filter(None, terms))
        return draft


def _entries() -> dict[str, BaseModel]:
    text = (files("phsi_opt.page") / "gallery.toml").read_text(encoding="utf-8")
    found = tomllib.loads(text)
    return {title: BaseModel(title, **entry) for title, entry in found.items()}


GALLERY = _entries()
