"""Names in formulas that nobody has explained: parameters, or slips of the pen."""

from phsi_opt.errors import ModelError
from phsi_opt.model.expressions import names_of
from phsi_opt.model.variables import Variables
from phsi_opt.page.drafts import FIRST_ORDER, ModelDraft


def unknown_names(draft: ModelDraft) -> list[str]:
    """The names that are neither variables nor parameters, each once."""
    variables = Variables(tuple(draft.state_names), tuple(draft.input_names))
    known = {one.name for one in draft.parameters}
    found: dict[str, None] = {}
    for slot, formula in _formulas(draft):
        try:
            names = names_of(formula)
        except ModelError:
            continue  # the check says what is wrong with it
        for name in sorted(names - variables.of_slot(slot) - known):
            found[name] = None
    return list(found)


def _formulas(draft: ModelDraft) -> list[tuple[str, str]]:
    """The formulas that are written as such, with their slots."""
    listed = []
    if draft.type != FIRST_ORDER:
        listed.append(("H", draft.H))
    for name in draft.state_names:
        listed.append(("R", draft.R.get(name, "")))
        listed.append(("F", draft.F.get(name, "")))
    return [one for one in listed if one[1].strip() and one[1].strip()[0] not in "{["]
