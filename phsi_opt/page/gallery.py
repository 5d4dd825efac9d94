"""The gallery: base models to begin with, as drafts that a user goes on to change."""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from phsi_opt.model.kinds import LENGTHS, plain_unit
from phsi_opt.page.drafts import NOT_USED, STATE, DataDraft, ModelDraft


@dataclass(frozen=True)
class BaseModel:
    """One entry of the gallery (see ``gallery.toml``)."""

    title: str  # such as "Spring"
    about: str  # what it is, in a sentence
    units: Mapping[str, str]  # of its states
    model: Mapping[str, Any]  # sections of a study file, as are the ``parameters``
    parameters: Mapping[str, Any]
    # The equations in which an input acts, and how: ``{u}`` is its name.
    driven: Mapping[str, str]
    # Parameters that come with an input.
    driven_parameters: Mapping[str, Any] = field(default_factory=dict)

    def drafted(self, inputs: Sequence[str] = ()) -> ModelDraft:
        """A fresh draft; the first of the inputs acts in the driven equations."""
        parameters = {**self.parameters, **(self.driven_parameters if inputs else {})}
        content = {**self.model, "states": list(self.units), "inputs": list(inputs)}
        draft = ModelDraft.of(content, parameters, self.title)
        for one in draft.parameters:
            one.is_assumed = one.is_known
        for state, formula in self.driven.items() if inputs else ():
            forces = draft.table["F"]
            terms = [forces.get(state, ""), formula.format(u=inputs[0])]
            forces[state] = " + ".join(filter(None, terms))
        return draft


_TEXT = (files("phsi_opt.page") / "gallery.toml").read_text(encoding="utf-8")
GALLERY = {name: BaseModel(name, **one) for name, one in tomllib.loads(_TEXT).items()}


def match_states(data: DataDraft, units: Mapping[str, str]) -> None:
    """Give the columns of states the names that the model has.

    First where the units agree, then in order where one of them is unknown. A column
    that fits no state is not used, until a base model is chosen that it fits; a state
    without a column counts as not measured.

    Args:
        data: its columns are changed.
        units: of the model's states, by name.
    """
    for column in data.columns:
        if column.fits_no_state and column.role == NOT_USED:
            column.role = STATE
        column.fits_no_state = False
    free = dict(units)
    left = data.with_role(STATE)
    for agrees in (_is_same_unit, lambda one, other: not one or not other):
        for column in list(left):
            names = (name for name in free if agrees(column.unit, free[name]))
            name = next(names, None)
            if name is not None:
                column.table["name"] = name
                del free[name]
                left.remove(column)
    for column in left:
        column.role = NOT_USED
        column.fits_no_state = True
    data.unmeasured = free


def left_over(data: DataDraft, title: str, units: Mapping[str, str]) -> str:
    """Which columns fit no state of a model, in a sentence; "" where all do."""
    left = [(str(one.column), one.unit) for one in data.columns if one.fits_no_state]
    if not left:
        return ""
    verb = "fits" if len(left) == 1 else "fit"
    columns, states = map(_with_units, (left, units.items()))
    return (
        f"{columns} {verb} no state of {title} ({states}) by its unit and is not "
        "used; you can change this in part 1."
    )


def _with_units(pairs: Iterable[tuple[str, str]]) -> str:
    return ", ".join(f"{name} in {unit}" if unit else name for name, unit in pairs)


def _is_same_unit(one: str, other: str) -> bool:
    """Whether two units are of one quantity: m and mm are."""
    if not one or not other:
        return False
    are_lengths = one in LENGTHS and other in LENGTHS
    return are_lengths or plain_unit(one) == plain_unit(other)
