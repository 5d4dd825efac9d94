"""Which state is what: positions and momenta of canonical pairs, storages, flows.

The physics is read from the structure matrix S and from where the model loses energy.
A row of S with one entry, dq/dt = dH/dp, makes q the position of the momentum p. What
lies outside such pairs is a storage (a tank, a capacitor) or a flow (a pipe, a coil);
where the model does not tell which, a state counts as both.
"""

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.base import BaseModel


def canonical(n: int) -> np.ndarray:
    """The canonical structure matrix [[0, I], [-I, 0]] (thesis Eq. 2.25).

    Args:
        n: number of positions, and of momenta; the states are positions, then momenta.

    Returns:
        The skew-symmetric matrix, (2 n, 2 n).

    Raises:
        ModelError: n is not a whole number of at least 1.
    """
    if not isinstance(n, int) or n < 1:
        raise ModelError(
            f"canonical({n!r}): n is the number of positions, "
            "a whole number of at least 1."
        )
    zero = np.zeros((n, n))
    one = np.eye(n)
    return np.block([[zero, one], [-one, zero]])


def position_rows(model: BaseModel) -> tuple[int, ...]:
    """Indices of the states that are positions of a canonical pair.

    Their equation dq/dt = dH/dp is kinematics and lacks no force.
    """
    S = np.array(model.S)
    rows = range(len(S))
    return tuple(row for row in rows if _is_position(S, row))


def _is_position(S: np.ndarray, row: int) -> bool:
    """Whether the row is dq/dt = dH/dp of a p that is coupled to no other state."""
    (partners,) = np.nonzero(S[row])
    if len(partners) != 1:
        return False
    (momentum,) = partners
    return bool(S[row, momentum] > 0 and np.count_nonzero(S[momentum]) == 1)


def position_of_momentum(model: BaseModel) -> dict[str, str]:
    """Name of the position q of each momentum p of a canonical pair."""
    pairs = {}
    for row in position_rows(model):
        (momentum,) = np.flatnonzero(model.S[row]).tolist()
        pairs[model.states[momentum]] = model.states[row]
    return pairs


def forced_rows(model: BaseModel) -> tuple[int, ...]:
    """Indices of the equations in which a force may be missing.

    These are all but the equations of positions and of an effect's memory.
    """
    kinematic = position_rows(model)
    rows = []
    for row, name in enumerate(model.states):
        if row not in kinematic and name not in model.memory:
            rows.append(row)
    return tuple(rows)


def effort_of(model: BaseModel, state: str) -> str:
    """Name of a state's effort in formulas: dH/dx, or the state without an energy."""
    return f"dH_d{state}" if model.has_energy else state


def flow_states(model: BaseModel) -> tuple[str, ...]:
    """States outside the canonical pairs that may be flows or speeds.

    They lose energy already; in a model without energy any state may be one.
    """
    unpaired = _unpaired_states(model)
    if not model.has_energy:
        return unpaired
    return tuple(name for name in unpaired if name in model.R)


def storage_states(model: BaseModel) -> tuple[str, ...]:
    """States outside the canonical pairs that may be storages, such as tanks.

    They do not lose energy yet; in a model without energy any state may be one.
    """
    unpaired = _unpaired_states(model)
    if not model.has_energy:
        return unpaired
    return tuple(name for name in unpaired if name not in model.R)


def _unpaired_states(model: BaseModel) -> tuple[str, ...]:
    """States that are neither position nor momentum nor an effect's memory."""
    pairs = position_of_momentum(model)
    paired = {*pairs.keys(), *pairs.values(), *model.memory}
    return tuple(name for name in model.states if name not in paired)
