"""The page results/thesis/regularization.md and its figure (thesis Figure 5.1).

Every number of the reading is computed from the table of the page.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.estimation.fit_record import Identified
from problems.tools import markdown
from problems.tools.pictures import plt, save

START = np.array([2.0, 0.0])  # of the trajectories that are drawn
EDGE = 4.0  # where a drawn trajectory that runs away is cut
COLOURS = ("C0", "C1", "C2")
STYLES = ("-", "--", ":")
TRUE_COEFFICIENT = 0.5  # of q^2 and p^2 in the energy

Weights = tuple[float, float]  # lambda_H, lambda_F


@dataclass(frozen=True)
class Run:
    """One model: by which method, with which weights, from which start."""

    method: str
    weights: Weights
    start: str
    result: Identified


def inner_part(fit: Identified) -> ph.Model:
    """S grad H alone."""
    return replace(fit.model, F={})


def outer_part(fit: Identified) -> ph.Model:
    """F alone."""
    return ph.FirstOrder(fit.model.states, dict(fit.model.F))


# --- the text


def text(table: pd.DataFrame, warnings: pd.DataFrame, heads: dict[str, str]) -> str:
    """The page as Markdown; ``heads``: how each method was run."""
    parts = [
        "# L1 weights and the separation of energy and force (thesis Section 5.2)",
        "",
        " ".join(reading(table, warnings)),
        "",
        BACKGROUND,
        "",
    ]
    for method, head in heads.items():
        part = table[table["method"] == method].drop(columns="method")
        if len(part):
            parts += [f"## {head}", "", *markdown.frame(part)]
    return "\n".join([*parts, "![phase plots](regularization.png)", "", CAPTION])


BACKGROUND = markdown.paragraph("""
    Without weights the problem is singular. The solver's own start, a convex program,
    then chooses a split, which is a property of its solver, not of the data;
    `identify` solves for coefficients that enter linearly before it starts, so random
    values in the model have no effect: the random starts here are given as a fit. With
    equal weights on both, energy is cheaper, because the gradient of q^2/2 makes 1 out
    of a coefficient of 1/2. In gradient descent the L1 term moves a coefficient along a
    flat valley at a steady, slow rate.
    """)
CAPTION = markdown.paragraph(f"""
    Phase plots of one period from the cross (q = {START[0]:g}, p = {START[1]:g};
    dimensionless): the whole model, its energy alone and its force alone, for the pairs
    of L1 weights. Grey: truth, which belongs to the whole and to the desired energy.
    Colours: the solver from its random starts, each with a dot at its end; a dot on the
    cross is a part that is zero or a closed orbit. Orbits that leave the picture are
    cut.
    """)


def reading(table: pd.DataFrame, warnings: pd.DataFrame) -> list[str]:
    """Sentences whose numbers are those of the table."""
    worst = table["relative error"].max()
    said = [f"Every model predicts dx/dt: the largest relative error is {worst:.1%}."]
    for method, part in table.groupby("method", sort=False):
        shares = [
            f"lambda_H {h:g} and lambda_F {f:g}: {_range(rows['share of F'])}"
            for (h, f), rows in part.groupby(["lambda_H", "lambda_F"], sort=False)
        ]
        said.append(f"Share of F, {method}: {'; '.join(shares)}.")
    solver = table[table["method"] == "solver"]
    said.append(_of_shrinkage(solver))
    free = warnings[(warnings["lambda_H"] == 0) & (warnings["lambda_F"] == 0)]
    if len(free):
        said.append(f'Without weights the fit warns: "{free["warning"].iloc[0]}"')
    return said


def _range(values: pd.Series) -> str:
    """The range over the starts."""
    low = f"{values.min():.1%}"
    high = f"{values.max():.1%}"
    return low if low == high else f"{low} to {high}"


def _of_shrinkage(solver: pd.DataFrame) -> str:
    """By how much a weight on H takes the energy's coefficients below the truth."""
    shrunk = 1 - solver[["H[q^2]", "H[p^2]"]].max(axis=1) / TRUE_COEFFICIENT
    on_force = solver["lambda_F"] > 0
    both = shrunk[on_force & (solver["lambda_H"] > 0)]
    alone = shrunk[on_force & (solver["lambda_H"] == 0)]
    return (
        f"L1 shrinks the energy by {both.max():.1%} where both have a weight, by "
        f"{abs(alone).max():.1%} where F alone has one."
    )


# --- the figure


def figure(runs: Sequence[Run]) -> None:
    """Phase plots as in Figure 5.1: a column per pair of weights, a row per part.

    Drawn are the models of the solver from its random starts.
    """
    drawn = [r for r in runs if r.method == "solver" and r.start != "convex"]
    columns = list(dict.fromkeys(run.weights for run in drawn))
    parts: dict[str, Callable[[Identified], ph.Model]] = {
        "S grad H + F": lambda fit: fit.model,
        "S grad H alone": inner_part,
        "F alone": outer_part,
    }
    fig, axes = plt.subplots(
        len(parts),
        len(columns),
        figsize=(10.0, 7.8),
        layout="constrained",
        sharex=True,
        sharey=True,
    )
    for row, (label, part) in zip(axes, parts.items(), strict=True):
        row[0].set_ylabel(f"{label}\n\np (-)")
        for ax, weights in zip(row, columns, strict=True):
            results = [run.result for run in drawn if run.weights == weights]
            _panel(ax, [part(result) for result in results])
    for ax, (on_energy, on_force) in zip(axes[0], columns, strict=True):
        ax.set_title(f"$\\lambda_H$ = {on_energy:g}, $\\lambda_F$ = {on_force:g}")
    for ax in axes[-1]:
        ax.set_xlabel("q (-)")
    handles, names = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    save(fig, "thesis/regularization.png", dpi=120)


def _panel(ax: plt.Axes, parts: Sequence[ph.Model]) -> None:
    """Orbits of one part of the models of all starts, thinner from start to start."""
    ax.plot(*_circle(), color="0.75", lw=6, label="truth")
    for k, part in enumerate(parts):
        orbit = _orbit(part)
        ax.plot(
            *orbit,
            color=COLOURS[k],
            lw=2.4 - 0.7 * k,
            ls=STYLES[k],
            label=f"random start {k}",
        )
        ax.plot(*orbit[:, -1], "o", color=COLOURS[k], ms=5 - k)
    ax.plot(*START, "k+", ms=9)
    ax.set(xlim=(-EDGE, EDGE), ylim=(-EDGE, EDGE), aspect="equal")


def _circle() -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 200)
    return np.linalg.norm(START) * np.array([np.cos(angle), np.sin(angle)])


def _orbit(part: ph.Model) -> np.ndarray:
    """Trajectory (2, n) from `START` over one period of the truth.

    Cut where it leaves the picture.
    """
    rhs = part.rhs()
    theta = part.theta

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(rhs(x, [], t, theta)).ravel()

    def inside(t: float, x: np.ndarray) -> float:
        return EDGE - float(np.abs(x).max())

    inside.terminal = True  # type: ignore[attr-defined]
    solved = solve_ivp(
        rates,
        (0.0, 2 * np.pi),
        START,
        "RK45",
        rtol=1e-8,
        atol=1e-8,
        max_step=0.05,
        events=inside,
    )
    return solved.y
