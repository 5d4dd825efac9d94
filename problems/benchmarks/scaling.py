"""Time and memory of `identify` over the number of samples: the driven Duffing
oscillator, q and p or q alone measured.

    python -m problems.benchmarks.scaling [--quick] [--page] [--largest=N]
        [--limit=SECONDS]

Every size runs in a process of its own, so that its peak memory is its own. Rows are
kept in results/scaling.csv; a size that is there is not run again.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import re
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.benchmarks.efficiency.cases import DUFFING, DUFFING_START, duffing_model
from problems.tools import provenance
from problems.tools.command_line import flag, option
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render

SIZES = (1_000, 10_000, 100_000, 1_000_000)
CHANNELS = {"qp": "q and p measured", "q": "q alone measured"}
STEP = 0.1  # s
NOISE = 0.03  # of each channel's standard deviation
SEED = 9000
LIMIT = 3600.0  # s, for one size
COLOURS = {"qp": "#0072b2", "q": "#d55e00"}
# The parameters of the truth by the names of the model.
NAMES = {"k": "k", "a": "a", "c": "R_p"}
KILLED = -9  # what a process returns that the system ended for want of memory

Row = dict[str, float | str]


def data(n_samples: int, channels: str) -> ph.Measurements:
    """One record. The oscillator forgets its start, so errors of the integration do not
    grow with its length.
    """
    k, a, c = DUFFING.values()
    t = STEP * np.arange(n_samples)

    def rates(at: float, x: np.ndarray) -> tuple[float, float]:
        q, p = x.tolist()
        force = -k * q - a * q**3 - c * p
        return p, force + 2 * np.cos(1.3 * at)

    solved = solve_ivp(
        rates, (0.0, t[-1]), DUFFING_START, "LSODA", t, rtol=1e-9, atol=1e-9
    )
    x = solved.y.T
    y = x + NOISE * x.std(axis=0) * np.random.default_rng(SEED).normal(size=x.shape)
    if channels == "q":
        y[:, 1] = np.nan
    return ph.Measurements.from_arrays([t], [y], states=("q", "p"))


def measure(n_samples: int, channels: str) -> Row:
    """One fit in this process: time, that of its likelihood solves, memory, errors."""
    said: list[str] = []
    given = data(n_samples, channels)
    before = _peak()
    began = time.perf_counter()
    fit = ph.identify(duffing_model(), given, progress=said.append)
    std_errors = fit.std_errors
    seconds = time.perf_counter() - began
    programs = [line for line in said if line.startswith("maximum")]
    found = [re.search(r"(\d+) iterations, ([\d.]+) s\)", line) for line in programs]
    errors = [
        abs(fit.values[NAMES[symbol]] - true) / std_errors[NAMES[symbol]]
        for symbol, true in DUFFING.items()
    ]
    return {
        "channels": channels,
        "n_samples": n_samples,
        "seconds": seconds,
        "solve_seconds": sum(float(solved[2]) for solved in found if solved),
        "programs": len(programs),
        "iterations": sum(int(solved[1]) for solved in found if solved),
        "peak_gb": _peak(),
        "peak_before_gb": before,
        "largest_error_in_std_errors": max(errors),
        "outcome": fit.outcome.status,
    }


def _peak() -> float:
    """Peak memory of this process so far, in GB (Linux counts it in kB, macOS in
    bytes).
    """
    counted = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return counted * unit / 1e9


def apart(n_samples: int, channels: str, limit: float) -> Row:
    """`measure` in a process of its own; a process that dies or takes longer than
    ``limit`` seconds is a row as well.
    """
    command = [sys.executable, "-m", "problems.benchmarks.scaling"]
    command += [f"--one={n_samples}", f"--channels={channels}"]
    failed: Row = {"channels": channels, "n_samples": n_samples}
    try:
        run = subprocess.run(
            command,
            cwd=provenance.ROOT,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return failed | {"outcome": f"not done after {limit:.0f} s"}
    if run.returncode:
        said = run.stderr.strip().splitlines() or [f"ended with {run.returncode}"]
        is_killed = run.returncode == KILLED
        outcome = "out of memory" if is_killed else said[-1][:200]
        return failed | {"outcome": outcome}
    return dict(json.loads(run.stdout.strip().splitlines()[-1]))


def main(
    sizes: tuple[int, ...] = SIZES, limit: float = LIMIT, keep: bool = True
) -> pd.DataFrame:
    """All sizes of both kinds; a kind stops at its first size that fails."""
    rows: list[Any] = []
    if keep and _path().exists():
        rows = pd.read_csv(_path()).to_dict("records")
    done = {(row["channels"], row["n_samples"]) for row in rows}
    for channels in CHANNELS:
        for n in sizes:
            if (channels, n) in done:
                continue
            rows.append(apart(n, channels, limit))
            print(rows[-1], flush=True)
            if keep:
                rewrite(_path(), pd.DataFrame(rows), "%.5g")
            if "seconds" not in rows[-1]:
                break
    if keep:
        write_page()
    return pd.DataFrame(rows)


def _path() -> Path:
    return provenance.RESULTS / "scaling.csv"


# --- the page


def exponent(rows: pd.DataFrame, column: str = "seconds") -> float:
    """Slope of log column over log n_samples."""
    rows = rows.dropna(subset=[column])
    if len(rows) < 2:
        return float("nan")
    slope, _ = np.polyfit(np.log(rows["n_samples"]), np.log(rows[column]), 1)
    return float(slope)


def write_page() -> None:
    """The page and the figure from the table."""
    table = pd.read_csv(_path())
    provenance.write("scaling.md", page(table))
    figure(table)


def page(table: pd.DataFrame) -> str:
    """The page as Markdown."""
    found = []
    for channels, title in CHANNELS.items():
        rows = table[table["channels"] == channels].sort_values("n_samples")
        if len(rows):
            last_two = rows.dropna(subset=["seconds"]).tail(2)
            exponents = [exponent(rows), exponent(last_two)]
            exponents += [exponent(rows, "solve_seconds")]
            found.append((title, rows.drop(columns="channels"), exponents))
    values = {"n_parameters": len(DUFFING), "step": STEP, "noise": NOISE}
    return render("benchmarks/pages/scaling.md", found=found, **values)


def figure(table: pd.DataFrame) -> None:
    """Seconds and memory over samples, two panels."""
    # Here, so that the processes that are measured do not load it.
    from problems.tools.pictures import plt, save

    done = table.dropna(subset=["seconds"]).sort_values("n_samples")
    fig, (times, memory) = plt.subplots(1, 2, figsize=(9.5, 4.0), layout="constrained")
    for name, title in CHANNELS.items():
        rows = done[done["channels"] == name]
        n, colour = rows["n_samples"], COLOURS[name]
        times.plot(n, rows["seconds"], "o-", color=colour, label=f"identify, {title}")
        of_it = f"of it solves, {title}"
        times.plot(n, rows["solve_seconds"], "s:", color=colour, label=of_it)
        memory.plot(n, rows["peak_gb"], "o-", color=colour, label=title)
    if len(done):
        ends = np.array([done["n_samples"].min(), done["n_samples"].max()], dtype=float)
        proportional = done["seconds"].min() * ends / ends[0]
        times.plot(ends, proportional, color="0.6", lw=1, label="proportional to n")
    times.set(ylabel="time (s)")
    memory.set(ylabel="peak memory (GB)")
    for ax in (times, memory):
        ax.set(xscale="log", yscale="log", xlabel="samples")
    look: Any = {"loc": "outside lower center", "ncols": 2, "frameon": False}
    fig.legend(*times.get_legend_handles_labels(), fontsize=9, **look)
    save(fig, "scaling.png", dpi=150)


if __name__ == "__main__":
    one = option("one", "")
    if one:
        print(json.dumps(measure(int(one), option("channels", "qp"))))
    elif flag("page"):
        write_page()
    elif flag("quick"):
        main((500, 1000), keep=False)
    else:
        largest = int(float(option("largest", str(SIZES[-1]))))
        chosen_sizes = tuple(n for n in SIZES if n <= largest)
        main(chosen_sizes, float(option("limit", str(LIMIT))))
