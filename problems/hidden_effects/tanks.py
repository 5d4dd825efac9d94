"""The cases of the tanks: a leak or a clogged pipe in the network of the thesis.

The size of a fault is set by its change of the training runs, because nearly nothing of
the healthy model is free to follow it.
"""

from dataclasses import replace

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.calibration import (
    TRIALS,
    Calibrated,
    Trial,
    is_accepted,
    is_enough,
    next_size,
    ratio_of,
    shows_held_out,
)
from problems.hidden_effects.rows import N_TEST, N_TRAIN, Aim, Case, Draw, Truth
from problems.hidden_effects.samples import HELD_OUT, TRAINING, Samples
from problems.hidden_effects.truth import CLOGS, Array, Hidden, tank_states
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

N_RUNS = N_TRAIN + N_TEST
STATES = FLOWS + LEVELS
TIMES = np.linspace(0.0, 0.6, 61)
QUICK_RTOL = 1e-6  # where a size is searched
# Largest sizes of the faults.
LIMITS = {
    "linear leak": 2.0,
    "turbulent leak": 2.0,
    "overflow": 20.0,
    "viscous damping": 30.0,
    "quadratic drag": 300,
}
# Powers of the level or flow in the faults.
POWERS = {
    "linear leak": 1,
    "overflow": 1,
    "turbulent leak": 0.5,
    "viscous damping": 1,
    "quadratic drag": 2,
}


def tanks_model(known_pipes: bool) -> ph.PseudoHamiltonian:
    """Healthy tanks: areas and inertia known, the gravity term free; losses of the
    pipes known, or free.
    """
    kinetic = [f"{flow}**2/(2*{INERTIA})" for flow in FLOWS]
    potential = [f"g*{level}**2/2" for level in LEVELS]
    losses = ph.damping(*FLOWS)
    if known_pipes:
        losses = {}
        for i, flow in enumerate(FLOWS):
            losses[flow] = ph.formula(f"r{i}", **{f"r{i}": float(DAMPING[i])})
    gravity = ph.Parameter(9.0, lower=0.0)
    return ph.PseudoHamiltonian(
        states=STATES,
        S=tank_structure(),
        H=ph.formula(" + ".join([*kinetic, *potential]), g=gravity),
        R=losses,
        kind=dict.fromkeys(FLOWS, "mechanical") | dict.fromkeys(LEVELS, "hydraulic"),
    )


def tanks_case(draw: Draw) -> Case | None:
    """A fault in a random pipe or tank; None where it does not show."""
    rng = draw.rng
    matrix = tank_matrix()
    name = str(rng.choice(draw.row.effects))
    in_pipe = name in CLOGS
    at = int(rng.integers(5)) if in_pipe else 5 + int(rng.integers(4))
    flows = rng.uniform(-0.3, 0.3, (N_RUNS, 5))
    levels = rng.uniform(0.5, 2.0, (N_RUNS, 4))  # positive
    starts = np.concatenate([flows, levels], axis=1)
    healthy = tank_states(matrix, None, starts, TIMES, QUICK_RTOL)
    brim = float(np.quantile(healthy[..., at], rng.uniform(0.5, 0.8)))
    fault = Hidden(name, at, 0.0, {"brim": brim})
    found = _calibrated(fault, matrix, starts, healthy, draw.aim)
    if found is None:
        return None
    known_pipes = in_pipe or bool(rng.random() < 0.5)
    y = np.moveaxis(tank_states(matrix, found.hidden, starts, TIMES), 0, 1)
    if not shows_held_out(y, np.moveaxis(healthy, 0, 1), N_TRAIN):
        return None
    every = tuple(range(len(STATES)))
    samples = Samples.drawn(rng, y, draw.aim.noise, TIMES, STATES, every)
    return Case(
        row=draw.row,
        seed=draw.seed,
        model=tanks_model(known_pipes),
        train=samples.noisy(TRAINING),
        test=samples.noisy(HELD_OUT),
        clean=samples.without_noise(TRAINING),
        sigma=samples.sigma,
        test_noise=samples.noise[HELD_OUT],
        noise=draw.aim.noise,
        truths=(_truth(found.hidden),),
        settings=_settings(known_pipes),
        target=draw.aim.target,
        base_ratio=found.ratio,
    )


def _truth(hidden: Hidden) -> Truth:
    """R acts on dH/dx, which is the level or flow times an effort."""
    effort = 1 / INERTIA if hidden.name in CLOGS else DENSITY * GRAVITY / AREA
    coefficient = hidden.size / effort ** POWERS[hidden.name]
    return Truth(hidden.name, (STATES[hidden.at],), coefficient)


def _settings(known_pipes: bool) -> dict[str, object]:
    """What is kept of a setting in the tables."""
    return {
        "masses": 0,
        "measured": "all",
        "input": "none",
        "free": "g" if known_pipes else "g R",
        "known": "R" if known_pipes else "",
        "n_train": N_TRAIN * len(TIMES),
    }


def _calibrated(
    fault: Hidden, matrix: Array, starts: Array, healthy: Array, aim: Aim
) -> Calibrated | None:
    """The fault at the size whose change of the training runs meets the aim.

    ``healthy``: states (n_times, n_runs, 9) without it.
    """
    largest = LIMITS[fault.name]
    size = largest / 8
    trials = [Trial(0.0, 0.0)]
    for _ in range(TRIALS):
        faulty = replace(fault, size=size)
        x = tank_states(matrix, faulty, starts[TRAINING], TIMES, QUICK_RTOL)
        change = (x - healthy[:, TRAINING]) / x.std(axis=(0, 1))
        trials.append(Trial(size, float(np.sqrt(np.mean(change**2)))))
        if is_enough(trials[-1], aim, largest):
            break
        size = min(next_size(trials, aim.wanted), largest)
    ratio = ratio_of(trials[-1].error, aim)
    if not is_accepted(ratio, aim):
        return None
    return Calibrated(replace(fault, size=trials[-1].size), ratio)
