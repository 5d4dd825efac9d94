"""How long does a diagnosis take, with the full catalogue, as the record grows?

    python -m problems.benchmarks.diagnosis_speed [n_samples ...]

A driven spring with hidden dry friction, position alone measured: one training record
of n samples, a third of it held out beside. And a chain of eight such masses, friction
on one of them. Processor seconds of one thread.
"""

import os

# Before NumPy is loaded: one thread for all.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from dataclasses import dataclass, field

import numpy as np

import phsi_opt as ph
from problems.tools import markdown
from problems.tools.command_line import chosen
from problems.tools.provenance import write

SIZES = ((1_000, 1), (3_000, 1), (10_000, 1), (1_000, 8))  # samples, masses
HELD_OUT = 3  # times as many samples are fitted as are held out
STEP = 0.05
FRICTION = 0.3
NOISE = 0.02  # of the standard deviation of the position
HEAD = [
    "masses",
    "samples",
    "effects",
    "fit of the base model",
    "diagnosis",
    "of it: missing force, comparison",
    "screening",
    "weighing",
    "re-fits and verdict",
    "what it said",
]


@dataclass
class Stopwatch:
    """The moments at which a diagnosis reports its steps."""

    moments: dict[str, float] = field(default_factory=dict)

    def report(self, line: str) -> None:
        """Keep when a step, named by its first word, began."""
        self.moments.setdefault(line.split()[0], time.process_time())


def chain(n_masses: int, hidden: int | None = None) -> ph.PseudoHamiltonian:
    """Masses in a row, the first one driven and held by a spring.

    Args:
        n_masses: of size one, with springs and dampers of unknown sizes.
        hidden: number of the mass with dry friction, counted from 1; None: it is not
            there, and the numbers are those that a search begins with.
    """
    places = range(1, n_masses + 1)
    q, p = [f"q{i}" for i in places], [f"p{i}" for i in places]
    energy = ph.formula(" + ".join(f"{name}**2/2" for name in p))
    resistance = {}
    for i, left, right in zip(places, ["0", *q], q, strict=False):
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


def measured(truth: ph.PseudoHamiltonian, n: int, seed: int) -> ph.Measurements:
    """One record of the positions, n samples."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(n)
    frequencies = rng.uniform(0.3, 3.0, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    u = np.sin(np.outer(t, frequencies) + phases).sum(axis=1, keepdims=True) / 2
    n_masses = len(truth.states) // 2
    start = np.r_[0.5, np.zeros(2 * n_masses - 1)]
    states = ph.simulate(truth, t, start, u)
    q = states[:, :n_masses]
    q = q + NOISE * np.std(q, axis=0) * rng.normal(size=q.shape)
    states[:, :n_masses] = q
    states[:, n_masses:] = np.nan  # nobody measured p
    return ph.Measurements.from_arrays(t, states, u, states=truth.states, inputs=["u"])


def timed(n: int, n_masses: int = 1) -> list[str]:
    """The cells of one line of the table."""
    truth = chain(n_masses, hidden=(n_masses + 1) // 2)
    train = measured(truth, n, seed=0)
    test = measured(truth, n // HELD_OUT, seed=1)
    model = chain(n_masses)
    began = time.process_time()
    fit = ph.identify(model, train)
    _ = fit.std_errors  # worked out when asked for
    fitted = time.process_time()
    watch = Stopwatch()
    found = ph.diagnose(fit, train, test, progress=watch.report)
    ended = time.process_time()
    screening = watch.moments["screening"]
    refits = watch.moments.get("re-fitting", ended)
    weighing = watch.moments.get("weighing", refits)
    seconds = [
        fitted - began,
        ended - fitted,
        screening - fitted,
        weighing - screening,
        refits - weighing,
        ended - refits,
    ]
    first = found.candidates.iloc[0]
    size = f"{first['coefficient']:.4f} +- {first['std_error']:.4f}"
    said = f"{found.verdict}: {found.effects[0]}, {size}"
    numbers = [str(n_masses), str(n), str(len(ph.catalogue(model)))]
    return [*numbers, *(f"{s:.1f}" for s in seconds), said]


def page(rows: list[list[str]]) -> str:
    """The result as Markdown."""
    introduction = markdown.paragraph(f"""
        A driven spring, and a chain of springs, positions measured at {NOISE:.0%}
        noise, dry friction of {FRICTION:g} on one mass hidden; the whole catalogue;
        {HELD_OUT} times fewer samples held out. Processor seconds.
        """)
    lines = ["# Time of a diagnosis", "", introduction, "", markdown.lines(HEAD, rows)]
    return "\n".join(lines)


def main(sizes: list[tuple[int, int]]) -> None:
    """Time the sizes, numbers of samples and masses, and write the page."""
    rows = []
    for n, n_masses in sizes:
        rows.append(timed(n, n_masses))
        print(*rows[-1], sep=" | ", flush=True)
    write("diagnosis_speed.md", page(rows))


if __name__ == "__main__":
    main([(int(float(text)), 1) for text in chosen()] or list(SIZES))
