"""TODO."""

from collections.abc import Mapping

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.model import FirstOrder, Model


def position_of(model: Model) -> dict[str, str]:
    """Position q of each momentum p of a canonical pair."""
    found = {}
    for i in positions(model):
        (j,) = (j for j, s in enumerate(model.S[i]) if s)
        found[model.states[j]] = model.states[i]
    return found


def is_storage(model: Model, name: str, moved_by: Mapping[str, str]) -> bool:
    outside = (
        name not in moved_by
        and name not in moved_by.values()
        and name not in model.memory
    )
    return outside and (
        isinstance(model, FirstOrder) or name not in moving_states(model)
    )


def moving_states(model: Model) -> set[str]:
    """Equations outside the canonical pairs that lose energy already: flows and speeds,
    rather than storages.
    """
    return set(model.R) if not isinstance(model, FirstOrder) else set(model.states)


def canonical(n: int) -> np.ndarray:
    """The canonical structure matrix [[0, I], [-I, 0]] of n positions, then n momenta
    (thesis Eq. 2.25).
    """
    if not isinstance(n, int) or n < 1:
        raise ModelError(
            f"canonical({n!r}): n is the number of positions, a whole number of at least 1."
        )
    zero, one = np.zeros((n, n)), np.eye(n)
    return np.block([[zero, one], [-one, zero]])


def positions(model: Model) -> tuple[int, ...]:
    """States that are positions of a canonical pair: their equation dq/dt = dH/dp is
    kinematics and lacks no force.
    """
    S = np.array(model.S)
    found = []
    for i, row in enumerate(S):
        (partners,) = np.nonzero(row)
        if (
            len(partners) == 1
            and row[partners[0]] > 0
            and np.count_nonzero(S[partners[0]]) == 1
        ):
            found.append(i)
    return tuple(found)


def forced_rows(model: Model) -> tuple[int, ...]:
    """Equations in which a force may be missing: all but those of positions and of an
    effect's memory.
    """
    kinematic = positions(model)
    return tuple(
        i
        for i, name in enumerate(model.states)
        if i not in kinematic and name not in model.memory
    )
