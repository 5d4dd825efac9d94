"""The connected tanks of the thesis with a leak or a clogged pipe.

The size of a fault is set by its change of the training runs, because nearly nothing of
the healthy model is free to follow it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.battery.masses import (
    N_RUNS,
    TRAINING,
    is_accepted,
    samples,
    shows_held_out,
)
from problems.battery.records import Aim, Array, Case, Truth, searched
from problems.thesis.systems import (
    AREA,
    DAMPING,
    DENSITY,
    FLOWS,
    GRAVITY,
    INERTIA,
    LEVELS,
    tank_matrix,
    tank_structure,
)

STATES = FLOWS + LEVELS
TIMES = np.linspace(0.0, 0.6, 61)
RTOL = 1e-9
QUICK_RTOL = 1e-6  # where a size is searched


@dataclass(frozen=True)
class Fault:
    """What leaves a tank with the level y per second; what slows a pipe with the flow
    y (momentum).

    ``law``: from size, brim and y; ``power`` of y in it; ``largest`` size.
    """

    in_pipe: bool
    law: Callable[[float, float, Array], Array]
    power: float
    largest: float


FAULTS = {
    "linear leak": Fault(False, lambda s, brim, y: s * y, 1, 2.0),
    "turbulent leak": Fault(
        False, lambda s, brim, y: s * np.sqrt(np.maximum(y, 0.0)), 0.5, 2.0
    ),
    "overflow": Fault(False, lambda s, brim, y: s * np.maximum(y - brim, 0.0), 1, 20.0),
    "viscous damping": Fault(True, lambda s, brim, y: s * y, 1, 30.0),
    "quadratic drag": Fault(True, lambda s, brim, y: s * np.abs(y) * y, 2, 300),
}


def tank_states(
    starts: Array,
    times: Array,
    name: str = "",
    at: int = 0,
    size: float = 0.0,
    brim: float = 0.0,
    rtol: float = RTOL,
) -> Array:
    """States (n_times, n_trajectories, 9) with the fault of that name in a state."""
    matrix = tank_matrix()

    def rates(t: float, flat: Array) -> Array:
        x = flat.reshape(starts.shape)
        dx = x @ matrix.T
        if name:
            dx[..., at] -= FAULTS[name].law(size, brim, x[..., at])
        return dx.ravel()

    solved = solve_ivp(
        rates,
        (times[0], times[-1]),
        starts.ravel(),
        method="DOP853",
        t_eval=times,
        rtol=rtol,
        atol=rtol,
        max_step=times[1] - times[0],
    )
    return solved.y.T.reshape(len(times), *starts.shape)


def tanks_model(known_pipes: bool) -> ph.PseudoHamiltonian:
    """Healthy tanks: areas and inertia known, the gravity term free; losses of the
    pipes known, or free.
    """
    energy = [f"{flow}**2/(2*{INERTIA})" for flow in FLOWS]
    energy += [f"g*{level}**2/2" for level in LEVELS]
    losses = ph.damping(*FLOWS)
    if known_pipes:
        losses = {}
        for i, flow in enumerate(FLOWS):
            losses[flow] = ph.formula(f"r{i}", **{f"r{i}": float(DAMPING[i])})
    return ph.PseudoHamiltonian(
        states=STATES,
        S=tank_structure(),
        H=ph.formula(" + ".join(energy), g=ph.Parameter(9.0, lower=0.0)),
        R=losses,
        kind=dict.fromkeys(FLOWS, "mechanical") | dict.fromkeys(LEVELS, "hydraulic"),
    )


def tanks_case(
    rng: np.random.Generator, effects: tuple[str, ...], aim: Aim
) -> Case | None:
    """A fault in a random pipe or tank; None where it does not show."""
    name = str(rng.choice(effects))
    fault = FAULTS[name]
    at = int(rng.integers(5)) if fault.in_pipe else 5 + int(rng.integers(4))
    flows = rng.uniform(-0.3, 0.3, (N_RUNS, 5))
    levels = rng.uniform(0.5, 2.0, (N_RUNS, 4))  # positive
    starts = np.concatenate([flows, levels], axis=1)
    healthy = tank_states(starts, TIMES, rtol=QUICK_RTOL)
    brim = float(np.quantile(healthy[..., at], rng.uniform(0.5, 0.8)))

    def error_of(size: float) -> float:
        x = tank_states(starts[TRAINING], TIMES, name, at, size, brim, QUICK_RTOL)
        change = (x - healthy[:, TRAINING]) / x.std(axis=(0, 1))
        return float(np.sqrt(np.mean(change**2)))

    found = searched(error_of, fault.largest, aim)
    assert found is not None
    ratio = aim.ratio(found.error)
    if not is_accepted(ratio, aim):
        return None
    known_pipes = fault.in_pipe or bool(rng.random() < 0.5)
    y = np.moveaxis(tank_states(starts, TIMES, name, at, found.size, brim), 0, 1)
    if not shows_held_out(y, np.moveaxis(healthy, 0, 1)):
        return None
    # R acts on dH/dx, which is the level or flow times an effort.
    effort = 1 / INERTIA if fault.in_pipe else DENSITY * GRAVITY / AREA
    truth = Truth((name,), (STATES[at],), found.size / effort**fault.power)
    seen = tuple(range(len(STATES)))
    return Case(
        model=tanks_model(known_pipes),
        truths=(truth,),
        hidden=name,
        noise=aim.noise,
        ratio=ratio,
        **samples(rng, y, aim.noise, TIMES, STATES, seen),
    )
