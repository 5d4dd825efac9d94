"""Pictures of a missing force over the states, and against what it follows."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.dependence import TIME_NAME, without_parameters
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.waves import period_of
from phsi_opt.force_analysis.words import dependence_title, map_title
from phsi_opt.presentation.axes import BASELINE, MODEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL_TITLE_LETTERS = 62  # in a line of the title over a single panel
N_SHOWN_BINS = 16  # of a variable in which mean and spread are shown
FEWEST_IN_BIN = 3  # intervals in a bin that is shown
N_CELLS = 14  # of a map, along each axis
MOST_DOTS = 4000  # values that are shown as dots
DOTS = "0.75"  # light grey: values behind their mean


# ---- shared by all panels


def draw_title(ax: "Axes", text: str) -> None:
    """The title, in lines that are as long as a panel is wide."""
    ax.set_title(fill(text, PANEL_TITLE_LETTERS), fontsize=10)


@dataclass(frozen=True, eq=False)
class Bins:
    """Mean and spread of a force in bins of a variable that hold enough values.

    Attributes:
        centre: of the bins, (n_bins,).
        mean: of the force, (n_bins,).
        std: standard deviation of the force, (n_bins,).
    """

    centre: np.ndarray
    mean: np.ndarray
    std: np.ndarray

    @classmethod
    def of(cls, z: np.ndarray, w: np.ndarray) -> "Bins":
        """Bins of even width over a variable z (n,), of a force w (n,)."""
        from scipy.stats import binned_statistic  # slow to load

        statistics = ("count", "mean", "std")
        found = [binned_statistic(z, w, one, N_SHOWN_BINS) for one in statistics]
        edges = found[0].bin_edges
        count, mean, std = (one.statistic for one in found)
        shown = count >= FEWEST_IN_BIN
        return cls(((edges[:-1] + edges[1:]) / 2)[shown], mean[shown], std[shown])


# ---- over the states


def draw_map(ax: "Axes", force: EquationForce) -> None:
    """Mean missing force over position and velocity, or over two states.

    The states are those that predict the force best; cells that were not visited are
    blank. Where only one state predicts the force, or there is only one, the force is
    drawn over that.
    """
    names = force.map_variables
    if len(names) < 2:
        z = force.record.variable(names[0])
        draw_beside(ax, Dependence(z, force.w, force.variable_label(names[0])))
        ax.set_ylabel(force.force_label())
    else:
        _draw_cells(ax, force, names)
    draw_title(ax, map_title(force, names))


@dataclass(frozen=True, eq=False)
class ForceMap:
    """Mean missing force in cells of two variables.

    Attributes:
        edges_a: of the first variable's cells, (n_a + 1,).
        edges_b: of the second one's, (n_b + 1,).
        mean: (n_a, n_b), the first variable first; masked where nothing was.
    """

    edges_a: np.ndarray
    edges_b: np.ndarray
    mean: np.ma.MaskedArray

    @classmethod
    def of(cls, force: EquationForce, names: Sequence[str]) -> "ForceMap":
        """The map over the first two of the names."""
        a = force.record.variable(names[0])
        b = force.record.variable(names[1])
        from scipy.stats import binned_statistic_2d

        found = binned_statistic_2d(a, b, force.w, "mean", N_CELLS)
        mean = np.ma.masked_invalid(found.statistic)
        return cls(found.x_edge, found.y_edge, mean)


def _draw_cells(ax: "Axes", force: EquationForce, names: Sequence[str]) -> None:
    """Mean force in cells of two variables; red is positive, blue negative."""
    found = ForceMap.of(force, names)
    limit = float(np.ma.max(np.ma.abs(found.mean)))
    mesh = ax.pcolormesh(
        found.edges_a,
        found.edges_b,
        found.mean.T,
        cmap="RdBu_r",
        vmin=-limit,
        vmax=limit,
    )
    ax.figure.colorbar(mesh, ax=ax, label=force.force_label("mean missing force"))
    ax.set_xlabel(force.variable_label(names[0]))
    ax.set_ylabel(force.variable_label(names[1]))


# ---- against what it follows


def draw_dependence(ax: "Axes", force: EquationForce) -> None:
    """The missing force against the variable that predicts it best."""
    variable = force.single_variable
    draw_beside(ax, Dependence.of(force, variable))
    ax.set_ylabel(force.force_label())
    draw_title(ax, dependence_title(force, variable))


@dataclass(frozen=True, eq=False)
class Dependence:
    """The missing force beside a variable.

    Attributes:
        z: the variable, (n_intervals,); folded where the force is a wave along it.
        w: the force, (n_intervals,), less what other values of the parameters explain
            (see `without_parameters`), but not against time.
        label: of the variable, with its unit.
    """

    z: np.ndarray
    w: np.ndarray
    label: str

    @classmethod
    def of(cls, force: EquationForce, variable: str) -> "Dependence":
        """The force of an equation beside one of the variables it was compared with."""
        z = force.record.variable(variable)
        label = force.variable_label(variable)
        period = _folding_period(force, variable)
        if period is not None:
            z = (z - force.record.t[0] if variable == TIME_NAME else z) % period
            label = f"{label}, folded to the period of {period:.3g}"
        if variable == TIME_NAME:
            return cls(z, force.w, label)
        return cls(z, without_parameters(force, variable, force.wave), label)


def _folding_period(force: EquationForce, variable: str) -> float | None:
    """Period of a force that follows a variable as a wave."""
    if variable == TIME_NAME:
        is_clear = force.share_of(TIME_NAME) >= CLEAR_PATTERN
        return period_of(force) if is_clear else None
    wave = force.wave
    return None if wave is None or wave.position != variable else wave.period


def draw_beside(ax: "Axes", found: Dependence) -> None:
    """A force beside a variable: dots, and mean and standard deviation in bins."""
    bins = Bins.of(found.z, found.w)
    step = max(1, len(found.z) // MOST_DOTS)
    dots = (found.z[::step], found.w[::step])
    ax.plot(*dots, ".", ms=3, color=DOTS, label="force")
    line = (bins.centre, bins.mean)
    ax.plot(*line, "o-", color=MODEL, ms=4, lw=1.4, label="mean in bins")
    band = (bins.centre, bins.mean - bins.std, bins.mean + bins.std)
    ax.fill_between(*band, color=MODEL, alpha=0.2, lw=0, label="std. deviation")
    ax.axhline(0, color=BASELINE, lw=0.8)
    ax.set_xlabel(found.label)
    ax.margins(y=0.25)
    ax.legend(loc="upper center", frameon=False, ncols=3, columnspacing=1.0)
