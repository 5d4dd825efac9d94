"""The figures of thesis Chapter 6 (6.1-6.8), drawn from the results of `experiments`;
one colour per method in all.
"""

from dataclasses import replace
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import phsi_opt as ph
from problems.thesis.scores import common_name, leak_of, without_leak
from problems.thesis.systems import System, closed_tanks, leak
from problems.tools.provenance import RESULTS

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
EXAMPLES: dict[
    str, tuple[tuple[float, ...], float, tuple[int, int]]
] = {  # start, end, the two states that are shown
    "henon_heiles": ((0.1, -0.2, 0.4, 0.5), 10.0, (0, 1)),  # Figure 6.1
    "schrodinger": (
        (-0.3, 0.5, -0.2, -0.4),
        8.0,
        (0, 2),
    ),  # Figure 6.3, which does not say until when
    "mass_spring": ((-3.4, -1.9), 10.0, (0, 1)),  # Figure 6.5
}
WIDTHS = (
    4.0,
    2.8,
    1.8,
    1.2,
    1.2,
    1.2,
    1.2,
)  # lines that lie on each other stay visible
INSIDE = (-0.4, 0.0, 0.5, 0.0, 0.2, 0.0, -0.6, -0.5, 0.5)  # Figure 6.7
OUTSIDE = (10.0, 19.0, 4.0, 19.0, 7.0, 9.0, 17.0, 9.0, 11.0)


def draw(system: System, shown: dict[str, Any]) -> list[tuple[str, str]]:
    """File name and caption of every figure of one system."""
    made = [trajectories(system, shown)] if system.name in EXAMPLES else []
    made.append(error_curves(system, shown))
    if system.name == "schrodinger":
        made.append(coefficient_plot(system, shown["results"]["noisy"]))
    if system.name == "tanks":
        made += [leaks(system, shown), convergence(system, shown["results"])]
    return made


def lines(system: System, results: dict[str, Any]) -> dict[str, Any]:
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
    return {
        k: results[k]
        for k in labels
        if k in results and not isinstance(results[k], ph.PhsiOptError)
    }


def simulated(result: Any, t: np.ndarray, x0: Any) -> np.ndarray | None:
    """The trajectory, or None where the simulation ends early."""
    try:
        return np.asarray(result.simulate(t, np.array(x0)))
    except ph.SolveError:
        return None


def trajectories(system: System, shown: dict[str, Any]) -> tuple[str, str]:
    """Figures 6.1, 6.3, 6.5: the thesis' example start, a panel per method."""
    x0, end, (i, j) = EXAMPLES[system.name]
    t = np.linspace(0.0, end, 501)
    truth = system.solve(np.array(x0), t)
    labels = list(lines(system, shown["results"]["noisy"]))
    fig, axes = plt.subplots(
        2, len(labels), figsize=(11, 4), sharex=True, sharey=True, layout="constrained"
    )
    for row, kind in zip(axes, ("clean", "noisy"), strict=True):
        for ax, label in zip(row, labels, strict=True):
            ax.plot(truth[:, i], truth[:, j], color="0.75", lw=3)
            result = shown["results"][kind].get(label)
            x = (
                None
                if isinstance(result, ph.PhsiOptError)
                else simulated(result, t, x0)
            )
            if x is None:
                ax.text(
                    0.5,
                    0.5,
                    "no result" if result is None else "diverges",
                    transform=ax.transAxes,
                    ha="center",
                )
            else:
                ax.plot(x[:, i], x[:, j], color=COLOURS[label], lw=1)
            if kind == "clean":
                ax.set_title(label, fontsize=9, color=COLOURS[label])
        row[0].set_ylabel(f"{kind} data\n{system.states[j]}")
    for axis, k in (("x", i), ("y", j)):
        low, high = truth[:, k].min(), truth[:, k].max()
        pad = 0.2 * (high - low)
        axes[0, 0].set(**{f"{axis}lim": (low - pad, high + pad)})
    for ax in axes[-1]:
        ax.set_xlabel(system.states[i])
    outside = (
        ", a start outside the training range" if system.name == "schrodinger" else ""
    )
    return _saved(fig, f"{system.name}_trajectory.png"), (
        f"One trajectory from ({', '.join(f'{v:g}' for v in x0)}){outside}, t = 0 to {end:g}: truth grey, each method "
        "in its colour."
    )


def error_curves(system: System, shown: dict[str, Any]) -> tuple[str, str]:
    """Figures 6.2, 6.6, 6.8: l2 error over time, mean over the unseen starts."""
    t = shown["t"]
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for ax, kind in zip(axes, ("clean", "noisy"), strict=True):
        for k, label in enumerate(lines(system, shown["results"][kind])):
            lost = shown["diverged"][kind].get(label, 0)
            ax.plot(
                t[1:],
                shown["curves"][kind][label][1:],
                ":" if lost else "-",
                lw=WIDTHS[k],
                color=COLOURS[label],
                label=label,
            )
        ax.axvline(
            system.n_steps * system.step,
            color="0.5",
            ls="--",
            lw=1,
            label="end of the training time",
        )
        ax.set(yscale="log", xlabel="time t", title=f"{kind} data")
        ax.grid(alpha=0.3)
        ax.set_ylabel("l2 error")
    handles, labels = axes[1].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return _saved(fig, f"{system.name}_error.png"), (
        "l2 error of free runs over time, mean over 30 unseen starts. Dotted: some starts diverge (see the table), and "
        "the line is the mean of the others."
    )


