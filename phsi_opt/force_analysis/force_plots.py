"""Pictures of a missing force: over time, over the states, against what it follows, and
its frequencies.

Each takes an analysis and an equation (default: the one whose missing force is surest)
and says in its title what to see.
"""

from collections.abc import Sequence
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phsi_opt.criteria import CERTAIN_FORCE, CLEAR_PATTERN
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.dependence import cleaned, variables
from phsi_opt.force_analysis.energy import period_of, plane_of
from phsi_opt.force_analysis.force_record import (
    ForceRecord,
    force_unit,
    frequency_unit,
    spectrum,
)
from phsi_opt.force_analysis.localization import deviation_of, region_of, uncertain
from phsi_opt.model.structure import position_rows
from phsi_opt.statistics import TINY

FORCE, CLOUD, LEVEL = "C0", "0.75", "0.55"
N_CELLS, N_BARS, MOST_DOTS = 14, 16, 4000
FEWEST = 3  # intervals in a bin that is shown
TITLE = 62  # characters of a title's line over a single panel
# of the draws of the estimate's error that stay below the level shown in a spectrum
LEVEL_SHARE = 0.95


def plot_where(analysis: ForceAnalysis, equation: str | None = None) -> Figure:
    """Force over time, over the states, against what it follows, and its frequencies;
    the sentence says what it is.
    """
    equation = _equation(analysis, equation)
    figure, axes = plt.subplots(2, 2, figsize=(12.0, 8.4), layout="constrained")
    plot_force(analysis, equation, ax=axes[0, 0])
    plot_map(analysis, equation, ax=axes[0, 1])
    plot_dependence(analysis, equation=equation, ax=axes[1, 0])
    plot_spectrum(analysis, equation, ax=axes[1, 1])
    own = next(
        sentence
        for sentence in analysis.sentences
        if sentence.startswith(f"d{equation}/dt")
    )
    figure.suptitle(fill(own, 120), fontsize=11)
    return figure


