"""How soon Ctrl-C ends long calls and commands, at moments drawn by a seed.

    python -m problems.benchmarks.interrupts                   # 100 interrupts
    python -m problems.benchmarks.interrupts --each=2 auto fit # of these, and no page

A call is first timed without an interrupt; the moments lie between its start and its
end. Results: results/interrupts.md.
"""

import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from subprocess import TimeoutExpired

import numpy as np

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import Descent, gradient_descent
from phsi_opt.interrupts import is_noted
from problems.benchmarks import chains
from problems.benchmarks.stress import (
    COMMAND,
    EXAMPLE,
    MODEL,
    Row,
    attempts,
    begun,
    collected,
    record,
    rmse_of_seed,
)
from problems.tools import provenance
from problems.tools.command_line import chosen, option
from problems.tools.pages import render

Call = Callable[[], object]
N_LONG = 20_000  # samples of a long record
LATEST = 10.0  # s after the start of a call
PATIENCE = 2.0  # s from Ctrl-C to the end of a call


def calls(folder: Path) -> dict[str, Call]:
    """The long calls of the package, each from its beginning."""
    data = record()
    complete = record(is_complete=True)
    fit = ph.identify(MODEL, data)
    study = ph.Study(MODEL, data)
    study.diagnose()
    table = folder / "long.csv"
    t = 0.05 * np.arange(N_LONG)
    noise = 0.01 * np.random.default_rng(0).normal(size=(N_LONG, 2))
    x = noise + np.transpose([np.sin(t), np.cos(t)])
    u = t[:, None]
    long = ph.Measurements.from_arrays(t, x, u, states=["q", "p"], inputs=["u"])
    long.to_dataframe().to_csv(table, index=False)
    identify = partial(ph.identify, MODEL, data)
    seeds = {str(seed): seed for seed in range(4)}
    times = np.linspace(0.0, 300.0, 30_001)
    truth = chains.driven(1, hidden=1)
    known = ph.PHSILoss(), ph.MaximumLikelihood(huber=2.0)
    with_error = ph.MaximumLikelihood(model_error=True)
    descent = Descent(epochs=20)
    return {
        "identify": identify,
        "identify, PHSI loss": lambda: ph.identify(MODEL, complete, known[0]),
        "identify, Huber": lambda: ph.identify(MODEL, data, known[1]),
        "identify, model error": lambda: ph.identify(MODEL, data, with_error),
        "standard errors": lambda: identify().std_errors,
        "profile": lambda: ph.profile(fit, data, "k1"),
        "bootstrap": lambda: ph.bootstrap(fit, data, 6),
        "compare with bands": lambda: ph.compare(fit, data).bands,
        "diagnose": lambda: ph.diagnose(fit, data),
        "auto": lambda: ph.Study(MODEL, data).auto(2),
        "sweep": lambda: list(ph.sweep(rmse_of_seed, seeds)),
        "report": lambda: _report(study, folder),
        "noise and chart": lambda: (long.noticed, long.chart()),
        "from_csv": lambda: _read(table),
        "simulate": lambda: ph.simulate(truth, times, [1.0, 0.0], np.sin),
        "gradient descent": lambda: gradient_descent(MODEL, complete, descent),
    }


def _report(study: ph.Study, folder: Path) -> None:
    for number in range(2):
        study.report(folder / f"{number}.html")


def _read(table: Path) -> ph.Measurements:
    return ph.Measurements.from_csv(
        table, time="t", states=["q", "p"], inputs=["u"], trajectory="trajectory"
    )


COMMANDS = {
    "phsi-opt check": ["check"],
    "phsi-opt fit": ["fit", "--save", "fit.json"],
    "phsi-opt diagnose": ["diagnose"],
    "phsi-opt study --auto": ["study", "--auto", "--report", "report.html"],
}


def interrupted(call: Call, delay: float | None) -> float | None:
    """Seconds from Ctrl-C to KeyboardInterrupt; None: the call was done before.

    Without a delay: how long the call takes.

    Raises:
        AssertionError: Ctrl-C ended otherwise, or something of it was left.
    """
    began = time.perf_counter()
    if delay is None:
        call()
        return time.perf_counter() - began
    pressed: list[float] = []
    is_over = threading.Lock()

    def press() -> None:
        if is_over.acquire(blocking=False):
            pressed.append(time.perf_counter())
            os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(delay, press)
    seconds = None
    try:
        timer.start()
        call()
        is_ours = is_over.acquire(blocking=False)
        timer.cancel()
        if not is_ours:  # pressed, and either lost or about to be raised
            time.sleep(0.1)
            raise AssertionError("Ctrl-C was pressed and the call went on to its end")
    except KeyboardInterrupt:
        seconds = time.perf_counter() - pressed[0]
    timer.join()
    assert not is_noted()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return seconds


def interrupted_command(command: Sequence[str], delay: float | None) -> float | None:
    """The same of a command in a folder of its own.

    Raises:
        AssertionError: it ended with another exit code, or left files half written.
    """
    with tempfile.TemporaryDirectory() as place:
        shutil.copytree(EXAMPLE, place, dirs_exist_ok=True)
        began = time.perf_counter()
        process = begun([*COMMAND, *command], Path(place))
        try:
            _, said = process.communicate(timeout=delay)
        except TimeoutExpired:
            began = time.perf_counter()
            process.send_signal(signal.SIGINT)
            _, said = process.communicate()
        seconds = time.perf_counter() - began
        if process.returncode == 0:
            return seconds if delay is None else None
        assert process.returncode in (130, -signal.SIGINT), (process.returncode, said)
        hidden = [one.name for one in Path(place).glob(".*")]
        assert not hidden, hidden
        return seconds


def rows(each: int) -> Iterator[Row]:
    """Interrupt every call so often; one row each."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        ways: dict[str, Callable[[float | None], float | None]] = {}
        for name, call in calls(Path(folder)).items():
            ways[name] = partial(interrupted, call)
        for name, command in COMMANDS.items():
            ways[name] = partial(interrupted_command, command)
        for name in chosen() or ways:
            takes = ways[name](None) or 0.0
            latest = min(takes, LATEST)
            seconds, _, n_wrong = attempts(name, ways[name], latest, each, rng)
            yield {
                "call": name,
                "takes (s)": takes,
                "interrupts": len(seconds),
                "wrong": n_wrong,
                "longest (s)": max(seconds, default=np.nan),
                "late": sum(one > PATIENCE for one in seconds),
            }


if __name__ == "__main__":
    found = collected(rows(int(option("each", "6"))))
    if not chosen():
        page = render(
            "benchmarks/pages/interrupts.md",
            rows=found,
            patience=PATIENCE,
            n=found["interrupts"].sum(),
            n_late=found["late"].sum(),
            n_wrong=found["wrong"].sum(),
            load=f"{os.getloadavg()[0]:.1f}",
        )
        provenance.write("interrupts.md", page)
