"""The figure of the benchmark `scaling`: seconds and memory over samples.

In a file of its own, so that the processes that are measured do not load it.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from problems.tools.pictures import plt, save


def figure(
    table: pd.DataFrame, channels: Mapping[str, str], colours: Mapping[str, str]
) -> None:
    """Two panels; ``channels``: what was measured, by the name in the table."""
    done = table.dropna(subset=["seconds"]).sort_values("n_samples")
    fig, (times, memory) = plt.subplots(1, 2, figsize=(9.5, 4.0), layout="constrained")
    for name, title in channels.items():
        rows = done[done["channels"] == name]
        n = rows["n_samples"]
        colour = colours[name]
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
    handles, labels = times.get_legend_handles_labels()
    fig.legend(
        handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9
    )
    save(fig, "scaling.png", dpi=150)
