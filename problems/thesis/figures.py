"""The figures of thesis Chapter 6 (6.1-6.8), drawn from the results of `experiments`;
one colour per method in all.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.thesis.scores import common_name, leak_of, without_leak
from problems.thesis.systems import System, closed_tanks, leak
from problems.tools import markdown
from problems.tools.pictures import plt, save

COLOURS = {
    "PHSI, solver": "#0072b2",
    "PHSI, likelihood": "#56b4e9",
    "PHSI, threshold alone": "#8c8c8c",
    "PHSI, descent": "#d55e00",
    "BSI, solver": "#009e73",
    "BSI, descent": "#e69f00",
    "SINDy, STLSQ": "#cc79a7",
    "SINDy, SR3": "#882255",
    "LASSO": "#661100",
    "SSINN": "#8a8a00",
    "PHNN": "#222222",
}
TRUTH = "0.75"  # grey
# Lines that lie on each other stay visible.
WIDTHS = (4.0, 2.8, 1.8, 1.2, 1.2, 1.2, 1.2)
TANK_4 = 8  # the state that is the level of tank 4
CENTRAL = (0.025, 0.975)  # of the levels of tank 4 in the data


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
}
# Figure 6.7: starts inside and outside the training range.
INSIDE = Example((-0.4, 0.0, 0.5, 0.0, 0.2, 0.0, -0.6, -0.5, 0.5), 0.5)
TANK_EXAMPLE = Example((10.0, 19.0, 4.0, 19.0, 7.0, 9.0, 17.0, 9.0, 11.0), 1.0)

Results = Mapping[str, Any]  # by method
ByKind = Mapping[str, Results]


@dataclass(frozen=True)
class Figure:
    """A figure that was drawn: file beside the page, and caption."""

    name: str
    caption: str


@dataclass(frozen=True, eq=False)
class Curves:
    """Errors over time (n_samples,) by method, mean over the starts that do not
    diverge, and how many do.
    """

    t: np.ndarray
    errors: Mapping[str, np.ndarray]
    diverged: Mapping[str, int]


def draw(
    system: System,
    noisy: ph.Measurements,
    results: ByKind,
    curves: Mapping[str, Curves],
) -> list[Figure]:
    """Every figure of one system; ``noisy``: its noisy data."""
    drawn = []
    if system.name in EXAMPLES:
        drawn.append(trajectories(system, results))
    drawn.append(error_curves(system, results, curves))
    if system.name == "schrodinger":
        drawn.append(coefficient_plot(system, results["noisy"]))
    if system.name == "tanks":
        drawn.append(leaks(system, noisy, lines(system, results["noisy"])))
        drawn.append(convergence(results))
    return drawn


def lines(system: System, results: Results) -> dict[str, Any]:
    """The at most seven methods of a figure."""
    last = "SSINN" if system.name == "henon_heiles" else "BSI, descent"
    labels = (
        "PHSI, solver",
        "PHSI, likelihood",
        "PHSI, descent",
        "BSI, solver",
        last,
        "SINDy, STLSQ",
        "PHNN",
    )
    found = {}
    for label in labels:
        result = results.get(label)
        if result is not None and not isinstance(result, ph.PhsiOptError):
            found[label] = result
    return found


def simulated(result: Any, t: np.ndarray, start: tuple[float, ...]) -> Any:
    """The trajectory, or None where there is none or the simulation ends early."""
    if result is None or isinstance(result, ph.PhsiOptError):
        return None
    try:
        return np.asarray(result.simulate(t, np.array(start)))
    except ph.SolveError:
        return None


# --- trajectories


def trajectories(system: System, results: ByKind) -> Figure:
    """Figures 6.1, 6.3, 6.5: the thesis' example start, a panel per method."""
    example = EXAMPLES[system.name]
    t = np.linspace(0.0, example.end, 501)
    truth = system.solve(np.array(example.start), t)
    labels = list(lines(system, results["noisy"]))
    fig, axes = plt.subplots(
        2, len(labels), figsize=(11, 4), sharex=True, sharey=True, layout="constrained"
    )
    i, j = example.shown
    for row, kind in zip(axes, ("clean", "noisy"), strict=True):
        for ax, label in zip(row, labels, strict=True):
            ax.plot(truth[:, i], truth[:, j], color=TRUTH, lw=3)
            result = results[kind].get(label)
            x = simulated(result, t, example.start)
            if x is None:
                why = "no result" if result is None else "diverges"
                ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center")
            else:
                ax.plot(x[:, i], x[:, j], color=COLOURS[label], lw=1)
        row[0].set_ylabel(f"{kind} data\n{system.states[j]}")
    for ax, label in zip(axes[0], labels, strict=True):
        ax.set_title(label, fontsize=9, color=COLOURS[label])
    for ax in axes[-1]:
        ax.set_xlabel(system.states[i])
    axes[0, 0].set(xlim=around(truth[:, i], 0.2), ylim=around(truth[:, j], 0.2))
    start = ", ".join(f"{value:g}" for value in example.start)
    outside = ""
    if system.name == "schrodinger":
        outside = ", a start outside the training range"
    caption = f"""
        One trajectory from ({start}){outside}, t = 0 to {example.end:g}: truth grey,
        each method in its colour.
        """
    return _saved(fig, f"{system.name}_trajectory.png", caption)


