"""Laws that one step of a greedy search misses: late inputs, three laws, poor bases.

    python -m problems.judges.searches [--first=SEED] [--cases=N]

Four kinds, drawn by seed: an input that acts 1 to 30 samples late; a swing with two
losses and a stiffening spring; a heater whose base model is far off, though its loss is
free; a filter of two stages under a square wave, of which the base has one. A study
goes on by itself. Right is a study whose every name is true, that names something, and
whose sizes lie within three standard errors of the truth (where one law has it).
Seeds from 70100 on are reported; others were used to build the search.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.judges.cases import Record
from problems.tools.command_line import option
from problems.tools.intervals import share
from problems.tools.pages import render
from problems.tools.provenance import write

FIRST, N_CASES = 70_100, 5  # of each kind
SURE = 3.0  # standard errors
LAG = frozenset(["input lag on T"])
FINE = 20  # steps of a simulation between two samples


@dataclass(frozen=True)
class Case:
    """Measurements of a machine, a model of it, and what the model lacks."""

    model: ph.Model
    data: ph.Measurements  # the last run is held out
    true: frozenset[str]  # how names begin that are right
    sizes: dict[str, float] = field(default_factory=dict)


def switched(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    """An input that is switched on and off at random, (n,)."""
    lengths = rng.integers(10, 60, n)
    return size * (np.repeat(np.arange(n) % 2, lengths)[:n])


def first_order(
    rng: np.random.Generator, rows: list[tuple[np.ndarray, np.ndarray]], noise: float
) -> ph.Measurements:
    """Runs of one state T with a held input u, a sample per second."""
    scale = noise * np.std(np.concatenate([T for T, _ in rows]))
    noisy = [T + scale * rng.standard_normal(len(T)) for T, _ in rows]
    return ph.Measurements.from_arrays(
        [np.arange(float(len(T))) for T in noisy],
        [T[:, None] for T in noisy],
        [u[:, None] for _, u in rows],
        states=["T"],
        inputs=["u"],
        hold="zero",
    )


def late_input(rng: np.random.Generator) -> Case:
    """A tank whose heater acts late."""
    late, decay = int(rng.integers(1, 31)), np.exp(-1 / rng.uniform(15, 60))
    rows = []
    for _ in range(2):
        u = switched(rng, 500, 2.0)
        T = np.zeros(500)
        for k in range(499):
            acting = u[max(k - late, 0)]
            T[k + 1] = decay * T[k] + (1 - decay) * 10 * acting
        rows.append((T, u))
    start = {"b": ph.Parameter(0.3, lower=0), "tau": ph.Parameter(20.0, lower=1)}
    rate = ph.formula("b*u - T/tau", **start)
    model = ph.FirstOrder(["T"], {"T": rate}, inputs=["u"])
    name = "input delay on T"
    return Case(model, first_order(rng, rows, 0.01), frozenset([name]), {name: late})


def three_laws(rng: np.random.Generator) -> Case:
    """A swing with viscous damping, quadratic drag and a cubic spring."""
    sizes = rng.uniform(0.5, 1.5, 3) * [0.02, 0.01, 0.01]
    t = np.arange(0, 40, 0.1)

    def rates(_: float, x: np.ndarray) -> list[float]:
        c, d, e = sizes
        return [x[1], -4 * x[0] - c * x[1] - d * x[1] * abs(x[1]) - e * x[0] ** 3]

    runs = []
    for amplitude in rng.uniform(3, 5, 2):
        x0 = [amplitude, 0.0]
        found = solve_ivp(rates, (0, 40), x0, t_eval=t, rtol=1e-9, atol=1e-9)
        q = found.y[0] + 0.002 * amplitude * rng.standard_normal(len(t))
        runs.append(np.c_[q, np.full(len(t), np.nan)])
    data = ph.Measurements.from_arrays([t, t], runs, states=["q", "p"])
    energy = ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(3.0, lower=0))
    model = ph.PseudoHamiltonian(states=["q", "p"], S=ph.canonical(1), H=energy)
    laws = ("viscous damping on p", "quadratic drag on p", "cubic stiffness on p")
    return Case(model, data, frozenset(laws), dict(zip(laws, sizes, strict=True)))


def staged(
    u: np.ndarray, lag: float, loss: float, heat: float, passed: float
) -> np.ndarray:
    """A state behind a lag, both begun at rest, (n,)."""
    T, w = np.zeros(len(u)), 0.0
    for k in range(len(u) - 1):
        T[k + 1] = T[k]
        for _ in range(FINE):
            w += (u[k] - w) / (FINE * lag)
            T[k + 1] += (heat * (w + passed * u[k]) - loss * T[k + 1]) / FINE
    return T


def poor_base(rng: np.random.Generator) -> Case:
    """A heater whose power passes a lag; its loss is free and starts far off."""
    lag, loss, heat = rng.uniform(3, 12), rng.uniform(0.02, 0.1), rng.uniform(0.5, 2)
    rows = []
    for _ in range(2):
        u = switched(rng, 400, 5.0)
        rows.append((staged(u, lag, loss, heat, 0.0), u))
    start = {"a": ph.Parameter(1.0, lower=0), "b": ph.Parameter(0.1, lower=0)}
    model = ph.FirstOrder(["T"], {"T": ph.formula("b*u - a*T", **start)}, inputs=["u"])
    return Case(model, first_order(rng, rows, 0.01), LAG)


def periodic_input(rng: np.random.Generator) -> Case:
    """Two stages of a filter under a square wave."""
    lag, loss = rng.uniform(2, 6), rng.uniform(0.05, 0.2)
    half = int(rng.integers(20, 50))
    rows = []
    for length in (half, half + 7):
        u = 1.0 * (np.arange(400) // length % 2)
        rows.append((staged(u, lag, loss, loss, 0.0), u))
    start = {"a": ph.Parameter(0.1, lower=0)}
    model = ph.FirstOrder(["T"], {"T": ph.formula("a*(u - T)", **start)}, inputs=["u"])
    return Case(model, first_order(rng, rows, 0.02), LAG)


Draw = Callable[[np.random.Generator], Case]
KINDS: dict[str, Draw] = {
    "input 1 to 30 samples late": late_input,
    "three laws at once": three_laws,
    "base far off": poor_base,
    "periodic input": periodic_input,
}


def examined(kind: str, draw: Draw, seed: int) -> Record:
    """What a study says of a case."""
    case = draw(np.random.default_rng(seed))
    began = time.process_time()
    record: Record = {"kind": kind, "seed": seed, "right": False}
    try:
        study = ph.Study(case.model, case.data[:-1], held_out=case.data[-1:])
        study.auto()
    except ph.PhsiOptError as error:
        return record | {"named": f"{type(error).__name__}: {str(error)[:80]}"}
    named = {}
    for number in range(len(study.steps)):
        diagnosis = study.record.diagnoses.get(number)
        for finding in diagnosis.findings if diagnosis else ():
            names = [str(effect) for effect in finding.effects]
            known = [one for one in case.true if any(n.startswith(one) for n in names)]
            true = next(iter(known), "")
            named[true or f"{names[0]} (false)"] = finding
    are_near = True
    for name, size in case.sizes.items():
        if name in named:
            found = named[name]
            are_near &= abs(found.coefficient - size) < SURE * found.std_error
    is_silent_rightly = not named and not case.true
    is_named = bool(named) and named.keys() <= case.true
    record["right"] = (is_named and are_near) or is_silent_rightly
    said = [f"{name}: {one.size}" for name, one in named.items()]
    errors = [step.judged.rmse for step in (study.steps[0], study.steps[-1])]
    return record | {
        "named": "; ".join(said),
        "truth": "; ".join(f"{size:.3g}" for size in case.sizes.values()),
        "held out": "{:.3g} to {:.3g}".format(*errors),
        "seconds": round(time.process_time() - began, 1),
    }


def report(name: str, kinds: Mapping[str, Draw], reported: int) -> None:
    """Examine cases of some kinds, and write their page for those that are reported."""
    first = int(option("first", str(reported)))
    n_cases = int(option("cases", str(N_CASES)))
    records = []
    for number in range(n_cases):
        for place, (kind, draw) in enumerate(kinds.items()):
            records.append(examined(kind, draw, first + 10 * number + place))
            print(*records[-1].values(), sep=" | ", flush=True)
    counts = []
    for kind in kinds:
        right = [one["right"] for one in records if one["kind"] == kind]
        counts.append({"kind": kind, "right": share(sum(right), len(right))})
    total = share(sum(one["right"] for one in records), len(records))
    page = render(
        f"judges/pages/{name}.md", counts=counts, total=total, records=records
    )
    print(page)
    if first == reported:
        seconds = sum(one.get("seconds", 0.0) for one in records)
        write(f"judges/{name}.md", page, seconds=seconds)


if __name__ == "__main__":
    report("searches", KINDS, FIRST)
