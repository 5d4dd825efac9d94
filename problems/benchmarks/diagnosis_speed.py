"""How long does a diagnosis take, with the full catalogue, as the record grows?

    python -m problems.benchmarks.diagnosis_speed [n_samples ...]

A driven spring with hidden dry friction, position alone measured: one training record
of n samples, a third of it held out beside. Processor seconds of one thread.
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

SIZES = (1_000, 3_000, 10_000)
HELD_OUT = 3  # times as many samples are fitted as are held out
STEP = 0.05
FRICTION = 0.3
NOISE = 0.02  # of the standard deviation of the position
HEAD = [
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


def measured(n: int, seed: int) -> ph.Measurements:
    """One record of n samples."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(n)
    frequencies = rng.uniform(0.3, 3.0, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    u = np.sin(np.outer(t, frequencies) + phases).sum(axis=1, keepdims=True) / 2
    x = ph.simulate(_truth(), t, [0.5, 0.0], u)
    q = x[:, 0] + NOISE * np.std(x[:, 0]) * rng.normal(size=n)
    nobody = np.full(n, np.nan)  # measured p
    states = np.column_stack([q, nobody])
    return ph.Measurements.from_arrays(t, states, u, states=["q", "p"], inputs=["u"])


def _truth() -> ph.PseudoHamiltonian:
    friction = ph.formula("0.1 + f*(dH_dp**4 + 1e-8)**(-0.25)", f=FRICTION)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("2*q**2/2 + p**2/2"),
        R={"p": friction},
        F={"p": ph.formula("u")},
    )


def model() -> ph.PseudoHamiltonian:
    """The machine without its dry friction."""
    stiffness = ph.Parameter(1.0, lower=0)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=stiffness),
        R=ph.damping("p"),
        F={"p": ph.formula("u")},
    )


def timed(n: int) -> list[str]:
    """The cells of one line of the table."""
    train = measured(n, seed=0)
    test = measured(n // HELD_OUT, seed=1)
    began = time.process_time()
    fit = ph.identify(model(), train)
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
    n_effects = len(ph.catalogue(model()))
    return [str(n), str(n_effects), *(f"{s:.1f}" for s in seconds), said]


def page(rows: list[list[str]]) -> str:
    """The result as Markdown."""
    introduction = markdown.paragraph(f"""
        A driven spring, position measured at {NOISE:.0%} noise, friction of
        {FRICTION:g} hidden; the whole catalogue; {HELD_OUT} times fewer samples held
        out. Processor seconds.
        """)
    lines = ["# Time of a diagnosis", "", introduction, "", markdown.lines(HEAD, rows)]
    return "\n".join(lines)


def main(sizes: list[int]) -> None:
    """Time the sizes and write the page."""
    rows = []
    for n in sizes:
        rows.append(timed(n))
        print(*rows[-1], sep=" | ", flush=True)
    write("diagnosis_speed.md", page(rows))


if __name__ == "__main__":
    main([int(float(text)) for text in chosen()] or list(SIZES))
