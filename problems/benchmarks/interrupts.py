"""Ctrl-C in the middle of every long call: how soon it ends, and with what.

    python -m problems.benchmarks.interrupts [--quick] [CALL ...]

Each call is made in a process of its own, first to its end, which times it, then again
and again with an interrupt at another share of that time.
"""

import os

# Before NumPy is loaded: one thread for all.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.tools import provenance
from problems.tools.command_line import chosen, flag
from problems.tools.pages import render

N_TRIES = 7
LIMIT = 2.0  # s within which a call has to end
EARLIER = 0.8  # of the time, where the call was over before the signal
PATIENCE = 120.0  # s until a call that does not end is given up
SEED = 9300

INTERRUPTED = "interrupted"
OTHER_ERROR = "another error"
LOST = "lost"
OVER = "over before"
HUNG = "did not end"

TRUTH = {"k": 1.6, "a": 0.8, "R_p": 0.02}
STEP = 0.05
NOISE = 0.02


def _spring(power: float = 0.0) -> ph.PseudoHamiltonian:
    """A spring with friction, and a hardening of it where ``power`` starts."""
    k = ph.Parameter(1.0)
    energy = ph.formula("k*q**2/2 + p**2/2", k=k)
    if power:
        a = ph.Parameter(power)
        energy = ph.formula("k*q**2/2 + a*q**4/4 + p**2/2", k=k, a=a)
    return ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=energy, R=ph.damping("p")
    )


def _truth() -> ph.PseudoHamiltonian:
    return _spring(TRUTH["a"]).with_values(TRUTH)


def _record(n_samples: int, n_runs: int, *states: str) -> ph.Measurements:
    """Free runs of the hardening spring, of which these states are measured."""
    truth = _truth()
    hidden = [name not in states for name in truth.states]
    t = STEP * np.arange(n_samples)
    rng = np.random.default_rng(SEED)
    runs = []
    for _ in range(n_runs):
        x = ph.simulate(truth, t, rng.uniform(1.0, 2.0, size=2))
        y = x + NOISE * rng.normal(size=x.shape)
        y[:, hidden] = np.nan
        runs.append(y)
    return ph.Measurements.from_arrays([t] * n_runs, runs, states=truth.states)


def _fit() -> ph.Fit:
    return ph.identify(_spring(0.2), _record(500, 1, "q"))


def _dictionary() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], 5),
        R=ph.damping("p"),
        F={"p": ph.polynomials(["q", "t"], 2)},
    )


def _study(n_runs: int) -> ph.Study:
    return ph.Study(_spring(), _record(300, n_runs, "q"), _record(300, 1, "q"))


def _hybrid(data: ph.Measurements) -> object:
    from phsi_opt.learning.hybrid import hybrid
    from phsi_opt.learning.hybrid_network import NeuralForce

    force = NeuralForce(("p",), ("q",), hidden=(16,), epochs=10)
    return hybrid(_spring(), data, force, pruning=ph.Pruning(0.05))


# By name, what prepares a call, and the call of what was prepared.
CALLS: dict[str, tuple[Callable[[], Any], Callable[[Any], object]]] = {
    "identify, likelihood": (
        lambda: _record(3000, 1, "q"),
        lambda data: ph.identify(_spring(0.2), data),
    ),
    "identify, PHSI loss": (
        lambda: _record(500, 8, "q", "p"),
        lambda data: ph.identify(
            _dictionary(),
            data,
            ph.PHSILoss(),
            l1={"H": 0.01, "F": 0.01},
            pruning=ph.Pruning(0.05),
        ),
    ),
    "diagnose": (lambda: _study(2), lambda study: study.diagnose()),
    "Study.auto": (
        lambda: (_record(300, 3, "q"), _record(300, 1, "q")),
        lambda data: ph.Study(_spring(), *data).auto(),
    ),
    "compare": (
        lambda: (_fit(), _record(10_000, 1, "q")),
        lambda given: ph.compare(given[0], given[1]).bands,
    ),
    "bootstrap": (
        lambda: (_fit(), _record(500, 1, "q")),
        lambda given: ph.bootstrap(given[0], given[1], 20),
    ),
    "profile": (
        lambda: (_fit(), _record(500, 1, "q")),
        lambda given: ph.profile(given[0], given[1], "a"),
    ),
    "simulate": (
        lambda: STEP * np.arange(2_000_000),
        lambda t: ph.simulate(_truth(), t, [1.0, 0.0]),
    ),
    "hybrid": (lambda: _record(200, 4, "q", "p"), _hybrid),
}