def around(values: np.ndarray, margin: float) -> tuple[float, float]:
    """Limits of an axis: the range of the values and a share of it at both ends."""
    low = values.min()
    high = values.max()
    pad = margin * (high - low)
    return low - pad, high + pad


def error_curves(
    system: System, results: ByKind, curves: Mapping[str, Curves]
) -> Figure:
    """Figures 6.2, 6.6, 6.8: l2 error over time, mean over the unseen starts."""
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for ax, kind in zip(axes, ("clean", "noisy"), strict=True):
        found = curves[kind]
        for k, label in enumerate(lines(system, results[kind])):
            ax.plot(
                found.t[1:],
                found.errors[label][1:],
                ":" if found.diverged.get(label, 0) else "-",
                lw=WIDTHS[k],
                color=COLOURS[label],
                label=label,
            )
        end = system.n_steps * system.step
        ax.axvline(end, color="0.5", ls="--", lw=1, label="end of the training time")
        ax.set(yscale="log", xlabel="time t", ylabel="l2 error", title=f"{kind} data")
        ax.grid(alpha=0.3)
    handles, labels = axes[1].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    caption = """
        l2 error of free runs over time, mean over the unseen starts. Dotted: some
        starts diverge (see the table), and the line is the mean of the others.
        """
    return _saved(fig, f"{system.name}_error.png", caption)


# --- coefficients


def coefficient_plot(system: System, results: Results) -> Figure:
    """Figure 6.4: learned against true coefficients."""
    fig, axes = plt.subplots(
        1, 3, figsize=(11, 3.9), sharex=True, sharey=True, layout="constrained"
    )
    labels = ("PHSI, solver", "BSI, solver", "SINDy, STLSQ")
    for ax, label in zip(axes, labels, strict=True):
        is_first_order = isinstance(results[label].model, ph.FirstOrder)
        truth = system.truth_first_order if is_first_order else system.truth
        values = results[label].values
        found = {common_name(name): value for name, value in values.items()}
        names = list(dict.fromkeys([*truth, *found]))
        x = np.array([truth.get(name, 0.0) for name in names])
        y = np.array([found.get(name, 0.0) for name in names])
        ax.axline((0, 0), slope=1, color="0.6", ls=":", lw=1)
        ax.plot(x, y, "o", ms=5, alpha=0.6, color=COLOURS[label])
        counted = f"{np.sum(y != 0)} terms ({len(truth)} true)"
        largest = f"largest error {np.max(np.abs(x - y)):.2g}"
        ax.set(title=f"{label}: {counted}\n{largest}", xlabel="true")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("learned")
    caption = """
        Learned against true coefficients, noisy data (thesis Figure 6.4). PHSI learns
        those of H, the others those of the right-hand side, so the points are not the
        same terms. Dots above 0 are terms too many.
        """
    return _saved(fig, f"{system.name}_coefficients.png", caption)


# --- the tanks


