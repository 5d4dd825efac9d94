"""Where the energy of a simulated motion came from and where it went."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model


@dataclass(frozen=True)
class EnergyBalance:
    """Energies over one trajectory, in the unit of H.

    The change is that of H along the states; for a solution of the model it is supplied
    less dissipated.
    """

    change: float
    supplied: float
    dissipated: float


def energy_balance(
    model: Model, x: np.ndarray, t: np.ndarray, u: np.ndarray
) -> EnergyBalance:
    """Integrate dH/dt = F . grad H - grad H . R grad H along states, by trapezoids.

    Args:
        model: with the values of its parameters.
        x: states, (n_samples, n_states).
        t: times, (n_samples,).
        u: inputs, (n_samples, n_inputs).
    """
    state = ca.SX.sym("x", model.n_states)
    control = ca.SX.sym("u", model.n_inputs)
    time = ca.SX.sym("t")
    parts = model.expressions(
        [state[i] for i in range(model.n_states)],
        [control[i] for i in range(model.n_inputs)],
        time,
        model.values,
    )
    supplied = ca.SX(0)
    for force, effort in zip(parts.force, parts.efforts, strict=True):
        supplied = supplied + force * effort
    dissipated = ca.SX(0)
    for loss, effort in zip(parts.loss, parts.efforts, strict=True):
        dissipated = dissipated + loss * effort**2
    outputs = [ca.SX(parts.energy), supplied, dissipated]
    function = ca.Function("powers", [state, control, time], outputs)
    rows = function.map(len(t))(x.T, u.T, t[None, :])
    energy, power_in, power_out = (np.array(row).ravel() for row in rows)
    return EnergyBalance(
        change=float(energy[-1] - energy[0]),
        supplied=float(np.trapezoid(power_in, t)),
        dissipated=float(np.trapezoid(power_out, t)),
    )
