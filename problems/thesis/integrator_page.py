"""The page results/thesis/integrators.md and its figure, from the tables of the study.

Every sentence of the reading is a comparison of numbers in these tables.
"""

from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis.integrator_paths import COLOURS, caption, file_of
from problems.tools import markdown
from problems.tools.pictures import plt, save

Tables = dict[str, pd.DataFrame]
BEST = "srk4"  # what the others are compared with
HYBRID = "Tanks, neural leak"
ENDS = {"Henon-Heiles": 10.0, HYBRID: 1.0}  # of the trajectories drawn
ORDER_WITHIN = 0.1  # the slope over the last halving still holds terms of higher order
# "two orders of magnitude" between Euler and the best: thesis, Appendix A
THESIS_EULER = 100
LABELS = {
    "l2": "mean l2 error of free runs\n(units of the states)",
    "coefficient": "largest relative\ncoefficient error (-)",
}


def text(found: Tables, limits: str) -> str:
    """The page as Markdown; ``limits`` says what the study leaves out."""
    parts = ["# Integrators inside the PHSI loss (thesis Appendix A)", ""]
    parts += [" ".join(reading(found)), "", limits, ""]
    for name, head in _heads(found["fits"]).items():
        parts += [f"## {head}", "", *markdown.frame(found[name])]
    parts += ["![errors by integrator and noise](integrators.png)", ""]
    parts += [_caption(found["fits"]), ""]
    for title, end in ENDS.items():
        parts += [f"![{title}]({file_of(title)})", "", caption(title, end), ""]
    return "\n".join(parts)


def _heads(fits: pd.DataFrame) -> dict[str, str]:
    return {
        "orders": "Rms defect of the true right-hand side on exact data "
        "(units of the states per unit of time), last slope",
        "symmetry": "Largest relative change of Psi when the ends are swapped and "
        "h -> -h (noisy data of all four systems)",
        "medians": f"Models found: medians over the draws ({_draws(fits)}), "
        "l2 also from - to",
    }


def _draws(fits: pd.DataFrame) -> str:
    """Number of noise draws of every system."""
    counts = fits.groupby("system", sort=False)["seed"].nunique()
    return "; ".join(f"{system}: {count}" for system, count in counts.items())


def _caption(fits: pd.DataFrame) -> str:
    return markdown.paragraph(f"""
        Errors of the models found with each integrator; dots are medians, bars the
        range over the draws ({_draws(fits)}). Top: norm of the error over all states,
        averaged over time and unseen starts, free runs over the training time. Bottom:
        largest relative error among the true coefficients (a missed one counts 1).
        Logarithmic axes; states as in the thesis, which gives no units.
        """)


# --- the reading


def reading(found: Tables) -> list[str]:
    """Sentences on order, symmetry and the models found, from the tables alone."""
    said = [_of_order(found["orders"]), _of_symmetry(found["symmetry"])]
    for system, part in found["fits"].groupby("system", sort=False):
        said.append(f"{system}: {'; '.join(_at_noise(part))}.")
    said.append(_of_euler(found["medians"]))
    said.append(_of_ranks(found["medians"]))
    return said


def _of_order(orders: pd.DataFrame) -> str:
    """Where the measured order is that of the scheme, and where it is not."""
    expected = orders["integrator"].map(lambda name: INTEGRATORS[name].order)
    short = orders[(orders["order"] - expected).abs() > ORDER_WITHIN]
    held = [s for s in orders["system"].unique() if s not in set(short["system"])]
    text = "The order of the defect is that of the thesis' Table A.1 on "
    text += markdown.enumerated(held) if held else "no system"
    if short.empty:
        return f"{text}."
    losses = [f"{r.integrator} has {r.order:.2g}" for r in _rows(short, digits=1)]
    where = markdown.enumerated(short["system"].unique())
    return (
        f"{text}, not on {where}: {markdown.enumerated(losses)} there (the open leak "
        "has a kink at its limit)."
    )


def _rows(frame: pd.DataFrame, digits: int) -> list[Any]:
    return list(frame.round(digits).itertuples())


def _of_symmetry(symmetry: pd.DataFrame) -> str:
    symmetric = symmetry[symmetry["symmetric"]]
    others = symmetry[~symmetry["symmetric"]]
    largest = symmetric["largest change"].max()
    smallest = others["largest change"].min()
    return (
        f"Swapping the ends changes Psi by at most {largest:.2g} for "
        f"{markdown.enumerated(symmetric['integrator'])}, by {smallest:.2g} or more "
        f"for {markdown.enumerated(others['integrator'])}."
    )