def leaks(system: System, noisy: ph.Measurements, results: Results) -> Figure:
    """Figure 6.7: level of tank 4 inside and outside the training range, the leak, and
    the system without it.
    """
    fig, axes = plt.subplots(2, 2, figsize=(11, 7.5), layout="constrained")
    _levels(axes[0, 0], system, results, INSIDE)
    _levels(axes[1, 0], system, results, TANK_EXAMPLE)
    axes[0, 0].set_title("level, start inside the training range")
    axes[1, 0].set_title("level, start outside the training range")
    with_leak = {k: r for k, r in results.items() if k.startswith("PHSI")}
    _leak_over_levels(axes[0, 1], noisy, with_leak)
    _shut(axes[1, 1], system, with_leak)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    more_handles, more_labels = axes[0, 1].get_legend_handles_labels()
    fig.legend(
        handles + more_handles,
        labels + more_labels,
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )
    caption = """
        The tanks, noisy data (thesis Figure 6.7). Left: level of tank 4 from the
        thesis' two starts; the axis follows the truth, a line that leaves it is off.
        Right: the leak that the PHSI models found, and their prediction with the leak
        shut, which was never measured. BSI and SINDy have no part to shut.
        """
    return _saved(fig, "tanks_leak.png", caption)


def _levels(ax: plt.Axes, system: System, results: Results, example: Example) -> None:
    """Level of tank 4 over time, truth and all methods."""
    t = np.linspace(0.0, example.end, 301)
    truth = system.solve(np.array(example.start), t)[:, TANK_4]
    ax.plot(t, truth, color=TRUTH, lw=6, label="truth")
    for width, (label, result) in zip(WIDTHS, results.items(), strict=False):
        x = simulated(result, t, example.start)
        if x is not None:
            level = x[:, TANK_4]
            ax.plot(t, level, color=COLOURS[label], lw=width / 1.5, label=label)
    ax.set(ylim=around(truth, 0.25), xlabel="time t", ylabel="level of tank 4")


def _leak_over_levels(ax: plt.Axes, noisy: ph.Measurements, results: Results) -> None:
    visited = np.concatenate([run.x[:, TANK_4] for run in noisy.trajectories])
    level = np.linspace(visited.min(), visited.max(), 401)
    low, high = np.quantile(visited, CENTRAL)
    share = f"central {CENTRAL[1] - CENTRAL[0]:.0%} of the levels"
    ax.axvspan(low, high, color="0.94", label=share)
    ax.plot(level, leak(level), color=TRUTH, lw=6)
    for label, result in results.items():
        ax.plot(level, leak_of(result, level), color=COLOURS[label], lw=1.2)
    ax.set(
        xlabel="level of tank 4",
        ylabel="flow by the leak",
        title="leak over the visited levels",
    )


def _shut(ax: plt.Axes, system: System, results: Results) -> None:
    """Level of tank 4 with the leak shut, truth and models without their force."""
    t = np.linspace(0.0, 1.0, 301)
    start = np.array(INSIDE.start)
    truth = replace(system, rhs=closed_tanks).solve(start, t)[:, TANK_4]
    ax.plot(t, truth, color=TRUTH, lw=6)
    for label, result in results.items():
        level = without_leak(result).simulate(t, start)[:, TANK_4]
        ax.plot(t, level, color=COLOURS[label], lw=1.2)
    ax.set(
        xlabel="time t",
        ylabel="level of tank 4",
        title="leak shut: predicted by the model without its force",
    )


def convergence(results: ByKind) -> Figure:
    """The turns of the hybrid: loss and movement of coefficients and force."""
    fig, (losses, changes) = plt.subplots(1, 2, figsize=(11, 3.9), layout="constrained")
    colours = {"coefficient_change": "#6a3d9a", "force_change": "#b15928"}
    for kind, style in (("clean", "--"), ("noisy", "-")):
        turns = results[kind]["PHSI, solver"].convergence
        look = {"ls": style, "marker": "o", "ms": 4}
        losses.plot(
            turns["turn"], turns["loss"], color="#0072b2", label=f"{kind} data", **look
        )
        for column, colour in colours.items():
            label = f"{column.replace('_', ' ')}, {kind}"
            changes.plot(
                turns["turn"], turns[column], color=colour, label=label, **look
            )
    losses.set(ylabel="mean squared defect")
    changes.set(ylabel="relative change since the last turn")
    for ax in (losses, changes):
        ax.set(yscale="log", xlabel="turn")
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.grid(alpha=0.3)
        ax.legend(frameon=False)
    caption = """
        The turns of the hybrid of solver and network: loss after every turn, and how
        far coefficients and force still move. Terms are pruned from the third turn on.
        """
    return _saved(fig, "tanks_convergence.png", caption)


def _saved(fig: Any, name: str, caption: str) -> Figure:
    save(fig, f"thesis/{name}", dpi=120)
    return Figure(name, markdown.paragraph(caption))
