"""The cases of the tanks: a leak or a clogged pipe in the network of the thesis."""

from dataclasses import replace

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.calibration import next_size, shows_held_out
from problems.hidden_effects.rows import Aim, Case, Row, Truth
from problems.hidden_effects.truth import CLOGS, Array, Hidden, tank_states
from problems.thesis.systems import (
    AREA,
    DAMPING,
    DENSITY,
    FLOWS,
    GRAVITY,
    INERTIA,
    LEVELS,
    tank_structure,
)

N_TANK_TRAIN, N_TANK_TEST, TANK_TIMES = 3, 2, np.linspace(0.0, 0.6, 61)


TANK_LIMITS = {
    "linear leak": 2.0,
    "turbulent leak": 2.0,
    "overflow": 20.0,
    "viscous damping": 30.0,
    "quadratic drag": 300,
}


def tank_matrix() -> Array:
    loss = np.diag(np.r_[DAMPING, np.zeros(4)])
    return (tank_structure() - loss) @ np.diag(
        np.r_[np.full(5, 1 / INERTIA), np.full(4, DENSITY * GRAVITY / AREA)]
    )


def tanks_model(known_pipes: bool) -> ph.PseudoHamiltonian:
    """Healthy tanks: areas and inertia known, the gravity term free; losses of the
    pipes known, or free.
    """
    text = " + ".join(
        [f"{x}**2/(2*{INERTIA})" for x in FLOWS] + [f"g*{x}**2/2" for x in LEVELS]
    )
    known = {
        x: ph.formula(f"r{i}", **{f"r{i}": float(DAMPING[i])})
        for i, x in enumerate(FLOWS)
    }
    return ph.PseudoHamiltonian(
        states=FLOWS + LEVELS,
        S=tank_structure(),
        H=ph.formula(text, g=ph.Parameter(9.0, lower=0.0)),
        R=known if known_pipes else ph.damping(*FLOWS),
    )


def tanks_case(row: Row, seed: int, rng: np.random.Generator, aim: Aim) -> Case | None:
    name, matrix, t = str(rng.choice(row.effects)), tank_matrix(), TANK_TIMES
    pipe = name in CLOGS
    at = int(rng.integers(5)) if pipe else 5 + int(rng.integers(4))
    flows = rng.uniform(-0.3, 0.3, (N_TANK_TRAIN + N_TANK_TEST, 5))
    starts = np.concatenate(
        [flows, rng.uniform(0.5, 2.0, (len(flows), 4))], axis=1
    )  # levels are positive
    healthy = tank_states(matrix, None, starts, t, 1e-6)
    shape = {"brim": float(np.quantile(healthy[..., at], rng.uniform(0.5, 0.8)))}
    found = _tank_size(Hidden(name, at, 0.0, shape), matrix, starts, healthy, aim)
    if found is None:
        return None
    hidden, ratio = found
    known_pipes = pipe or bool(rng.random() < 0.5)
    y = np.moveaxis(tank_states(matrix, hidden, starts, t), 0, 1)
    if not shows_held_out(y, np.moveaxis(healthy, 0, 1), N_TANK_TRAIN):
        return None
    deviation = aim.noise * y[:N_TANK_TRAIN].std(axis=(0, 1))
    noises, states = deviation * rng.normal(size=y.shape), FLOWS + LEVELS

    def data(runs: Array, sigma: Array | None = None) -> ph.Measurements:
        given = (
            None if sigma is None else dict(zip(states, map(float, sigma), strict=True))
        )
        return ph.Measurements.from_arrays(
            [t] * len(runs), list(runs), states=states, noise=given
        )

    pressure = DENSITY * GRAVITY / AREA if not pipe else 1 / INERTIA
    # R acts on dH/dx, which is the level or flow times `pressure`
    powers = {
        "linear leak": 1,
        "overflow": 1,
        "turbulent leak": 0.5,
        "viscous damping": 1,
        "quadratic drag": 2,
    }
    truth = Truth(name, (states[at],), hidden.size / pressure ** powers[name])
    settings = {
        "masses": 0,
        "measured": "all",
        "input": "none",
        "free": "g" if known_pipes else "g R",
        "known": "R" if known_pipes else "",
        "n_train": N_TANK_TRAIN * len(t),
    }
    train, test = slice(0, N_TANK_TRAIN), slice(N_TANK_TRAIN, None)
    return Case(
        row,
        seed,
        tanks_model(known_pipes),
        data((y + noises)[train]),
        data((y + noises)[test]),
        data(y[train], deviation),
        deviation,
        noises[test],
        aim.noise,
        (truth,),
        settings,
        aim.target,
        ratio,
    )


def _tank_size(
    hidden: Hidden, matrix: Array, starts: Array, healthy: Array, aim: Aim
) -> tuple[Hidden, float] | None:
    """The size of a fault by its change of the training runs; nearly nothing of the
    healthy model is free to follow.
    """
    wanted, largest = aim.wanted, TANK_LIMITS[hidden.name]
    train, size, points = (
        slice(0, N_TANK_TRAIN),
        TANK_LIMITS[hidden.name] / 8,
        [(0.0, 0.0)],
    )
    for _ in range(6):
        x = tank_states(
            matrix, replace(hidden, size=size), starts[train], TANK_TIMES, 1e-6
        )
        error = float(
            np.sqrt(np.mean(((x - healthy[:, train]) / x.std(axis=(0, 1))) ** 2))
        )
        points.append((size, error))
        if 0.8 * wanted < error < 1.25 * wanted or (size >= largest and error < wanted):
            break
        size = min(next_size(points, wanted), largest)
    ratio = float(np.sqrt(1 + (error / aim.noise) ** 2))
    return (
        (replace(hidden, size=points[-1][0]), ratio)
        if 0.9 * aim.least <= ratio <= 1.4 * aim.target
        else None
    )