@dataclass(frozen=True)
class Try:
    """One interrupt, and how the call ended.

    Attributes:
        seconds: from the signal to the end of the call.
        ending: in a word.
        detail: the other error, where one was raised.
        goes_on: whether a fit succeeds afterwards.
    """

    seconds: float
    ending: str
    detail: str = ""
    goes_on: bool = True


def _child(pipe: Connection, name: str) -> None:
    """Make one call, and tell when it begins, how it ends, and what comes after."""
    prepared, call = CALLS[name]
    given = prepared()
    small = _record(100, 1, "q", "p")
    pipe.send("begins")
    ending, detail = LOST, ""
    try:
        call(given)
    except KeyboardInterrupt:
        ending = INTERRUPTED
    except Exception as error:
        ending, detail = OTHER_ERROR, repr(error)[:100]
    pipe.send((ending, detail))
    fit = ph.identify(_spring(0.2), small)
    pipe.send(abs(fit.values["k"] - TRUTH["k"]) < 0.5)


def attempt(name: str, after: float) -> Try:
    """Interrupt a call after so many seconds; infinite: it is only timed."""
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_child, args=(there, name))
    process.start()
    try:
        here.recv()
        began = time.perf_counter()
        if here.poll(None if np.isinf(after) else after):
            return Try(time.perf_counter() - began, OVER)
        began = time.perf_counter()
        os.kill(process.pid or 0, signal.SIGINT)
        if not here.poll(PATIENCE):
            return Try(PATIENCE, HUNG, goes_on=False)
        seconds = time.perf_counter() - began
        ending, detail = here.recv()
        goes_on = here.poll(PATIENCE) and here.recv()
        return Try(seconds, ending, detail, bool(goes_on))
    finally:
        process.kill()
        process.join()


def _in_time(name: str, after: float) -> Try:
    """A try; an earlier one where the call was over before, for times vary."""
    while True:
        tried = attempt(name, after)
        if tried.ending != OVER:
            return tried
        after *= EARLIER


def measure(name: str, n_tries: int = N_TRIES) -> dict[str, object]:
    """One call, interrupted at several times: a row of the page."""
    whole = attempt(name, np.inf).seconds
    shares = (np.arange(n_tries) + 0.5) / n_tries
    tries = [_in_time(name, share * whole) for share in shares]
    counted = Counter(one.ending for one in tries)
    row: dict[str, object] = {"call": name, "length (s)": round(whole, 1)}
    for ending in (INTERRUPTED, LOST, OTHER_ERROR, HUNG):
        row[ending] = counted[ending]
    late = max(one.seconds for one in tries)
    details = sorted({one.detail for one in tries} - {""})
    for detail in details:
        print(f"{name}: {detail}", flush=True)
    return row | {
        "longest (s)": round(late, 2),
        "within 2 s": sum(
            one.seconds <= LIMIT and one.ending == INTERRUPTED for one in tries
        ),
        "goes on": sum(one.goes_on for one in tries),
    }


def page(rows: Sequence[dict[str, object]]) -> str:
    """The page as Markdown."""
    good = sum(int(str(row["within 2 s"])) for row in rows)
    values = {"n_tries": N_TRIES, "limit": LIMIT, "good": good}
    return render("benchmarks/pages/interrupts.md", rows=rows, **values)


def main() -> None:
    """Interrupt these calls, and write the page."""
    if flag("quick"):
        print(page([measure("profile", 1)]))
        return
    rows = []
    for name in chosen() or CALLS:
        rows.append(measure(name))
        print(rows[-1], flush=True)
    if not chosen():
        provenance.write("interrupts.md", page(rows))


if __name__ == "__main__":
    main()
