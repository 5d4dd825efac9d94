"""Chains of masses: of any number of states, and one with a hidden friction."""

from itertools import pairwise

import numpy as np

import phsi_opt as ph
from problems.tools.simulation import integrated

STEP = 0.1
NOISE = 0.02
SEED = 9100
TRUTH = {"k": 1.6, "a": 0.8, "c": 0.3}
STARTS = {"k": 1.0, "a": 0.5}  # of the search


def names(n_masses: int) -> tuple[list[str], list[str]]:
    """Positions and momenta."""
    numbers = range(1, n_masses + 1)
    return [f"q{i}" for i in numbers], [f"p{i}" for i in numbers]


def model(n_masses: int) -> ph.PseudoHamiltonian:
    """H = sum of k d^2/2 + a d^4/4 over the springs' lengths d, and p^2/2; a damper at
    the last mass.
    """
    q, p = names(n_masses)
    lengths = [q[0]]
    for left, right in pairwise(q):
        lengths.append(f"({right} - {left})")
    starts = {name: ph.Parameter(value) for name, value in STARTS.items()}
    energy = ph.formula(f"{p[0]}**2/2")
    for name in p[1:]:
        energy += ph.formula(f"{name}**2/2")
    for d in lengths:
        energy += ph.formula(f"k*{d}**2/2 + a*{d}**4/4", **starts)
    return ph.PseudoHamiltonian(
        states=[*q, *p],
        S=np.kron(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.eye(n_masses)),
        H=energy,
        R=ph.damping(p[-1]),
    )


def data(n_masses: int, n_samples: int) -> ph.Measurements:
    """One free run from a random start."""
    rng = np.random.default_rng(SEED)
    t = STEP * np.arange(n_samples)
    q = 0.5 * np.cumsum(rng.normal(size=n_masses))
    start = np.concatenate([q, 0.5 * rng.normal(size=n_masses)])
    x = integrated(_rates, t, start, rtol=1e-10, atol=1e-10)
    y = x + NOISE * rng.normal(size=x.shape)
    states = [name for kind in names(n_masses) for name in kind]
    return ph.Measurements.from_arrays(t, y, states=states)


def _rates(_: float, z: np.ndarray) -> np.ndarray:
    q, p = np.split(z, 2)
    d = np.diff(q, prepend=0.0)
    pull = TRUTH["k"] * d + TRUTH["a"] * d**3
    force = np.append(pull[1:], 0.0) - pull
    force[-1] -= TRUTH["c"] * p[-1]
    return np.concatenate([p, force])


# --- driven, with dry friction on one mass, positions alone measured

FRICTION = 0.3
DRIVEN_STEP = 0.05


def driven(n_masses: int, hidden: int | None = None) -> ph.PseudoHamiltonian:
    """Unit masses in a row, the first one driven and held by a spring.

    ``hidden``: the mass with dry friction, counted from 1; None: it is not there, and
    the numbers are those that a search begins with.
    """
    q, p = names(n_masses)
    energy = ph.formula(" + ".join(f"{name}**2/2" for name in p))
    resistance = {}
    for i, (left, right) in enumerate(zip(["0", *q], q, strict=False), start=1):
        k = 2.0 if hidden else ph.Parameter(1.0, lower=0)
        energy += ph.formula(f"k{i}*({right} - {left})**2/2", **{f"k{i}": k})
        c = 0.1 if hidden else ph.Parameter(0.5, lower=0)
        resistance[f"p{i}"] = ph.formula(f"c{i}", **{f"c{i}": c})
    if hidden:
        law = f"c + f*(dH_dp{hidden}**4 + 1e-8)**(-0.25)"
        resistance[f"p{hidden}"] = ph.formula(law, c=0.1, f=FRICTION)
    return ph.PseudoHamiltonian(
        states=[*q, *p],
        inputs=["u"],
        S=ph.canonical(n_masses),
        H=energy,
        R=resistance,
        F={"p1": ph.formula("u")},
    )


def driven_data(
    n_masses: int, n_samples: int, seed: int, has_momenta: bool = False
) -> ph.Measurements:
    """One record of the positions, friction on the mass in the middle."""
    truth = driven(n_masses, hidden=(n_masses + 1) // 2)
    rng = np.random.default_rng(seed)
    t = DRIVEN_STEP * np.arange(n_samples)
    phases = rng.uniform(0, 2 * np.pi, 8)
    waves = np.sin(np.outer(t, rng.uniform(0.3, 3.0, 8)) + phases)
    u = waves.sum(axis=1, keepdims=True) / 2
    x = ph.simulate(truth, t, np.r_[0.5, np.zeros(2 * n_masses - 1)], u)
    for part in np.split(x, 2, axis=1):  # positions first
        part += NOISE * np.std(part, axis=0) * rng.normal(size=part.shape)
    if not has_momenta:
        x[:, n_masses:] = np.nan
    return ph.Measurements.from_arrays(t, x, u, states=truth.states, inputs=["u"])