def plot_force(
    analysis: ForceAnalysis,
    equation: str | None = None,
    trajectory: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The missing force with two standard deviations along one trajectory (a number),
    by default the strongest.

    Raises `ModelError` for a trajectory that is not there.
    """
    ax, equation, path = (
        _axes(ax, (8.0, 3.6)),
        _equation(analysis, equation),
        analysis.force,
    )
    w, runs = path.force_on(equation), analysis.force.trajectories
    name = trajectory or str(_row(analysis, equation)["trajectory"])
    if name not in runs:
        raise ModelError(
            f"trajectory={trajectory!r} is not one of the record; "
            f"expected one of {', '.join(runs)}.{did_you_mean(name, runs)}"
        )
    run = runs.index(name)
    part = path.run == run
    deviation = deviation_of(analysis.force.estimate)[
        part, path.equations.index(equation)
    ]
    ax.plot(path.t[part], w[part], color=FORCE, lw=1.2, label="missing force")
    low, high = w[part] - 2 * deviation, w[part] + 2 * deviation
    ax.fill_between(
        path.t[part],
        low,
        high,
        color=FORCE,
        alpha=0.2,
        lw=0,
        label="two standard deviations",
    )
    ax.axhline(0, color="0.3", lw=0.8)
    outside = np.mean(np.abs(w[part]) > 2 * deviation)
    _titled(
        ax,
        f"{name}: d{equation}/dt surely lacks a force during {100 * outside:.0f} % of the time",
    )
    ax.set(
        xlabel=_label("t", analysis.force.units.get("t", "")),
        ylabel=_force_label(analysis, equation),
    )
    ax.margins(y=0.25)
    ax.legend(loc="upper right", frameon=False, ncols=2)
    return ax


def plot_map(
    analysis: ForceAnalysis, equation: str | None = None, ax: Axes | None = None
) -> Axes:
    """Mean missing force over position and velocity, or over the two states that
    predict it best; blank: not visited.

    Where only one state predicts the force, or there is only one, bars over that state.
    """
    ax, equation, path = (
        _axes(ax, (6.0, 4.6)),
        _equation(analysis, equation),
        analysis.force,
    )
    plane = plane_of(path, equation)
    region = _region(analysis, path, equation, plane)
    if len(plane) < 2:
        return _bars(ax, analysis, path, equation, plane[0], region)
    a, b, w = path.variable(plane[0]), path.variable(plane[1]), path.force_on(equation)
    count, edges_a, edges_b = np.histogram2d(a, b, N_CELLS)
    total = np.histogram2d(a, b, (edges_a, edges_b), weights=w)[0]
    mean = np.ma.masked_where(count == 0, total / np.maximum(count, 1))
    limit = float(np.ma.max(np.ma.abs(mean))) if mean.count() else 1.0
    mesh = ax.pcolormesh(
        edges_a, edges_b, mean.T, cmap="RdBu_r", vmin=-limit, vmax=limit
    )
    ax.figure.colorbar(
        mesh, ax=ax, label=_force_label(analysis, equation, "mean missing force")
    )
    ax.set(
        xlabel=_variable_label(analysis, plane[0]),
        ylabel=_variable_label(analysis, plane[1]),
    )
    _titled(ax, region)
    return ax


def _bars(
    ax: Axes,
    analysis: ForceAnalysis,
    path: ForceRecord,
    equation: str,
    name: str,
    region: str,
) -> Axes:
    centre, mean, spread, width = _binned(path.variable(name), path.force_on(equation))
    ax.bar(
        centre,
        mean,
        0.9 * width,
        color=FORCE,
        yerr=spread,
        ecolor="0.3",
        label="mean and spread",
    )
    ax.axhline(0, color="0.3", lw=0.8)
    ax.set(
        xlabel=_variable_label(analysis, name),
        ylabel=_force_label(analysis, equation),
    )
    ax.legend(frameon=False)
    _titled(ax, region)
    return ax


def plot_dependence(
    analysis: ForceAnalysis,
    variable: str | None = None,
    equation: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The missing force against a variable, by default the one that predicts it best:
    binned mean and spread.

    What other values of the model's parameters would explain is taken off (see
    `where.cleaned`), but not against time. Raises `ModelError` for a variable that the
    force was not compared with.
    """
    ax, equation, path = (
        _axes(ax, (6.0, 4.6)),
        _equation(analysis, equation),
        analysis.force,
    )
    found = analysis.follows
    found = found[found["equation"] == equation]
    variable = _variable(path, equation, variable, found)
    share = float(found.set_index("variable")["share"][variable])
    z, label = path.variable(variable), _variable_label(analysis, variable)
    period = (
        period_of(path, equation)
        if variable == "t" and share >= CLEAR_PATTERN
        else None
    )
    if period is not None:
        z, label = (
            (z - path.t[0]) % period,
            f"{label}, folded to the period of {period:.3g}",
        )
    w = (
        path.force_on(equation)
        if variable == "t"
        else cleaned(path, equation, variable)
    )
    centre, mean, spread, _ = _binned(z, w)
    step = max(1, len(z) // MOST_DOTS)
    ax.plot(z[::step], w[::step], ".", ms=3, color=CLOUD, label="force")
    ax.plot(centre, mean, "o-", color=FORCE, ms=4, lw=1.4, label="mean in bins")
    ax.fill_between(
        centre,
        mean - spread,
        mean + spread,
        color=FORCE,
        alpha=0.2,
        lw=0,
        label="std. deviation",
    )
    ax.axhline(0, color="0.3", lw=0.8)
    ax.set(xlabel=label, ylabel=_force_label(analysis, equation))
    ax.margins(y=0.25)
    ax.legend(
        frameon=False, ncols=3, loc="upper center", columnspacing=1.0, handletextpad=0.4
    )
    _titled(
        ax, _dependence_title(analysis, equation, variable, share, _is_constant(found))
    )
    return ax


def _dependence_title(
    analysis: ForceAnalysis,
    equation: str,
    variable: str,
    share: float,
    is_constant: bool,
) -> str:
    if _row(analysis, equation)["times_noise"] < CERTAIN_FORCE:
        return f"d{equation}/dt: no missing force is sure"
    verb = "follows" if share >= CLEAR_PATTERN else "hardly follows"
    constant = (
        "is constant, what varies " if is_constant and share < CLEAR_PATTERN else ""
    )
    return f"The force in d{equation}/dt {constant}{verb} {variable} ({100 * share:.0f} % predicted)"


def _is_constant(found: pd.DataFrame) -> bool:
    """Whether most of a force is constant: its first row of `depends_on`."""
    return bool(
        found["variable"].iloc[0] == "constant" and found["share"].iloc[0] > 0.5
    )


def plot_spectrum(
    analysis: ForceAnalysis, equation: str | None = None, ax: Axes | None = None
) -> Axes:
    """Amplitude of the missing force (its mean apart) by frequency, and the level that
    its uncertainty explains.
    """
    ax, equation, path = (
        _axes(ax, (6.0, 4.0)),
        _equation(analysis, equation),
        analysis.force,
    )
    w, unit = path.force_on(equation), frequency_unit(analysis.force.units)
    f, amplitude = spectrum(path.t, path.run, w - w.mean())
    draws = uncertain(analysis.force.estimate)[:, path.equations.index(equation)]
    level = _smooth(
        np.quantile(spectrum(path.t, path.run, draws)[1], LEVEL_SHARE, axis=1)
    )
    ax.plot(f, amplitude, color=FORCE, lw=1.4, label="missing force")
    ax.fill_between(
        f,
        0,
        level,
        color=LEVEL,
        alpha=0.35,
        lw=0,
        label="what its uncertainty explains",
    )
    above = np.flatnonzero(amplitude > level)
    shown = np.flatnonzero(amplitude > 0.02 * amplitude.max())
    ax.set_xlim(
        0, f[min(shown[-1] + 1, len(f) - 1)] if len(shown) and len(f) > 1 else None
    )
    ax.set_ylim(0, 1.3 * max(amplitude.max(), level.max(), TINY))
    ax.set(
        xlabel=f"frequency ({unit})",
        ylabel=_force_label(analysis, equation, "amplitude"),
    )
    ax.legend(frameon=False, loc="upper right")
    _titled(ax, _spectrum_title(equation, f, amplitude, above, unit, w))
    return ax


def _spectrum_title(
    equation: str,
    f: np.ndarray,
    amplitude: np.ndarray,
    above: np.ndarray,
    unit: str,
    w: np.ndarray,
) -> str:
    constant = (
        "mostly constant; what varies" if w.mean() ** 2 > np.mean(w**2) / 2 else ""
    )
    if not len(above):
        return f"d{equation}/dt: {constant or 'the missing force'} is nowhere above its uncertainty"
    peak = above[np.argmax(amplitude[above])]
    return f"d{equation}/dt: {constant or 'the missing force'} is strongest at {f[peak]:.3g} {unit}"


def _smooth(level: np.ndarray, n: int = 9) -> np.ndarray:
    """Running mean: a quantile of few draws is rough, the level itself is smooth."""
    return np.convolve(np.pad(level, n // 2, "edge"), np.full(n, 1 / n), "valid")


def _binned(
    z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Centre, mean and standard deviation in bins of even width with enough values, and
    the width.
    """
    edges = np.linspace(z.min(), z.max(), N_BARS + 1)
    part = np.clip(np.searchsorted(edges, z, "right") - 1, 0, N_BARS - 1)
    count = np.bincount(part, minlength=N_BARS)
    mean = np.bincount(part, w, N_BARS) / np.maximum(count, 1)
    spread = np.sqrt(
        np.bincount(part, (w - mean[part]) ** 2, N_BARS) / np.maximum(count, 1)
    )
    enough = count >= FEWEST
    return (
        ((edges[:-1] + edges[1:]) / 2)[enough],
        mean[enough],
        spread[enough],
        float(edges[1] - edges[0]),
    )


def _equation(analysis: ForceAnalysis, equation: str | None) -> str:
    """The equation asked for, or that whose missing force is strongest over its
    uncertainty.
    """
    model = analysis.force.fit.model
    forced = [model.states[row] for row in analysis.force.estimate.prior.rows]
    if equation is None:
        table = analysis.where
        return str(table["equation"][int(table["times_noise"].argmax())])
    if equation not in forced:
        raise ModelError(
            f"equation={equation!r} has no missing force; those that may lack one are {', '.join(forced)}."
            f"{did_you_mean(equation, forced)}"
        )
    return equation


def _variable(
    path: ForceRecord, equation: str, variable: str | None, found: pd.DataFrame
) -> str:
    """The variable asked for, or the single one that predicts the force best; the time
    for a constant force.
    """
    listed = [name for name in variables(path, equation) if "," not in name]
    if variable is not None:
        if variable not in listed:
            raise ModelError(
                f"variable={variable!r} is not one that the force was compared with; known are {', '.join(listed)}."
                f"{did_you_mean(variable, listed)}"
            )
        return variable
    if _is_constant(found):
        return "t"
    return str(found[found["variable"].isin(listed)]["variable"].iloc[0])


def _row(analysis: ForceAnalysis, equation: str) -> pd.Series:
    """The equation's row of `located`, with the number of the trajectory."""
    table = analysis.where
    return table[table["equation"] == equation].iloc[0]


def _region(
    analysis: ForceAnalysis, path: ForceRecord, equation: str, plane: Sequence[str]
) -> str:
    if _row(analysis, equation)["times_noise"] < CERTAIN_FORCE:
        return f"d{equation}/dt: no missing force is sure"
    region = region_of(path, path.force_on(equation), plane)
    if region == "everywhere":
        return f"d{equation}/dt: no region of the states stands out"
    return f"d{equation}/dt: the missing force is strong where {region}"


def _variable_label(analysis: ForceAnalysis, name: str) -> str:
    """Name and unit; a velocity has the unit of its position over that of the time."""
    units, model = analysis.force.units, analysis.force.fit.model
    if name not in model.efforts:
        return _label(name, units.get(name, ""))
    row = np.array(model.S)[:, model.efforts.index(name)]
    moved = [model.states[i] for i in position_rows(model) if row[i]]
    return (
        _label(f"velocity {name}", force_unit(moved[0], units))
        if moved
        else f"effort {name}"
    )


def _force_label(
    analysis: ForceAnalysis, equation: str, what: str = "missing force"
) -> str:
    return _label(what, force_unit(equation, analysis.force.units))


def _titled(ax: Axes, text: str) -> None:
    ax.set_title(fill(text, TITLE), fontsize=10)


def _axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    return plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax


def _label(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name
