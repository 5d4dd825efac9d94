"""How long does a diagnosis take, with the full catalogue, as the record grows?

python -m problems.benchmarks.diagnosis_speed [n_samples ...]

A driven spring with hidden dry friction, position alone measured at 2 % noise: one
training record of n samples, a third of it held out beside. Times are those of this
machine while it may have been doing other things as well.
"""

import sys
import time

import numpy as np

import phsi_opt as ph
from problems.tools.provenance import write

SIZES = (1_000, 3_000, 10_000)
STEP, FRICTION = 0.05, 0.3


def measured(n: int, seed: int) -> ph.Measurements:
    """One record of n samples."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(n)
    frequencies, phases = rng.uniform(0.3, 3.0, 8), rng.uniform(0, 2 * np.pi, 8)
    u = np.sin(np.outer(t, frequencies) + phases).sum(axis=1, keepdims=True) / 2
    truth = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("2*q**2/2 + p**2/2"),
        R={"p": ph.formula("0.1 + f*(dH_dp**4 + 1e-8)**(-0.25)", f=FRICTION)},
        F={"p": ph.formula("u")},
    )
    x = ph.simulate(truth, t, [0.5, 0.0], u)
    q = x[:, 0] + 0.02 * np.std(x[:, 0]) * rng.normal(size=n)
    return ph.Measurements.from_arrays(
        t, np.column_stack([q, np.full(n, np.nan)]), u, states=["q", "p"], inputs=["u"]
    )


def timed(n: int) -> str:
    """One line of the table."""
    train, test = measured(n, seed=0), measured(n // 3, seed=1)
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0, lower=0)),
        R=ph.damping("p"),
        F={"p": ph.formula("u")},
    )
    began = time.perf_counter()
    fit = ph.identify(model, train)
    fitted = time.perf_counter()
    lines: list[tuple[float, str]] = []
    found = ph.diagnose(
        fit,
        train,
        test,
        progress=lambda line: lines.append((time.perf_counter(), line)),
    )
    ended = time.perf_counter()
    at = [
        moment for moment, line in lines if line.startswith(("screening", "re-fitting"))
    ]
    shares = [at[0] - fitted, at[1] - at[0], ended - at[1]]
    row = found.candidates.iloc[0]
    return (
        f"| {n} | {len(ph.catalogue(model))} | {fitted - began:.1f} | {ended - fitted:.1f} | "
        + " | ".join(f"{share:.1f}" for share in shares)
        + f" | {found.verdict}: {found.effects[0]}, {row['coefficient']:.4f} +- {row['std_error']:.4f} |"
    )


def main(sizes: list[int]) -> None:
    """The page."""
    head = [
        "# Time of a diagnosis",
        "",
        f"A driven spring, position measured at 2 % noise, friction of {FRICTION} hidden; the whole catalogue; a third",
        "as many samples held out. Seconds; on a machine that may have been doing other things.",
        "",
        "| samples | effects | fit of the base model | diagnosis | of it: missing force, comparison | screening "
        "| re-fits and their comparisons | what it said |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines = []
    for n in sizes:
        lines.append(timed(n))
        print(lines[-1], flush=True)
    write("diagnosis_speed.md", "\n".join([*head, *lines]))


if __name__ == "__main__":
    main([int(float(text)) for text in sys.argv[1:]] or list(SIZES))
