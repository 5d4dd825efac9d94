"""The figures of the thesis: trajectories, errors over time, grids of errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.runs import Done
from problems.thesis.scores import common_name, leak_of
from problems.thesis.systems import System, leak
from problems.tools.pictures import legend_below, panels, plt, save

TRUTH = "0.75"  # grey
TANK_4 = 8  # the state that is the level of tank 4
N_SAMPLES = 501  # of a trajectory that is drawn


@dataclass(frozen=True)
class Example:
    """A start of which the thesis shows the trajectory, until when, and two states."""

    start: tuple[float, ...]
    end: float
    shown: tuple[int, int] = (0, 1)


EXAMPLES = {
    "henon_heiles": Example((0.1, -0.2, 0.4, 0.5), 10.0),  # Figure 6.1
    # Figure 6.3, which does not say until when
    "schrodinger": Example((-0.3, 0.5, -0.2, -0.4), 8.0, (0, 2)),
    "mass_spring": Example((-3.4, -1.9), 10.0),  # Figure 6.5
    # Figure 6.7, inside the training range, to twice the training time
    "tanks": Example((-0.4, 0.0, 0.5, 0.0, 0.2, 0.0, -0.6, -0.5, 0.5), 1.0),
}
# Figure 6.7, outside the training range.
OUTSIDE = Example((10.0, 19.0, 4.0, 19.0, 7.0, 9.0, 17.0, 9.0, 11.0), 1.0)

# Results by label, under a title.
Panel = tuple[str, Mapping[str, Any]]


def trajectories(
    name: str,
    system: System,
    rows: Sequence[Sequence[Panel]],
    example: Example | None = None,
) -> None:
    """Free runs from the thesis' example, a panel for some results; phase portraits, of
    the tanks the level of tank 4 over time. The axes follow the truth.
    """
    example = example or EXAMPLES[system.name]
    t = np.linspace(0.0, example.end, N_SAMPLES)
    i, j = example.shown

    def curve(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (t, x[:, TANK_4]) if system.name == "tanks" else (x[:, i], x[:, j])

    names = (system.states[i], system.states[j])
    names = ("time t", "level of tank 4") if system.name == "tanks" else names
    true = curve(system.solve(np.array(example.start), t))
    n = max(map(len, rows))
    size = (max(2.2 * n, 5.0), 2.5 * len(rows) + 0.8)
    figure, axes = panels(len(rows), n, size, shared=True)
    for of_row, row in zip(rows, axes, strict=True):
        for (title, results), ax in zip(of_row, row, strict=False):
            ax.plot(*true, color=TRUTH, lw=4, label="truth")
            ends = []
            for k, (label, result) in enumerate(results.items()):
                x = simulated(result, t, example.start)
                if x is None:
                    ends.append("no model, or it diverges")
                else:
                    width = 1.8 - 0.3 * k
                    ax.plot(*curve(x), color=f"C{k}", lw=width, label=label)
            ax.text(0.5, 0.92, "\n".join(ends), transform=ax.transAxes, ha="center")
            ax.set_title(title, fontsize=9)
        row[0].set_ylabel(names[1])
    for ax in axes[-1]:
        ax.set_xlabel(names[0])
    limits = [around(values) for values in true]
    axes[0, 0].set(xlim=limits[0], ylim=limits[1])
    if len(axes[0, 0].lines) > 2:
        legend_below(axes[0, 0])
    save(figure, f"thesis/{name}.png", dpi=110)


def simulated(result: Any, t: np.ndarray, start: tuple[float, ...]) -> Any:
    """The trajectory, or None where there is none or the simulation ends early."""
    if isinstance(result, ph.PhsiOptError):
        return None
    try:
        return np.asarray(result.simulate(t, np.array(start)))
    except ph.SolveError:
        return None


def around(values: np.ndarray) -> tuple[float, float]:
    """Limits of an axis: the range of the values and a quarter of it at both ends."""
    low, high = values.min(), values.max()
    pad = 0.25 * (high - low)
    return low - pad, high + pad


def errors_over_time(name: str, found: Mapping[str, Sequence[Done]]) -> None:
    """Figures 6.2, 6.6, 6.8: l2 error over time, mean over the unseen starts, for clean
    and noisy data.
    """
    figure, axes = panels(1, 2, (11, 4.2))
    for ax, (kind, runs) in zip(axes[0], found.items(), strict=True):
        for k, one in enumerate(runs):
            t = one.setting.tests[0]
            label = one.method
            look = {"color": f"C{k % 10}", "ls": "-" if k < 10 else "--"}
            ax.plot(t[1:], one.curve[1:], **look, lw=1.4, label=label)
            end = one.setting.system.n_steps * one.setting.system.step
        ax.axvline(end, color="0.5", ls="--", lw=1, label="end of the training time")
        ax.set(yscale="log", xlabel="time t", ylabel="l2 error", title=f"{kind} data")
        ax.grid(alpha=0.3)
    legend_below(axes[0, 1])
    save(figure, f"thesis/{name}.png", dpi=110)


def learned_coefficients(name: str, found: Sequence[Done]) -> None:
    """Figure 6.4: learned against true coefficients."""
    figure, axes = panels(1, len(found), (3.7 * len(found), 3.7), shared=True)
    for ax, one in zip(axes[0], found, strict=True):
        system, result = one.setting.system, one.result
        is_first_order = isinstance(result.model, ph.FirstOrder)
        truth = system.truth_first_order if is_first_order else system.truth
        values = {common_name(name): value for name, value in result.values.items()}
        names = dict.fromkeys([*truth, *values])
        ax.axline((0, 0), slope=1, color="0.6", ls=":", lw=1)
        x = [truth.get(name, 0.0) for name in names]
        ax.plot(x, [values.get(name, 0.0) for name in names], "o", ms=5, alpha=0.6)
        ax.set(title=one.method, xlabel="true")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("learned")
    save(figure, f"thesis/{name}.png", dpi=110)


def leaks(name: str, found: Sequence[Done]) -> None:
    """Figure 6.7: the leak of tank 4 over the levels in the data."""
    figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
    data = found[0].setting.data
    visited = np.concatenate([run.x[:, TANK_4] for run in data.trajectories])
    level = np.linspace(visited.min(), visited.max(), 401)
    ax.plot(level, leak(level), color=TRUTH, lw=6, label="truth")
    for one in found:
        ax.plot(level, leak_of(one.result, level), label=one.method)
    ax.set(xlabel="level of tank 4", ylabel="flow by the leak")
    ax.legend(frameon=False)
    save(figure, f"thesis/{name}.png", dpi=110)


def grids(name: str, rows: pd.DataFrame) -> None:
    """Figures 6.9, 6.11, 6.13, 6.15: a row of panels per system, one per method, a cell
    per point with its error.
    """
    systems = list(rows.groupby("system", sort=False))
    figure, axes = panels(len(systems), 2, (8.5, 2.8 * len(systems)))
    for pair, (system, part) in zip(axes, systems, strict=True):
        finite = np.log10(part["l2 whole"][np.isfinite(part["l2 whole"])])
        low, high = finite.min(), finite.max()
        for ax, (method, own) in zip(
            pair, part.groupby("method", sort=False), strict=True
        ):
            cells = own.pivot(index="lambda_H", columns="pruning", values="l2 whole")
            cells = cells[list(dict.fromkeys(own["pruning"]))]
            values = np.log10(np.where(np.isfinite(cells), cells, 10**high))
            look: Any = {"vmin": low - 0.1, "vmax": high + 0.1, "aspect": "auto"}
            ax.imshow(values, cmap="viridis_r", **look)
            for (i, j), value in np.ndenumerate(cells.to_numpy()):
                is_dark = not np.log10(value) <= (low + high) / 2
                text = f"{value:.1e}" if np.isfinite(value) else "no model"
                colour = "white" if is_dark else "black"
                ax.text(j, i, text, ha="center", va="center", color=colour)
            ax.set_xticks(range(cells.shape[1]), cells.columns)
            ax.set_yticks(range(cells.shape[0]), [f"{w:g}" for w in cells.index])
            ax.set_title(f"{system}: {method}", fontsize=10)
            ax.set_ylabel("lambda_H")
    save(figure, f"thesis/{name}.png", dpi=110)


def errors_over_noise(name: str, rows: pd.DataFrame, by: str) -> None:
    """Figures A.1, A.3: error of free runs at each noise, a colour for each of ``by``;
    dots are medians, bars the range over the draws.
    """
    systems = list(rows.groupby("system", sort=False))
    figure, axes = panels(1, len(systems), (4 * len(systems), 4))
    for ax, (system, part) in zip(axes[0], systems, strict=True):
        for k, (label, own) in enumerate(part.groupby(by, sort=False)):
            runs = own.groupby("noise")["l2 whole"]
            middle = runs.median()
            bars = np.array([middle - runs.min(), runs.max() - middle])
            places = np.arange(len(middle)) + 0.16 * (k - 1.5)
            ax.errorbar(places, middle, bars, fmt="o", capsize=3, label=str(label))
        levels = [f"{level:g}" for level in middle.index]
        ax.set_xticks(range(len(levels)), levels)
        ax.set(yscale="log", title=str(system), xlabel="noise", ylabel="l2 error")
        ax.grid(axis="y", alpha=0.3)
    legend_below(axes[0, 0])
    save(figure, f"thesis/{name}.png", dpi=110)
