"""A mass that a controller moves: its force is measured, its friction is hidden.

The controller answers the motion at every sample, so force, speed and input go
together.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

import phsi_opt as ph
from problems.field_machines.laws import coulomb, viscous
from problems.field_machines.records import Array, Experiment, Values
from problems.hidden_effects.machines import log_uniform

N_SAMPLES = 160
N_RUNS = 4
N_TRAIN = 3
N_MOVES = (2.0, 3.0)  # periods of the reference in a run
DAMPING = 0.7  # of the closed loop
# Friction over the largest inertial force of the reference.
FRICTION = (0.2, 0.8)


def closed_loop(rng: np.random.Generator) -> Experiment:
    """Proportional and differential control along two sines; the position is
    measured.
    """
    mass = float(log_uniform(rng, 0.5, 5.0))
    slow = float(log_uniform(rng, 1.0, 4.0))  # frequency of the reference
    stiff = slow * rng.uniform(3.0, 5.0)  # of the closed loop
    gain = mass * stiff**2
    rate_gain = 2 * DAMPING * mass * stiff
    sizes = rng.uniform(0.5, 1.0, (N_RUNS, 2)) * np.array([1.0, 0.3])
    phases = rng.uniform(0, 2 * np.pi, (N_RUNS, 2))
    frequencies = slow * np.array([1.0, 2.3])

    def reference(t: float) -> Array:
        return np.sum(sizes * np.sin(frequencies * t + phases), axis=1)

    def control(t: float, x: Array) -> Array:
        force = gain * (reference(t) - x[:, 0]) - rate_gain * x[:, 1] / mass
        return force[:, None]

    speed = float(np.sqrt(np.mean((sizes * frequencies) ** 2)))
    force = mass * slow**2 * float(sizes[:, 0].mean())
    if rng.random() < 0.5:
        hidden = viscous(mass, FRICTION[1] * force / speed)
    else:
        hidden = coulomb(mass, speed, FRICTION[1] * force)
    least = hidden.largest * FRICTION[0] / FRICTION[1]
    t = np.linspace(0.0, rng.uniform(*N_MOVES) * 2 * np.pi / slow, N_SAMPLES)
    starts = np.stack([reference(0.0), np.zeros(N_RUNS)], axis=1)

    def rates(x: Array, u: Array, values: Values) -> Array:
        v = x[..., 1] / values["m"]
        return np.stack([v, np.broadcast_to(u[..., 0], v.shape)], axis=-1)

    def model(given: Mapping[str, float]) -> ph.Model:
        H = ph.formula("p**2/(2*m)", m=ph.Parameter(given["m"], lower=0.0))
        return ph.PseudoHamiltonian(
            states=["q", "p"],
            inputs=["u"],
            S=ph.canonical(1),
            H=H,
            F={"p": ph.formula("u")},
        )

    return Experiment(
        states=("q", "p"),
        seen=(0,),
        rates=rates,
        values={"m": mass},
        model=model,
        hidden=replace(hidden, least=least, is_drawn=True),
        t=t,
        starts=starts,
        n_train=N_TRAIN,
        row=1,
        time=2 * np.pi / slow,
        inputs=("u",),
        input_at=control,
        hold="zero",
        is_sampled=True,
        loudest=np.inf,
    )
