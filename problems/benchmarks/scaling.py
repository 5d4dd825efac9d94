"""Time and memory of `identify` over the number of samples: the driven Duffing
oscillator, q and p or q alone measured.

python -m problems.benchmarks.scaling [--quick] [--page] [--largest=N] [--limit=SECONDS]

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
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.benchmarks.efficiency.cases import DUFFING, DUFFING_START, duffing_model
from problems.tools.command_line import flag, option
from problems.tools.provenance import RESULTS, ROOT, write

SIZES = (1_000, 10_000, 100_000, 1_000_000)
CHANNELS = {"qp": "q and p measured", "q": "q alone measured"}
STEP, NOISE, SEED = 0.1, 0.03, 9000
COLOURS = {"qp": "#0072b2", "q": "#d55e00"}
TABLE = RESULTS / "scaling.csv"


def data(n_samples: int, channels: str) -> ph.Measurements:
    """One record. The oscillator forgets its start, so errors of the integration do not
    grow with its length.
    """
    k, a, c = DUFFING.values()
    t = STEP * np.arange(n_samples)

    def rates(at: float, x: np.ndarray) -> tuple[float, float]:
        q, p = x.tolist()
        return p, -k * q - a * q**3 - c * p + 2 * np.cos(1.3 * at)

    x = solve_ivp(
        rates, (0.0, t[-1]), DUFFING_START, "LSODA", t, rtol=1e-9, atol=1e-9
    ).y.T
    y = x + NOISE * x.std(axis=0) * np.random.default_rng(SEED).normal(size=x.shape)
    if channels == "q":
        y[:, 1] = np.nan
    return ph.Measurements.from_arrays([t], [y], states=("q", "p"))


def measure(n_samples: int, channels: str) -> dict[str, float | str]:
    """One fit in this process: time, time and iterations in IPOPT (all likelihood
    programs), memory, errors.
    """
    said: list[str] = []
    given = data(n_samples, channels)
    before = _peak()
    began = time.perf_counter()
    fit = ph.identify(duffing_model(), given, progress=said.append)
    seconds = time.perf_counter() - began
    solved = [
        re.search(r"(\d+) iterations, ([\d.]+) s\)", line)
        for line in said
        if line.startswith("maximum")
    ]
    names = {"k": "k", "a": "a", "c": "R_p"}
    errors = [
        abs(fit.values[names[n]] - v) / fit.std_errors[names[n]]
        for n, v in DUFFING.items()
    ]
    return {
        "channels": channels,
        "n_samples": n_samples,
        "seconds": seconds,
        "ipopt_seconds": sum(float(m[2]) for m in solved if m),
        "programs": len(solved),
        "iterations": sum(int(m[1]) for m in solved if m),
        "peak_gb": _peak(),
        "peak_before_gb": before,
        "largest_error_in_std_errors": max(errors),
        "outcome": fit.outcome.status,
    }


def _peak() -> float:
    """Peak memory of this process so far, in GB (Linux counts it in kB, macOS in
    bytes).
    """
    return (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        * (1 if sys.platform == "darwin" else 1024)
        / 1e9
    )


def apart(n_samples: int, channels: str, limit: float) -> dict[str, float | str]:
    """`measure` in a process of its own; a process that dies or takes too long is a row
    as well.
    """
    command = [
        sys.executable,
        "-m",
        "problems.benchmarks.scaling",
        f"--one={n_samples}",
        f"--channels={channels}",
    ]
    failed: dict[str, float | str] = {"channels": channels, "n_samples": n_samples}
    try:
        run = subprocess.run(
            command,
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return failed | {"outcome": f"not done after {limit:.0f} s"}
    if run.returncode:
        reason = (
            run.stderr.strip().splitlines()[-1]
            if run.stderr.strip()
            else f"ended with {run.returncode}"
        )
        return failed | {
            "outcome": "out of memory" if run.returncode == -9 else reason[:200]
        }
    return dict(json.loads(run.stdout.strip().splitlines()[-1]))


def main(
    sizes: tuple[int, ...] = SIZES, limit: float = 3600.0, keep: bool = True
) -> pd.DataFrame:
    """All sizes of both kinds; a kind stops at its first size that fails."""
    rows: list[Any] = (
        pd.read_csv(TABLE).to_dict("records") if keep and TABLE.exists() else []
    )
    done = {(row["channels"], row["n_samples"]) for row in rows}
    for channels in CHANNELS:
        for n in sizes:
            if (channels, n) in done:
                continue
            rows.append(apart(n, channels, limit))
            print(rows[-1], flush=True)
            if keep:
                RESULTS.mkdir(exist_ok=True)
                pd.DataFrame(rows).to_csv(TABLE, index=False, float_format="%.5g")
            if "seconds" not in rows[-1]:
                break
    if keep:
        page()
    return pd.DataFrame(rows)


def exponent(rows: pd.DataFrame, column: str = "seconds") -> float:
    """Slope of log column over log n_samples."""
    rows = rows.dropna(subset=[column])
    if len(rows) < 2:
        return float("nan")
    return float(np.polyfit(np.log(rows["n_samples"]), np.log(rows[column]), 1)[0])


def page() -> None:
    """The page and the figure from the table."""
    table = pd.read_csv(TABLE)
    lines = ["# Time and memory over the number of samples", ""]
    lines += [
        "Driven Duffing oscillator, three parameters, one record sampled every 0.1 s, 3 % noise (its level is",
        "estimated), generic starting values; one core, a process per size. seconds: all of `identify`; ipopt_seconds",
        "and iterations: summed over its likelihood programs; peak_gb: peak memory of the process, peak_before_gb: the",
        "same before `identify` began.",
        "",
    ]
    for channels, title in CHANNELS.items():
        rows = table[table["channels"] == channels].sort_values("n_samples")
        if rows.empty:
            continue
        last = rows.dropna(subset=["seconds"]).tail(2)
        shown = rows.drop(columns="channels").to_string(
            index=False, float_format=lambda v: f"{v:.3g}"
        )
        lines += [f"## {title[0].upper()}{title[1:]}", "", "```text", shown, "```", ""]
        lines += [
            f"Time grows as n^{exponent(rows):.2f} over all sizes, n^{exponent(last):.2f} over the last two; time in "
            f"IPOPT as n^{exponent(rows, 'ipopt_seconds'):.2f}.",
            "",
        ]
    lines += ["![time and memory](scaling.png)"]
    write("scaling.md", "\n".join(lines))
    figure(table)


def figure(table: pd.DataFrame) -> None:
    """Seconds and memory over samples."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, 2, figsize=(9.5, 4.0), layout="constrained")
    for channels, title in CHANNELS.items():
        rows = (
            table[table["channels"] == channels]
            .dropna(subset=["seconds"])
            .sort_values("n_samples")
        )
        colour = COLOURS[channels]
        axes[0].plot(
            rows["n_samples"],
            rows["seconds"],
            "o-",
            color=colour,
            label=f"identify, {title}",
        )
        axes[0].plot(
            rows["n_samples"],
            rows["ipopt_seconds"],
            "s:",
            color=colour,
            label=f"of it IPOPT, {title}",
        )
        axes[1].plot(
            rows["n_samples"], rows["peak_gb"], "o-", color=colour, label=title
        )
    done = table.dropna(subset=["seconds"])
    if not done.empty:
        n = np.array([done["n_samples"].min(), done["n_samples"].max()], dtype=float)
        axes[0].plot(
            n,
            done["seconds"].min() * n / n[0],
            color="0.6",
            lw=1,
            label="proportional to n",
        )
    for ax, label in zip(axes, ("time (s)", "peak memory (GB)"), strict=True):
        ax.set(xscale="log", yscale="log", xlabel="samples", ylabel=label)
    fig.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=2,
        frameon=False,
        fontsize=9,
    )
    fig.savefig(RESULTS / "scaling.png", dpi=150)
    plt.close(fig)


if __name__ == "__main__":
    if one := option("one", ""):
        print(json.dumps(measure(int(one), option("channels", "qp"))))
    elif flag("page"):
        page()
    elif flag("quick"):
        main((500, 1000), keep=False)
    else:
        largest = int(float(option("largest", str(SIZES[-1]))))
        main(tuple(n for n in SIZES if n <= largest), float(option("limit", "3600")))