def coefficient_plot(system: System, results: dict[str, Any]) -> tuple[str, str]:
    """Figure 6.4: learned against true coefficients."""
    fig, axes = plt.subplots(
        1, 3, figsize=(11, 3.9), sharex=True, sharey=True, layout="constrained"
    )
    for ax, label in zip(
        axes, ("PHSI, solver", "BSI, solver", "SINDy, STLSQ"), strict=True
    ):
        model = results[label].model
        truth = dict(
            system.truth_first_order
            if isinstance(model, ph.FirstOrder)
            else system.truth
        )
        found = {common_name(n): v for n, v in results[label].values.items()}
        names = list(dict.fromkeys([*truth, *found]))
        x, y = (np.array([of.get(n, 0.0) for n in names]) for of in (truth, found))
        ax.axline((0, 0), slope=1, color="0.6", ls=":", lw=1)
        ax.plot(x, y, "o", ms=5, alpha=0.6, color=COLOURS[label])
        n_terms, worst = int(np.sum(y != 0)), np.max(np.abs(x - y))
        ax.set(
            title=f"{label}: {n_terms} terms ({len(truth)} true)\nlargest error {worst:.2g}",
            xlabel="true",
        )
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("learned")
    return _saved(fig, f"{system.name}_coefficients.png"), (
        "Learned against true coefficients, noisy data (thesis Figure 6.4). PHSI learns those of H, the others those "
        "of the right-hand side, so the points are not the same terms. Dots above 0 are terms too many."
    )


def leaks(system: System, shown: dict[str, Any]) -> tuple[str, str]:
    """Figure 6.7: level of tank 4 inside and outside the training range, the leak, and
    the system without it.
    """

    results = lines(system, shown["results"]["noisy"])
    fig, axes = plt.subplots(2, 2, figsize=(11, 7.5), layout="constrained")
    for ax, x0, end, title in (
        (axes[0, 0], INSIDE, 0.5, "level, start inside the training range"),
        (axes[1, 0], OUTSIDE, 1.0, "level, start outside the training range"),
    ):
        t = np.linspace(0.0, end, 301)
        truth = system.solve(np.array(x0), t)[:, 8]
        ax.plot(t, truth, color="0.75", lw=6, label="truth")
        for k, (label, result) in enumerate(results.items()):
            x = simulated(result, t, x0)
            if x is not None:
                ax.plot(
                    t, x[:, 8], color=COLOURS[label], lw=WIDTHS[k] / 1.5, label=label
                )
        pad = 0.25 * np.ptp(truth)
        ax.set(
            ylim=(truth.min() - pad, truth.max() + pad),
            xlabel="time t",
            ylabel="level of tank 4",
            title=title,
        )
    forces = {k: r for k, r in results.items() if k.startswith("PHSI")}
    visited = np.concatenate(
        [run.x[:, 8] for run in shown["data"]["noisy"].trajectories]
    )
    level = np.linspace(visited.min(), visited.max(), 401)
    ax = axes[0, 1]
    ax.axvspan(
        *np.quantile(visited, [0.025, 0.975]),
        color="0.94",
        label="central 95 % of the levels",
    )
    ax.plot(level, leak(level), color="0.75", lw=6)
    for label, result in forces.items():
        ax.plot(level, leak_of(result, level), color=COLOURS[label], lw=1.2)
    ax.set(
        xlabel="level of tank 4",
        ylabel="flow by the leak",
        title="leak over the visited levels",
    )
    ax, t = axes[1, 1], np.linspace(0.0, 1.0, 301)
    ax.plot(
        t,
        replace(system, rhs=closed_tanks).solve(np.array(INSIDE), t)[:, 8],
        color="0.75",
        lw=6,
    )
    for label, result in forces.items():
        ax.plot(
            t,
            without_leak(result).simulate(t, np.array(INSIDE))[:, 8],
            color=COLOURS[label],
            lw=1.2,
        )
    ax.set(
        xlabel="time t",
        ylabel="level of tank 4",
        title="leak shut: predicted by the model without its force",
    )
    handles, labels = (
        a + b
        for a, b in zip(
            axes[0, 0].get_legend_handles_labels(),
            axes[0, 1].get_legend_handles_labels(),
            strict=True,
        )
    )
    fig.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    return _saved(fig, "tanks_leak.png"), (
        "The tanks, noisy data (thesis Figure 6.7). Left: level of tank 4 from the thesis' two starts; the axis "
        "follows the truth, a line that leaves it is off. Right: the leak that the PHSI models found, and their "
        "prediction with the leak shut, which was never measured. BSI and SINDy have no part to shut."
    )


def convergence(system: System, results: dict[str, dict[str, Any]]) -> tuple[str, str]:
    """The turns of the hybrid: loss and movement of coefficients and force."""
    fig, axes = plt.subplots(1, 2, figsize=(11, 3.9), layout="constrained")
    for kind, style in (("clean", "--"), ("noisy", "-")):
        turns = results[kind]["PHSI, solver"].convergence
        axes[0].plot(
            turns["turn"],
            turns["loss"],
            style,
            marker="o",
            ms=4,
            color="#0072b2",
            label=f"{kind} data",
        )
        for column, colour in (
            ("coefficient_change", "#6a3d9a"),
            ("force_change", "#b15928"),
        ):
            label = f"{column.replace('_', ' ')}, {kind}"
            axes[1].plot(
                turns["turn"],
                turns[column],
                style,
                marker="o",
                ms=4,
                color=colour,
                label=label,
            )
    axes[0].set(ylabel="mean squared defect")
    axes[1].set(ylabel="relative change since the last turn")
    for ax in axes:
        ax.set(yscale="log", xlabel="turn")
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.grid(alpha=0.3)
        ax.legend(frameon=False)
    return _saved(fig, "tanks_convergence.png"), (
        "The turns of the hybrid of solver and network: loss after every turn, and how far coefficients and force "
        "still move. Terms are pruned from the third turn on."
    )


def _saved(fig: Any, name: str) -> str:
    path = RESULTS / "thesis" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return name
