"""What acts between two states: hidden couplings of bodies, rooms and tanks.

    python -m problems.judges.couplings [--first=SEED] [--cases=N]

Drawn by seed, 1 or 3 % of noise, half of the machines shaken by a random force of 5 %
of the first rates. A study goes on by itself, as in `searches`, which says what is
right; where nothing is hidden, a study that names nothing is. Seeds from 79200 on are
reported.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.judges.searches import Case, Draw, report

FIRST = 79_200
SHAKEN = 0.05  # of the first rates
FINE = 8  # steps of a simulation between two samples
Rates = Callable[[np.ndarray, np.ndarray], np.ndarray]


def simulated(
    rng: np.random.Generator,
    rates: Rates,
    start: np.ndarray,
    u: np.ndarray,
    h: float,
    shaken: tuple[int, ...] = (-2, -1),
) -> np.ndarray:
    """States at the samples, (n, n_states), of held inputs u (n, n_inputs).

    By Runge and Kutta's steps; in every second run a force that lasts some samples
    shakes some equations, by default the last two.
    """
    places = list(shaken)
    size = np.zeros(len(start))
    size[places] = SHAKEN * rng.integers(2)
    size *= np.abs(rates(start, u[0]))[places].max()
    x = np.empty((len(u), len(start)))
    x[0] = start
    force = np.zeros(len(start))
    dt = h / FINE
    for k in range(len(u) - 1):
        force = 0.8 * force + 0.6 * size * rng.standard_normal(len(start))
        z = x[k]
        for _ in range(FINE):
            a = rates(z, u[k]) + force
            b = rates(z + dt / 2 * a, u[k]) + force
            c = rates(z + dt / 2 * b, u[k]) + force
            d = rates(z + dt * c, u[k]) + force
            z = z + dt / 6 * (a + 2 * b + 2 * c + d)
        x[k + 1] = z
    return x


def measured(
    rng: np.random.Generator,
    runs: list[np.ndarray],
    u: list[np.ndarray],
    h: float,
    **names: Any,
) -> ph.Measurements:
    """Measurements with 1 or 3 % of noise."""
    share = float(rng.choice([0.01, 0.03]))
    noise = share * np.std(np.concatenate(runs), axis=0)
    noisy = [x + noise * rng.standard_normal(x.shape) for x in runs]
    times = [h * np.arange(len(x)) for x in runs]
    given = u if u[0].size else None
    return ph.Measurements.from_arrays(times, noisy, given, **names)


def two_bodies(name: str, rng: np.random.Generator) -> Case:
    """Two bodies on springs, of which the positions are measured."""
    m1, m2, k1, k2 = rng.uniform(1, 2), rng.uniform(1, 3), *rng.uniform(0.5, 3, 2)
    k, c1, c2 = rng.uniform(0.2, 1), *rng.uniform(0.02, 0.1, 2)
    sizes = {"damper": rng.uniform(0.1, 0.4), "dry friction": rng.uniform(0.05, 0.2)}
    sizes["gyroscopic coupling"] = rng.uniform(0.2, 0.8)
    size = sizes.get(name, 0.0)

    def rates(x: np.ndarray, _: np.ndarray) -> np.ndarray:
        v1, v2 = x[2] / m1, x[3] / m2
        between = k * (x[0] - x[1])
        turned = np.zeros(2)
        if name == "damper":
            between += size * (v1 - v2)
        if name == "dry friction":
            between += size * np.tanh((v1 - v2) / 0.005)
        if name == "gyroscopic coupling":
            turned = size * np.array([v2, -v1])
        first = -k1 * x[0] - c1 * v1 - between + turned[0]
        return np.array([v1, v2, first, -k2 * x[1] - c2 * v2 + between + turned[1]])

    u = np.zeros((300, 0))
    runs = []
    for _ in range(3):
        start = rng.uniform(-1, 1, 4) * [1, 1, m1, m2]
        runs.append(simulated(rng, rates, start, u, 0.08)[:, :2])
    data = measured(rng, runs, [u] * 3, 0.08, states=["q1", "q2"])
    energy = "k1*q1**2/2 + k2*q2**2/2 + k*(q1 - q2)**2/2"
    model = ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=ph.canonical(2),
        H=f"{energy} + p1**2/(2*{m1}) + p2**2/(2*{m2})",
        R={"p1": "c1", "p2": "c2"},
    )
    if not size:
        return Case(model, data, frozenset())
    told = f"{name} between p1 and p2"
    return Case(model, data, frozenset([told]), {told: size})


def two_storages(rng: np.random.Generator, runs: int, n: int) -> list[np.ndarray]:
    """Two inputs that are switched, of each run, (n, 2)."""
    steps = rng.uniform(0.2, 2.0, (runs, n // 20, 2))
    return [np.repeat(one, 20, axis=0) for one in steps]


def rooms(rng: np.random.Generator) -> Case:
    """Two heated rooms with a wall between them, in degrees above the outside."""
    C1, C2, g1, g2, size = (
        *rng.uniform(10, 40, 2),
        *rng.uniform(0.2, 0.6, 2),
        rng.uniform(0.2, 1),
    )

    def rates(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        flow = size * (x[0] - x[1])
        first = (20 * u[0] - g1 * x[0] - flow) / C1
        return np.array([first, (5 * u[1] - g2 * x[1] + flow) / C2])

    u = two_storages(rng, 3, 300)
    runs = [simulated(rng, rates, rng.uniform(5, 30, 2), one, 1.0) for one in u]
    powers = [one * [20, 5] for one in u]
    names: dict[str, Any] = {"states": ["T1", "T2"], "inputs": ["P", "Q"]}
    names["hold"] = "zero"
    units = {"T1": "K", "T2": "K", "P": "W", "Q": "W", "t": "s"}
    data = measured(rng, runs, powers, 1.0, units=units, **names)
    model = ph.FirstOrder(
        ["T1", "T2"],
        {"T1": "(P - g1*T1)/C1", "T2": "(Q - g2*T2)/C2"},
        inputs=["P", "Q"],
        kind="thermal",
    ).with_values({"C1": 20.0, "C2": 20.0, "g1": 0.4, "g2": 0.4})
    told = "exchange of heat between T1 and T2"
    return Case(model, data, frozenset([told]), {told: size})


def tanks(name: str, rng: np.random.Generator) -> Case:
    """Two tanks with an inflow each, and a pipe between them or a rim over which."""
    a, b, size, ratio = (
        *rng.uniform(0.3, 0.6, 2),
        rng.uniform(0.2, 0.6),
        rng.uniform(0.5, 1),
    )

    def rates(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        h1, h2 = np.maximum(x, 0.0)
        flow = max(h1 - 3.0, 0.0)
        if name == "connection":
            flow = np.sign(h1 - h2) * np.sqrt(abs(h1 - h2))
        own = [u[0] - a * np.sqrt(h1), u[1] - b * np.sqrt(h2)]
        return np.array(own) + size * flow * np.array([-1.0, ratio])

    u = two_storages(rng, 3, 400)
    runs = [simulated(rng, rates, rng.uniform(2, 5, 2), one, 0.5) for one in u]
    names: dict[str, Any] = {"states": ["h1", "h2"], "inputs": ["u1", "u2"]}
    names["hold"] = "zero"
    data = measured(rng, runs, u, 0.5, **names)
    model = ph.FirstOrder(
        ["h1", "h2"],
        {"h1": "u1 - a*sqrt(h1)", "h2": "u2 - b*sqrt(h2)"},
        inputs=["u1", "u2"],
        kind="hydraulic",
    ).with_values({"a": 0.5, "b": 0.5})
    between = "between h1 and h2" if name == "connection" else "from h1 into h2"
    told = f"{name} {between}"
    true_size = size if name == "connection" else size * ratio
    return Case(model, data, frozenset([told]), {told: true_size})


KINDS: dict[str, Draw] = {
    **{law: partial(two_bodies, law) for law in ("damper", "dry friction")},
    "gyroscopic coupling": partial(two_bodies, "gyroscopic coupling"),
    "exchange of heat": rooms,
    "connection of tanks": partial(tanks, "connection"),
    "spill": partial(tanks, "spill"),
    "nothing hidden": partial(two_bodies, "nothing"),
}


if __name__ == "__main__":
    report("couplings", KINDS, FIRST)