def _at_noise(part: pd.DataFrame) -> list[str]:
    """Per noise level: free-run errors over that of `BEST`, and who cannot be told."""
    said = []
    for noise, runs in part.groupby("noise", sort=False):
        by = runs.groupby("integrator", sort=False)["l2"]
        ratios = by.median() / by.median()[BEST]
        others = [
            f"{name} {markdown.number(ratio)}"
            for name, ratio in ratios.items()
            if name != BEST
        ]
        line = (
            f"at noise {noise:g} the free-run errors are those of {BEST} times "
            f"{markdown.enumerated(others)}"
        )
        alike = _overlapping(by)
        if alike:
            overlap = markdown.enumerated([BEST, *alike])
            line += f" (the draws of {overlap} overlap)"
        said.append(line)
    return said


def _overlapping(by: Any) -> list[str]:
    """Integrators whose errors over several draws overlap with those of `BEST`."""
    lowest, highest = by.min(), by.max()
    if by.count()[BEST] < 2:
        return []
    return [
        str(name)
        for name in lowest.index
        if name != BEST
        and lowest[name] <= highest[BEST]
        and highest[name] >= lowest[BEST]
    ]


def _of_euler(medians: pd.DataFrame) -> str:
    """What the thesis says of Euler beside the largest and smallest ratio here."""
    l2 = medians.set_index(["system", "noise", "integrator"])["l2"].unstack()
    ratio = l2["euler"] / l2[BEST]
    return (
        f"Euler's error is {markdown.number(ratio.min())} to "
        f"{markdown.number(ratio.max())} times that of {BEST} (the thesis: some "
        f"{THESIS_EULER} times with little noise, and less with more)."
    )


def _of_ranks(medians: pd.DataFrame) -> str:
    """The order of the integrators in the hybrid, beside what the thesis says."""
    said = []
    part = medians[medians["system"] == HYBRID]
    for noise, rows in part.groupby("noise", sort=False):
        ordered = rows.sort_values("l2")["integrator"]
        said.append(f"{', '.join(ordered)} at noise {noise:g}")
    if not said:
        return ""
    return (
        f"With the neural leak, from the best to the worst: {'; '.join(said)}. (The "
        "thesis: SRK4 before RK4 and midpoint, these before Euler; the symmetric ones "
        "do well with much noise.)"
    )


# --- the figure


def figure(fits: pd.DataFrame) -> None:
    """Errors against noise, one panel per system and error.

    The dot is the median, the bar the range over the draws.
    """
    systems = list(dict.fromkeys(fits["system"]))
    fig, axes = plt.subplots(
        2, len(systems), figsize=(11.5, 6.8), layout="constrained", squeeze=False
    )
    for column, title in enumerate(systems):
        part = fits[fits["system"] == title]
        for row, (what, label) in enumerate(LABELS.items()):
            _panel(axes[row, column], part, what)
            axes[row, column].set_ylabel(label if column == 0 else "")
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel(
            "standard deviation of the noise\n(units of the states)"
        )
    handles, names = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    save(fig, "thesis/integrators.png", dpi=130)


def _panel(ax: Any, part: pd.DataFrame, what: str) -> None:
    levels = sorted(set(part["noise"]))
    places = np.arange(len(levels))
    for k, name in enumerate(INTEGRATORS):
        runs = part[part["integrator"] == name].groupby("noise")[what]
        middle = runs.median().to_numpy()
        below = middle - runs.min().to_numpy()
        above = runs.max().to_numpy() - middle
        ax.errorbar(
            places + 0.16 * (k - 1.5),
            middle,
            np.array([below, above]),
            fmt="o",
            ms=5,
            capsize=3,
            color=COLOURS[name],
            label=_order_label(name),
        )
    ax.set(yscale="log", xticks=places, xticklabels=[f"{s:g}" for s in levels])
    ax.grid(axis="y", alpha=0.3)


def _order_label(name: str) -> str:
    scheme = INTEGRATORS[name]
    symmetric = ", symmetric" if scheme.symmetric else ""
    return f"{name} (order {scheme.order}{symmetric})"
