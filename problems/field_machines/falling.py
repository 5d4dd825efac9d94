"""Falling bodies: the height is measured, the drag is hidden."""

from collections.abc import Mapping

import numpy as np

import phsi_opt as ph
from problems.field_machines.laws import quadratic, viscous
from problems.field_machines.records import Array, Experiment, Values
from problems.hidden_effects.machines import log_uniform

GRAVITY = 9.81
N_SAMPLES = 120  # of the highest drop
N_TRAIN = 3
# Terminal speed over the speed at the ground without drag, at least.
SLOWEST = 0.4


def falling(rng: np.random.Generator, is_heavy: bool | None = None) -> Experiment:
    """Drops from several heights; a heavy ball's drag is below the noise.

    ``is_heavy``: None: three in ten.
    """
    mass = float(log_uniform(rng, 0.05, 2.0))
    highest = float(log_uniform(rng, 3.0, 40.0))
    shares = np.array([1.0, rng.uniform(0.6, 0.8), rng.uniform(0.4, 0.6), 0.9])
    heights = highest * shares
    speed = float(np.sqrt(2 * GRAVITY * highest))
    duration = speed / GRAVITY
    t = np.linspace(0.0, duration, N_SAMPLES)
    n_kept = tuple(int(N_SAMPLES * np.sqrt(share)) for share in shares)
    starts = np.stack([heights, 0.02 * mass * speed * rng.normal(size=4)], axis=1)
    slowest = SLOWEST * speed
    if rng.random() < 0.5:
        hidden = viscous(mass, mass * GRAVITY / slowest)
    else:
        hidden = quadratic(mass, mass * GRAVITY / slowest**2)
    knows_gravity = rng.random() < 0.5
    drawn_heavy = rng.random() < 0.3

    def rates(x: Array, u: Array, values: Values) -> Array:
        weight = mass * values.get("g", GRAVITY)
        force = np.zeros_like(x[..., 1]) - weight
        return np.stack([x[..., 1] / mass, force], axis=-1)

    def model(given: Mapping[str, float]) -> ph.Model:
        energy = f"{mass!r}*g*h + p**2/(2*{mass!r})"
        g = GRAVITY if knows_gravity else ph.Parameter(given["g"], lower=0.0)
        H = ph.formula(energy, g=g)
        return ph.PseudoHamiltonian(states=["h", "p"], S=ph.canonical(1), H=H)

    return Experiment(
        states=("h", "p"),
        seen=(0,),
        rates=rates,
        values={} if knows_gravity else {"g": GRAVITY},
        model=model,
        hidden=hidden,
        t=t,
        starts=starts,
        n_train=N_TRAIN,
        row=1,
        time=duration,
        n_kept=n_kept,
        is_faint=drawn_heavy if is_heavy is None else is_heavy,
    )
