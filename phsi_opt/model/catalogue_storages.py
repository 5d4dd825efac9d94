"""A storage that nobody measures beside one that the model has, as a term of F.

The walls behind the air of a room, the charge deep inside the electrodes of a cell: a
part of what a model holds for one storage takes time to follow.
"""

from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_parts import one_term, tried, underscored
from phsi_opt.model.effect import Effect
from phsi_opt.model.roles import Role, role_of
from phsi_opt.model.terms import formula

STORAGES = {Role.HEAT: "second heat storage", Role.CIRCUIT: "second charge storage"}
FAMILY = "a storage that nobody measures"
# Times in which it follows, to try, as shares of the longest record; what takes longer
# than the record is told from a constant by nothing. A re-fit begins at the one in the
# middle: a second storage that follows soon is hardly different from the first, and a
# solver finds its way from there (a house and a cell: from 0.002 and 0.01; from 0.05
# and 0.2, where the exchange begins at zero, the cell's ended there).
FOLLOWING_TIMES = (0.002, 0.003, 0.005, 0.01, 0.03, 0.1, 0.3)


def second_storages(model: BaseModel, state: str) -> list[Effect]:
    """A second storage z beside the state x, in the words of its field.

    ::

        dx/dt = ... + c (z - x),  tau dz/dt = x - z

    With the capacities C1 and C2 and a resistance R between the two, c = 1/(R C1) and
    tau = R C2, so that C2/C1 = c tau. What the model had for both before is now for the
    first alone.

    Args:
        model: the model.
        state: in whose equation it acts.
    """
    role = role_of(model, state)
    if role not in STORAGES or state in model.memory:
        return []
    name = STORAGES[role]
    second = f"{state}_second"
    tau = f"following_time_{state}"
    inner = {tau: tried("t", FOLLOWING_TIMES, most=1.0, unit="s")}
    memory = {second: formula(f"({state} - {second})/{tau}", **inner)}
    exchange = f"{underscored(name)}_{state}"
    term = one_term(f"({second} - {state})", exchange, lower=0.0)
    return [Effect(name, "F", state, term, memory, FAMILY)]


def is_second_storage(effect: Effect) -> bool:
    """Whether an effect splits a storage in two.

    With half of it gone, the capacity that the model had means another thing. So a
    linearisation of the model without the effect says nothing about it: it expected
    none of a house and of a cell in which a re-fit explains 39 and 77 % of the squared
    error above the noise floor.
    """
    return effect.family == FAMILY
