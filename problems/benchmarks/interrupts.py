"""How soon Ctrl-C ends long calls and commands, at moments drawn by a seed.

    python -m problems.benchmarks.interrupts                   # 100 interrupts
    python -m problems.benchmarks.interrupts --each=2 auto fit # of these, and no page

A call is first timed without an interrupt; the moments lie between its start and its
end. Results: results/interrupts.md.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.baselines.descent import Descent
from phsi_opt.baselines.gradient_descent import gradient_descent
from phsi_opt.interrupts import is_noted
from problems.tools import provenance
from problems.tools.command_line import chosen, option
from problems.tools.pages import render

Call = Callable[[], object]
N_LONG = 20_000  # samples of a long record
LATEST = 10.0  # s after the start of a call
PATIENCE = 2.0  # s from Ctrl-C to the end of a call
EXAMPLE = Path(str(files("phsi_opt.study_file") / "examples" / "spring"))
MODEL = ph.PseudoHamiltonian(
    states=["q", "p"],
    S=ph.canonical(1),
    H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0, lower=0)),
    R=ph.damping("p"),
    F={"p": "u"},
    inputs=["u"],
)
TRUTH = MODEL.with_values({"k": 1.4, "R_p": 0.1})


def record(seed: int = 0, n: int = 400, is_complete: bool = False) -> ph.Measurements:
    """The position (or both states) of a driven spring with dry friction."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(n)
    phases = np.outer(t, rng.uniform(0.3, 3.0, 6)) + rng.uniform(0, 2 * np.pi, 6)
    u = np.sin(phases).sum(axis=1, keepdims=True)
    x = ph.simulate(TRUTH, t, [1.0, 0.0], u, force=_friction)
    y = x + 0.02 * x.std(axis=0) * rng.normal(size=x.shape)
    if not is_complete:
        y[:, 1] = np.nan
    return ph.Measurements.from_arrays(t, y, u, states=["q", "p"], inputs=["u"])


def _friction(t: float, x: np.ndarray) -> np.ndarray:
    return np.array([0.0, -0.4 * np.tanh(50 * x[1])])


def rmse_of_seed(seed: int) -> float:
    """One case of a sweep."""
    data = record(seed)
    return ph.compare(ph.identify(MODEL, data), data).rmse


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
    known = ph.PHSILoss(), ph.MaximumLikelihood(huber=2.0)
    with_error = ph.MaximumLikelihood(model_error=True)
    descent = Descent(epochs=20)
    return {
        "identify": identify,
        "identify, PHSI loss": lambda: ph.identify(MODEL, complete, known[0]),
        "identify, Huber": lambda: ph.identify(MODEL, data, known[1]),
        "identify, model error": lambda: ph.identify(MODEL, data, with_error),
        "standard errors": lambda: identify().std_errors,
        "profile": lambda: ph.profile(fit, data, "k"),
        "bootstrap": lambda: ph.bootstrap(fit, data, 6),
        "compare with bands": lambda: ph.compare(fit, data).bands,
        "diagnose": lambda: ph.diagnose(fit, data),
        "auto": lambda: ph.Study(MODEL, data).auto(2),
        "sweep": lambda: list(ph.sweep(rmse_of_seed, seeds)),
        "report": lambda: _report(study, folder),
        "noise and chart": lambda: (long.noticed, long.chart()),
        "from_csv": lambda: _read(table),
        "simulate": lambda: ph.simulate(TRUTH, times, [1.0, 0.0], np.sin),
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


def interrupted(call: Call, delay: float) -> float | None:
    """Seconds from Ctrl-C to KeyboardInterrupt; None: the call was done before.

    Raises:
        AssertionError: Ctrl-C ended otherwise, or something of it was left.
    """
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


def environment() -> dict[str, str]:
    """That of a process that runs in another folder."""
    path = f"{provenance.ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    return {**os.environ, "PYTHONPATH": path}


def interrupted_command(command: list[str], delay: float | None) -> float | None:
    """The same of a command in a folder of its own; without a delay: how long it takes.

    Raises:
        AssertionError: it ended with another exit code, or left files half written.
    """
    with tempfile.TemporaryDirectory() as place:
        shutil.copytree(EXAMPLE, place, dirs_exist_ok=True)
        program = [sys.executable, "-m", "phsi_opt.command_line", *command]
        began = time.perf_counter()
        process = subprocess.Popen(
            program,
            cwd=place,
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            _, said = process.communicate(timeout=delay)
        except subprocess.TimeoutExpired:
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


def main(each: int) -> pd.DataFrame:
    """Interrupt every call so often; one row each."""
    rng = np.random.default_rng(0)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        ways: dict[str, Callable[[float], float | None]] = {}
        lengths: dict[str, float] = {}
        for name, call in calls(Path(folder)).items():
            ways[name] = partial(interrupted, call)
            began = time.perf_counter()
            if not chosen() or name in chosen():
                call()
            lengths[name] = time.perf_counter() - began
            print(f"{name}: {lengths[name]:.1f} s", flush=True)
        for name, command in COMMANDS.items():
            ways[name] = partial(interrupted_command, command)
            if not chosen() or name in chosen():
                lengths[name] = interrupted_command(command, None) or 0.0
        for name in chosen() or ways:
            ended: list[float] = []
            n_done = n_wrong = 0
            while len(ended) + n_wrong < each and n_done < 3 * each:
                try:
                    latest = min(lengths[name], LATEST)
                    seconds = ways[name](rng.uniform(0.0, latest))
                except AssertionError as error:
                    print(f"{name}: {error}")
                    n_wrong += 1
                    continue
                n_done += seconds is None
                ended += [] if seconds is None else [seconds]
            row = {"call": name, "takes (s)": lengths[name], "interrupts": len(ended)}
            row["wrong"] = n_wrong
            row["longest (s)"] = max(ended, default=np.nan)
            row["late"] = sum(one > PATIENCE for one in ended)
            print(row, flush=True)
            rows.append(row)
    return pd.DataFrame(rows)


if __name__ == "__main__":
    table = main(int(option("each", "6")))
    if not chosen():
        page = render(
            "benchmarks/pages/interrupts.md",
            rows=table,
            patience=PATIENCE,
            n=table["interrupts"].sum(),
            n_late=table["late"].sum(),
            n_wrong=table["wrong"].sum(),
            load=f"{os.getloadavg()[0]:.1f}",
        )
        provenance.write("interrupts.md", page)
