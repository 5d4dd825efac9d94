"""Figures A.2 and A.4: trajectories of the models that each integrator found."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis.figures import TANK_4, TRUTH, around
from problems.thesis.systems import System
from problems.tools import markdown
from problems.tools.pictures import plt, save

COLOURS = dict(zip(INTEGRATORS, ("C3", "C1", "C0", "C2"), strict=True))
# Lines that lie on each other stay visible.
WIDTHS = dict(zip(INTEGRATORS, (1.2, 3.0, 2.0, 1.0), strict=True))
# The pipe of the third flow ends at tank 4.
SHOWN = {
    "henon_heiles": {0: "position q1", 2: "momentum p1"},
    "tanks": {TANK_4: "level of tank 4", 2: "flow in the pipe\nbetween tanks 1 and 4"},
}
FIGURES = {"Henon-Heiles": "A.2", "Tanks, neural leak": "A.4"}


@dataclass(frozen=True, eq=False)
class Truth:
    """The true trajectory of an example: times (n_samples,), states (n_samples,
    n_states).
    """

    system: System
    t: np.ndarray
    x: np.ndarray


@dataclass(frozen=True, eq=False)
class Paths:
    """Trajectories by title of the system, noise and integrator, None where one
    diverges; truths by title.
    """

    found: dict[tuple[str, float, str], Any] = field(default_factory=dict)
    truths: dict[str, Truth] = field(default_factory=dict)


def file_of(title: str) -> str:
    """Name of the figure of a system."""
    return f"integrators_{title.split(',')[0].lower().replace('-', '_')}.png"


def draw(paths: Paths) -> None:
    """A figure per system of the thesis: a column per noise, the error below."""
    for title in FIGURES:
        _figure(title, paths)


def _figure(title: str, paths: Paths) -> None:
    truth = paths.truths[title]
    noises = list(dict.fromkeys(n for name, n, _ in paths.found if name == title))
    shown = SHOWN[truth.system.name]
    fig, axes = plt.subplots(
        len(shown) + 1,
        len(noises),
        figsize=(11, 7.6),
        sharex=True,
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    end = truth.system.n_steps * truth.system.step
    for column, noise in zip(axes.T, noises, strict=True):
        runs = {name: paths.found[title, noise, name] for name in INTEGRATORS}
        for ax, state in zip(column[:-1], shown, strict=True):
            _curves(ax, truth, runs, state)
        _errors(column[-1], truth, runs)
        for ax in column:
            ax.axvline(end, color="0.5", ls="--", lw=1, label="end of training")
            ax.grid(alpha=0.3)
        column[0].set_title(f"noise {noise:g} (units of the states)", fontsize=10)
        column[-1].set_xlabel("time t")
    for row, label in zip(axes, [*shown.values(), "l2 error, all states"], strict=True):
        row[0].set_ylabel(label)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    save(fig, f"thesis/{file_of(title)}", dpi=120)


def _curves(ax: plt.Axes, truth: Truth, runs: dict[str, Any], state: int) -> None:
    ax.plot(truth.t, truth.x[:, state], color=TRUTH, lw=6, label="truth")
    for name, x in runs.items():
        if x is not None:
            ax.plot(
                truth.t,
                x[:, state],
                color=COLOURS[name],
                lw=WIDTHS[name],
                label=name,
            )
    ax.set_ylim(*around(truth.x[:, state], 0.25))


def _errors(ax: plt.Axes, truth: Truth, runs: dict[str, Any]) -> None:
    for name, x in runs.items():
        if x is not None:
            error = np.linalg.norm(x - truth.x, axis=1)[1:]
            ax.plot(truth.t[1:], error, color=COLOURS[name], lw=1.4)
    ax.set_yscale("log")


def caption(title: str, paths_end: float) -> str:
    """Caption of the figure of a system, whose time ends at ``paths_end``."""
    return markdown.paragraph(f"""
        {title} (thesis Figure {FIGURES[title]}): free runs of the models found with
        each integrator, first draw, from the example start of the thesis to
        t = {paths_end:g}, beyond the training time; below, the norm of the error over
        all states (logarithmic). The axes follow the truth; a line that leaves them is
        off. States and time as in the thesis, which gives no units.
        """)
