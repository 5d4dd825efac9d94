"""Time of `identify` over the number of states: chains of masses with cubic springs.

    python -m problems.benchmarks.state_growth [--quick] [N_MASSES ...]

Every state is measured, at 1000 samples with noise of 0.02; stiffness, cubic stiffness
and the damper at the last mass are unknown. Processor seconds on one thread.
"""

import os

# Before NumPy is loaded: one thread for all.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import re
import resource
import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.tools import provenance
from problems.tools.command_line import chosen, flag
from problems.tools.pages import render

N_MASSES = (1, 2, 5, 10, 25, 50, 100, 200)
N_SAMPLES = 1_000
QUICK_SAMPLES = 100
STEP = 0.1
NOISE = 0.02
SEED = 9100
KILOBYTE = 1024  # bytes, of what Linux says of a process
TRUTH = {"k": 1.6, "a": 0.8, "c": 0.3}
STARTS = {"k": 1.0, "a": 0.5}  # of the search

Row = dict[str, float | int]


def names(n_masses: int) -> tuple[list[str], list[str]]:
    """Positions and momenta."""
    numbers = range(1, n_masses + 1)
    return [f"q{i}" for i in numbers], [f"p{i}" for i in numbers]


def model(n_masses: int) -> ph.PseudoHamiltonian:
    """H = sum of k d^2/2 + a d^4/4 over the springs' lengths d, and p^2/2."""
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
    solved = solve_ivp(_rates, (0.0, t[-1]), start, "DOP853", t, rtol=1e-10, atol=1e-10)
    x = solved.y.T
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


def measure(n_masses: int, n_samples: int = N_SAMPLES) -> Row:
    """One fit of a chain."""
    said: list[str] = []
    given = data(n_masses, n_samples)
    chain = model(n_masses)
    began = time.process_time()
    fit = ph.identify(chain, given, progress=said.append)
    std_errors = fit.std_errors
    seconds = time.process_time() - began
    found = [re.search(r"^maximum.* iterations, ([\d.]+) s\)", line) for line in said]
    solves = sum(float(solved[1]) for solved in found if solved)
    memory = resource.getrusage(resource.RUSAGE_SELF)
    known = dict(zip(fit.names, TRUTH.values(), strict=True))
    errors = [abs(fit.values[name] - known[name]) / std_errors[name] for name in known]
    return {
        "states": 2 * n_masses,
        "identify (s)": round(seconds, 2),
        "solves (s)": round(solves, 2),
        "memory (GB)": round(memory.ru_maxrss * KILOBYTE / 1e9, 2),
        "largest error in standard errors": round(max(errors), 2),
    }


def growth(rows: Sequence[Row], column: str) -> float:
    """The power with which a time grows over the last two sizes."""
    before, after = rows[-2:]
    times = float(after[column]) / float(before[column])
    return float(np.log(times) / np.log(after["states"] / before["states"]))


def page(rows: Sequence[Row]) -> str:
    """The page as Markdown."""
    columns = ("identify (s)", "solves (s)")
    powers = [growth(rows, column) for column in columns] if len(rows) > 1 else []
    values = {"n_samples": N_SAMPLES, "noise": NOISE, "powers": powers}
    return render("benchmarks/pages/state_growth.md", rows=rows, **values)


def main() -> None:
    """Measure chains of these lengths, and write the page."""
    if flag("quick"):
        print(page([measure(n, QUICK_SAMPLES) for n in (1, 2)]))
        return
    rows = []
    for n_masses in map(int, chosen() or map(str, N_MASSES)):
        rows.append(measure(n_masses))
        print(rows[-1], flush=True)
    provenance.write("state_growth.md", page(rows))


if __name__ == "__main__":
    main()
