"""The page results/thesis/grids.md and its figures, from the tables of `grids`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from problems.thesis import grid_verdicts
from problems.thesis.figures import TANK_4, TRUTH, Example, around
from problems.thesis.grid_points import (
    GRIDS,
    METHODS,
    OF_LEVELS,
    SPARSITY,
    Grid,
    Point,
    diagonal,
)
from problems.thesis.systems import SYSTEMS, System
from problems.tools import markdown
from problems.tools.pictures import plt, save

COLOURS = {"descent": "#d55e00", "solver": "#0072b2"}  # as in the other figures
FIGURES = {
    "henon_heiles": "6.10",
    "schrodinger": "6.12",
    "mass_spring": "6.14",
    "tanks": "6.16",
}


@dataclass(frozen=True, eq=False)
class Truth:
    """The example of a figure, its times (n_samples,) and states, (n_samples,
    n_states).
    """

    example: Example
    t: np.ndarray
    x: np.ndarray


# Share of the error of all states; where the levels have less, the rest circulates.
MOSTLY_FLOWS = 0.2
CIRCULATES = "What is left are flows around the loops of pipes, which change no level."

# --- figures


def draw(table: pd.DataFrame) -> None:
    """A row of two panels per system, a cell per point with its error."""
    figure, axes = plt.subplots(len(GRIDS), 2, figsize=(8.5, 11), layout="constrained")
    systems = table.groupby("system", sort=False)
    for pair, (name, rows) in zip(axes, systems, strict=True):
        finite = rows["error"][np.isfinite(rows["error"])]
        ends = (np.log10(finite.min()), np.log10(finite.max()))
        for ax, method in zip(pair, METHODS, strict=True):
            _panel(ax, rows[rows["method"] == method], ends)
            title = f"{SYSTEMS[str(name)].title}: {method}"
            if method == "descent":
                title += f", {GRIDS[str(name)].epochs} epochs"
            ax.set_title(title, fontsize=10)
    save(figure, "thesis/grids.png", dpi=120)


def _panel(ax: plt.Axes, part: pd.DataFrame, ends: tuple[float, float]) -> None:
    """One grid; ``ends``: log10 of the smallest and largest error of the system."""
    low, high = ends
    cells = part.pivot(index="lambda_H", columns="pruning", values="error")
    cells = cells[list(dict.fromkeys(part["pruning"]))]
    values = np.log10(np.where(np.isfinite(cells), cells, 10**high))
    ax.imshow(values, cmap="viridis_r", vmin=low - 0.1, vmax=high + 0.1, aspect="auto")
    for (i, j), value in np.ndenumerate(cells.to_numpy()):
        is_model = bool(np.isfinite(value))
        is_dark = not is_model or np.log10(value) > (low + high) / 2
        ax.text(
            j,
            i,
            f"{value:.1e}" if is_model else "no model",
            ha="center",
            va="center",
            color="white" if is_dark else "black",
        )
    ax.set_xticks(range(cells.shape[1]), cells.columns)
    ax.set_yticks(range(cells.shape[0]), [f"{w:g}" for w in cells.index])
    ax.set_ylabel("lambda_H")


def draw_paths(
    system: System, grid: Grid, truth: Truth, paths: Mapping[Point, Any]
) -> None:
    """Figures 6.10, 6.12, 6.14, 6.16: trajectories at three points of each grid."""
    figure, axes = plt.subplots(
        len(METHODS),
        len(SPARSITY),
        figsize=(9.5, 6.2),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for row, method in zip(axes, METHODS, strict=True):
        for ax, point in zip(row, diagonal(grid, method), strict=True):
            _trajectory(ax, system, truth, paths[point], COLOURS[method])
            ax.set_title(
                f"lambda_H {point.weight:g}, {point.pruning}",
                fontsize=10,
                color=COLOURS[method],
            )
        row[0].set_ylabel(f"{method}\n{_names(system, truth)[1]}")
    for ax in axes[-1]:
        ax.set_xlabel(_names(system, truth)[0])
    vertical = _curve(system, truth, truth.x)[1]
    horizontal = _curve(system, truth, truth.x)[0]
    axes[0, 0].set(xlim=around(horizontal, 0.2), ylim=around(vertical, 0.3))
    handles, labels = axes[-1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    save(figure, f"thesis/grid_{system.name}.png", dpi=120)


def _names(system: System, truth: Truth) -> tuple[str, str]:
    """Labels of the axes."""
    if system.name == "tanks":
        return "time t", "level of tank 4"
    i, j = truth.example.shown
    return system.states[i], system.states[j]


def _curve(system: System, truth: Truth, x: np.ndarray) -> tuple[Any, Any]:
    """What is drawn of states (n_samples, n_states)."""
    if system.name == "tanks":
        return truth.t, x[:, TANK_4]
    i, j = truth.example.shown
    return x[:, i], x[:, j]


def _trajectory(
    ax: plt.Axes, system: System, truth: Truth, x: Any, colour: str
) -> None:
    ax.plot(*_curve(system, truth, truth.x), color=TRUTH, lw=4, label="truth")
    if system.name == "tanks":
        end = system.n_steps * system.step
        ax.axvline(end, color="0.5", ls="--", lw=1, label="end of the training time")
    if isinstance(x, str):
        ax.text(0.5, 0.92, x, transform=ax.transAxes, ha="center")
    else:
        ax.plot(*_curve(system, truth, x), color=colour, lw=1.2)
    horizontal, vertical = _curve(system, truth, truth.x)
    ax.plot(horizontal[0], vertical[0], "k.", ms=7, label="start")


# --- page


def page(table: pd.DataFrame, readings: pd.DataFrame, n_tests: int) -> str:
    """The grids as text."""
    lines = ["# L1 and pruning (thesis Section 6.5)", "", "![grids](grids.png)", ""]
    lines += [_introduction(n_tests), ""]
    lines += grid_verdicts.section(table, readings)
    for name, rows in table.groupby("system", sort=False):
        system = SYSTEMS[str(name)]
        lines += [f"## {system.title}", ""]
        shown = rows.drop(columns="system").dropna(axis="columns", how="all")
        lines += markdown.frame(shown)
        for method in METHODS:
            lines += [_extremes(method, rows[rows["method"] == method]), ""]
        if name == "tanks":
            lines += [_circulation(rows), ""]
        lines += [f"![{system.title}](grid_{name}.png)", "", _caption(system), ""]
    return "\n".join(lines)


def _introduction(n_tests: int) -> str:
    weight = GRIDS["mass_spring"].force_weight
    return markdown.paragraph(f"""
        Mean l2 error of free runs from {n_tests} unseen starts, clean data; dark is
        worse; both panels of a system share their colours (thesis Figures 6.9, 6.11,
        6.13, 6.15). Left: gradient descent over L1 weight and pruning interval P, with
        the few epochs of the thesis (P equal to the epochs prunes once, at the end),
        and lambda_F {weight:g} on the mass-spring's force. Right: the solver over L1
        weight and threshold (0: nothing is pruned; the last solve is always without
        L1). No model: every term was pruned, or it diverges.
        """)


def _caption(system: System) -> str:
    if system.name == "tanks":
        shown = """Level of tank 4 over time, from the thesis' start inside the training
            range, to twice the training time."""
    else:
        shown = "Phase portrait from the example start of the thesis."
    return markdown.paragraph(f"""
        {shown} Truth grey; three points of each grid, from the least sparsity (left) to
        the most (right); the thesis' Figure {FIGURES[system.name]} shows three
        combinations and does not say in its text which. States as in the thesis, which
        gives no units. The axes follow the truth.
        """)


def _circulation(rows: pd.DataFrame) -> str:
    """What the picture of a level does not show."""
    point = diagonal(GRIDS["tanks"], "descent")[0]
    is_here = (rows["lambda_H"] == point.weight) & (rows["pruning"] == point.pruning)
    least = rows[is_here].iloc[0]
    said = markdown.paragraph(f"""
        Descent with the least sparsity: error {least["error"]:.2g} over all states,
        {least[OF_LEVELS]:.2g} over the four levels.
        """)
    if least[OF_LEVELS] > MOSTLY_FLOWS * least["error"]:
        return said
    return f"{said} {CIRCULATES}"


def _extremes(method: str, part: pd.DataFrame) -> str:
    ordered = part.sort_values("error")
    best = ordered.iloc[0]
    worst = ordered.iloc[-1]
    return (
        f"{method.capitalize()}: best {best['error']:.2g} at lambda_H "
        f"{best['lambda_H']:g}, {best['pruning']}; worst {worst['error']:.2g} at "
        f"{worst['lambda_H']:g}, {worst['pruning']}."
    )
