"""Which column is which state of a base model, guessed from units and order."""

from collections.abc import Callable, Mapping

from phsi_opt.model.kinds import LENGTHS, plain_unit
from phsi_opt.page.drafts import NOT_USED, STATE, ColumnDraft, DataDraft


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
    columns = data.with_role(STATE)
    free = list(units)
    left = []
    for column in columns:
        name = _first(column, free, units, is_same_unit)
        if name is None:
            left.append(column)
            continue
        column.name = name
        free.remove(name)
    for column in left:
        name = _first(column, free, units, _is_open)
        if name is None:
            column.role = NOT_USED
            column.fits_no_state = True
            continue
        column.name = name
        free.remove(name)
    data.unmeasured = {name: units[name] for name in free}


def left_over(data: DataDraft, title: str, units: Mapping[str, str]) -> str:
    """Which columns fit no state of a model, in a sentence; "" where all do."""
    left = [one for one in data.columns if one.fits_no_state]
    if not left:
        return ""
    columns = [_with_unit(str(one.column), one.unit) for one in left]
    states = [_with_unit(name, unit) for name, unit in units.items()]
    verb = "fits" if len(left) == 1 else "fit"
    return (
        f"{', '.join(columns)} {verb} no state of {title} ({', '.join(states)}) by "
        "its unit and is not used; part 1 can say otherwise."
    )


def _with_unit(name: str, unit: str) -> str:
    return f"{name} in {unit}" if unit else name


def _first(
    column: ColumnDraft,
    free: list[str],
    units: Mapping[str, str],
    agrees: Callable[[str, str], bool],
) -> str | None:
    for name in free:
        if agrees(column.unit, units[name]):
            return name
    return None


def is_same_unit(one: str, other: str) -> bool:
    """Whether two units are of one quantity: m and mm are."""
    if not one or not other:
        return False
    are_lengths = one in LENGTHS and other in LENGTHS
    return are_lengths or plain_unit(one) == plain_unit(other)


def _is_open(one: str, other: str) -> bool:
    return not one or not other
