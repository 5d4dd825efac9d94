"""The equations of a model as text, with the names of its parameters."""

from collections.abc import Callable

from phsi_opt.model.base import BaseModel
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Term
from phsi_opt.presentation.summary import Part, Summary, printed_table

SHOWN_OF_MODEL = ("name", "value", "known", "lower", "upper", "unit")


def model_summary(model: BaseModel) -> Summary:
    """What a model says of itself: its equations, and its parameters in a table."""
    title = f"{type(model).__name__}: states {', '.join(model.states)}"
    if model.inputs:
        title += f"; inputs {', '.join(model.inputs)}"
    rows = [*structure_rows(model), *dictionary_rows(model, _term)]
    parts = [Part(code="\n".join(rows))]
    listed = []
    for name, entry in model.entries.items():
        parameter = entry.parameter
        known = "yes" if parameter.fixed else "no"
        bounds = (parameter.lower, parameter.upper)
        listed.append((name, parameter.start, known, *bounds, parameter.unit))
    if listed:
        table = printed_table(listed, columns=list(SHOWN_OF_MODEL))
        parts.append(Part("parameters", table=table))
    return Summary(title, tuple(parts))


def dictionary_rows(
    model: BaseModel, written: Callable[[Term, str, int], str]
) -> list[str]:
    """Every dictionary of the model that has terms: F_p = c1*q + c2*q**3.

    Args:
        model: the model.
        written: a term, the name of its place, its number there -> its text.
    """
    rows = []
    places = dict.fromkeys((slot, equation) for slot, equation, _ in model.placed())
    for slot, equation in places:
        place = place_of(slot, equation)
        terms = [
            written(term, place, number)
            for number, term in enumerate(model.terms_at(slot, equation), start=1)
        ]
        rows.append(f"{place} = {' + '.join(terms)}")
    return rows


def _term(term: Term, place: str, number: int) -> str:
    """A term; a coefficient without a name of its own has the term's number."""
    if term.is_formula:
        return term.body
    coefficient = term.name or f"c{number}"
    return coefficient if term.body == "1" else f"{coefficient}*{term.body}"


def structure_rows(model: BaseModel) -> list[str]:
    """An equation per state in the names of the slots: dp/dt = - dH_dq - R_p*dH_dp."""
    rows = []
    for i, state in enumerate(model.states):
        parts = []
        for entry, other in zip(model.S[i], model.states, strict=True):
            if entry:
                sign = "+" if entry > 0 else "-"
                factor = "" if abs(entry) == 1 else f"{abs(entry):g}*"
                parts.append(f"{sign} {factor}dH_d{other}")
        if state in model.R:
            effort = f"dH_d{state}" if model.H.terms else state
            parts.append(f"- R_{state}*{effort}")
        if state in model.F:
            parts.append(f"+ F_{state}")
        right_hand_side = " ".join(parts).removeprefix("+ ") or "0"
        rows.append(f"d{state}/dt = {right_hand_side}")
    return rows
