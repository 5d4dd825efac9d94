"""The gallery in the page: columns become the states and inputs of a base model."""

from phsi_opt.page.drafts import NOT_USED, DataDraft, ModelDraft, StudyDraft
from phsi_opt.study_file.columns import INPUT, STATE
from phsi_opt.study_file.gallery import GALLERY, BaseModel, matched, with_units


def draft_of(base: BaseModel, data: DataDraft | None) -> ModelDraft:
    """A fresh draft; its inputs are those of the data, after `match_states`."""
    inputs = [one.name for one in data.with_role(INPUT)] if data else []
    draft = ModelDraft.of(*base.sections(inputs), base.name)
    for one in draft.parameters:
        one.is_assumed = one.is_known
    return draft


def match_states(data: DataDraft, base: BaseModel) -> BaseModel:
    """Let columns be states of the model, inputs that it lacks, or unused.

    Returns:
        The model, in position and velocity if that was measured.
    """
    for column in data.columns:
        if column.fits_no_state and column.role == NOT_USED:
            column.role = STATE
        column.fits_no_state = False
    columns = data.with_role(STATE)
    base = base.seen_by(columns)
    data.unmeasured = base.units
    for role, units in base.places:
        own = data.with_role(role)
        may_be = own + columns if role == INPUT else columns
        for column, name in matched(may_be, units, own.__contains__):
            column.table["name"] = name
            data.unmeasured.pop(name, None)
            if column in columns:
                columns.remove(column)
            if column.role != role:
                column.becomes(role)
    for column in columns:
        column.role = NOT_USED
        column.fits_no_state = True
    return base


def left_over(draft: StudyDraft) -> str:
    """Which columns fit no state of the base model, in a sentence; "" where all do."""
    base = GALLERY.get(draft.model.title)
    columns = draft.data.columns if draft.data else []
    base = base and base.seen_by(columns)
    left = {one.title: one.unit for one in columns if one.fits_no_state}
    if not left or base is None:
        return ""
    verb = "fits" if len(left) == 1 else "fit"
    told, states = map(with_units, (left, base.units))
    return (
        f"{told} {verb} no state of {base.title} ({states}) by its unit and is not "
        "used; you can change this in part 1."
    )
