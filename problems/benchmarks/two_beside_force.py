"""Two effects hidden at once, beside a random force of 5 %: are both found?

    python -m problems.benchmarks.two_beside_force [--first=SEED] [--seeds=N] [--jobs=N]

A driven mass on a spring with a damper, its position measured at 1 % noise in three
training and two held-out runs. One effect takes energy, one bends the spring or the
input; each has 8 to 30 % of the spring's force (rms), drawn. A random force that lasts
a drawn time has 5 % of the momentum's rate. `Study.auto` is asked; a class that holds
the right law names it. Seeds 0 to 29 and 40000 to 40059 were looked at; the page has
those of its first line.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.tools.intervals import share
from problems.tools.pages import render
from problems.tools.seeds import ask_and_write

Array = np.ndarray
Law = Callable[[Array, Array, Array], Array]  # of position, velocity and input

FIRST_SEED = 41_000
N_SEEDS = 60
N_RUNS, N_TRAINING, N_SAMPLES = 5, 3, 240
PER_PERIOD = 24  # samples in a period of the spring
SUBSTEPS = 10  # of Runge and Kutta's method between samples
NOISE = 0.01  # of the position's deviation
RANDOM_FORCE = 0.05  # of the momentum's rate, root mean squares
SHARES = (0.08, 0.3)  # of the spring's force, root mean squares
TIMES = (0.03, 1.0)  # of the random force, in periods
ROUNDS = 6  # in which the sizes are brought to their shares
MOST_ERRORS = 2.5  # standard errors that a size may be off

# By the name of the parameter: the force of size one. v is the velocity.
TAKING: dict[str, Law] = {
    "coulomb_friction_p": lambda q, v, u: -np.tanh(v / 1e-3),
    "quadratic_drag_p": lambda q, v, u: -v * np.abs(v),
    "cubic_drag_p": lambda q, v, u: -(v**3),
}
BENDING: dict[str, Law] = {
    "cubic_stiffness_q": lambda q, v, u: -(q**3),
    "quadratic_stiffness_q": lambda q, v, u: -(q**2),
    "quadratic_input_u_p": lambda q, v, u: u**2,
    "constant_force_p": lambda q, v, u: np.ones_like(q),
}
LAWS = TAKING | BENDING


@dataclass(frozen=True, eq=False)
class Machine:
    """A mass on a spring with its drive (samples, runs), and what is hidden."""

    mass: float
    stiffness: float
    damping: float
    drive: Array
    step: float
    random: Array
    sizes: dict[str, float]

    def forces(self, q: Array, v: Array, u: Array) -> dict[str, Array]:
        """The hidden laws along a motion."""
        return {name: c * LAWS[name](q, v, u) for name, c in self.sizes.items()}

    def rates(self, x: Array, u: Array, random: Array) -> Array:
        """Of position and momentum, (2, n_runs)."""
        q, v = x[0], x[1] / self.mass
        force = u + random - self.stiffness * q - self.damping * v
        return np.stack([v, force + sum(self.forces(q, v, u).values())])

    def motion(self, x: Array) -> Array:
        """Positions and momenta at the samples, (n_samples, 2, n_runs)."""
        found = [x]
        h = self.step / SUBSTEPS
        for k in range(len(self.drive) - 1):
            for part in range(SUBSTEPS):
                at = [(part + shift) / SUBSTEPS for shift in (0.0, 0.5, 1.0)]
                held = []
                for share_of_next in at:
                    of = 1 - share_of_next, share_of_next
                    u = of[0] * self.drive[k] + of[1] * self.drive[k + 1]
                    w = of[0] * self.random[k] + of[1] * self.random[k + 1]
                    held.append((u, w))
                a = self.rates(x, *held[0])
                b = self.rates(x + h / 2 * a, *held[1])
                c = self.rates(x + h / 2 * b, *held[1])
                d = self.rates(x + h * c, *held[2])
                x = x + h / 6 * (a + 2 * b + 2 * c + d)
            found.append(x)
        return np.array(found)


def drawn(rng: np.random.Generator) -> tuple[Machine, Array]:
    """A machine, with its motion (n_samples, 2, n_runs)."""
    mass, stiffness = float(rng.uniform(0.7, 1.5)), float(rng.uniform(1.0, 6.0))
    omega = float(np.sqrt(stiffness / mass))
    damping = 2 * float(rng.uniform(0.02, 0.08)) * omega * mass
    step = 2 * np.pi / omega / PER_PERIOD
    t = step * np.arange(N_SAMPLES)
    tones = omega * rng.uniform(0.3, 2.0, (6, 1, N_RUNS))
    phases = rng.uniform(0, 2 * np.pi, (6, 1, N_RUNS))
    drive = np.sin(tones * t[:, None] + phases).sum(axis=0) * stiffness / 4
    time = 2 * np.pi / omega * np.exp(rng.uniform(*np.log(TIMES)))
    noise = rng.normal(size=(N_SAMPLES, N_RUNS))
    fade = np.exp(-step / time)
    random = np.empty_like(noise)
    random[0] = noise[0]
    for k in range(1, N_SAMPLES):
        random[k] = fade * random[k - 1] + np.sqrt(1 - fade**2) * noise[k]
    names = rng.choice(list(TAKING)), rng.choice(list(BENDING))
    low, high = np.log(SHARES)
    targets = np.exp(rng.uniform(low, high, 2))
    start = np.stack([rng.normal(size=N_RUNS), np.zeros(N_RUNS)])
    sizes = dict.fromkeys(map(str, names), 0.0)
    strength = 0.0
    for _ in range(ROUNDS):
        machine = Machine(
            mass, stiffness, damping, drive, step, strength * random, sizes
        )
        x = machine.motion(start)
        q, v = x[:, 0], x[:, 1] / mass
        sizes = {}
        for name, target in zip(machine.sizes, targets, strict=True):
            of_one = np.sqrt(np.mean(LAWS[name](q, v, drive) ** 2))
            spring = stiffness * np.sqrt(np.mean(q**2))
            sizes[name] = float(target * spring / of_one)
        rate = np.sqrt(np.mean(np.gradient(x[:, 1], step, axis=0) ** 2))
        strength = RANDOM_FORCE * float(rate)
    return machine, x


def measured(machine: Machine, x: Array, rng: np.random.Generator) -> ph.Measurements:
    """The position alone, with noise."""
    q = x[:, 0]
    q = q + NOISE * np.std(q) * rng.normal(size=q.shape)
    t = machine.step * np.arange(len(q))
    nobody = np.full_like(q, np.nan)
    return ph.Measurements.from_arrays(
        [t] * N_RUNS,
        [np.column_stack(pair) for pair in zip(q.T, nobody.T, strict=True)],
        [u[:, None] for u in machine.drive.T],
        states=["q", "p"],
        inputs=["u"],
    )


def model(mass: float) -> ph.PseudoHamiltonian:
    """Spring and damper, the mass known."""
    k = ph.Parameter(3.0, lower=0)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula(f"k*q**2/2 + p**2/(2*{mass!r})", k=k),
        R=ph.damping("p"),
        F={"p": ph.formula("u")},
    )


def answer(seed: int) -> dict[str, Any]:
    """What `Study.auto` makes of one machine.

    Both are found where they are named or in a class that is; an effect is false beside
    which neither was named.
    """
    rng = np.random.default_rng(seed)
    machine, x = drawn(rng)
    train, test = measured(machine, x, rng).split(N_TRAINING / N_RUNS)
    said: list[str] = []
    study = ph.Study(model(machine.mass), train, test, progress=said.append)
    study.auto()
    named = [line.split(";")[0] for line in said if "named: " in line]
    told = [label(name) for name in machine.sizes]
    found, spread = study.fit.estimates, study.fit.std_errors
    added = [str(effect) for effect in study.added]
    is_right = [one in added or any(one in line for line in named) for one in told]
    wrong = [one for one in added if one not in told]
    return {
        "seed": seed,
        "hidden": " and ".join(machine.sizes),
        "added": ", ".join(added) or "nothing",
        "errors": [
            float((found[name] - size) / spread[name])
            for name, size in machine.sizes.items()
            if name in found
        ],
        "is_both": all(is_right),
        "is_false": any(not _is_tied(one, told, named) for one in wrong),
    }


def label(name: str) -> str:
    """The effect's name, by that of its parameter."""
    words = name.removesuffix("_p").removesuffix("_q").removesuffix("_u")
    return f"{words.replace('_', ' ')} on p"


def _is_tied(one: str, told: list[str], named: list[str]) -> bool:
    """Whether an effect was told in one line with a hidden one that does as well."""
    lines = [line for line in named if one.removesuffix(" on p") in line]
    return any(right in line for line in lines for right in told)


def page(by_seed: dict[str, dict[str, Any]]) -> str:
    """The page of all answers."""
    answers = pd.DataFrame(by_seed.values())
    errors = np.abs([error for row in answers["errors"] for error in row])
    is_right = answers["is_both"] & ~answers["is_false"]
    n = len(answers)
    return render(
        "benchmarks/pages/two_beside_force.md",
        first=next(iter(by_seed)),
        noise=NOISE,
        shares=SHARES,
        random_force=RANDOM_FORCE,
        most_errors=MOST_ERRORS,
        n=n,
        both=share(int(answers["is_both"].sum()), n),
        alone=share(int((~answers["is_false"]).sum()), n),
        within=share(int((errors <= MOST_ERRORS).sum()), len(errors)),
        n_errors=len(errors),
        others=answers[~is_right][["seed", "hidden", "added"]],
    )


if __name__ == "__main__":
    ask_and_write(answer, FIRST_SEED, N_SEEDS, page, "two_beside_force.md")
