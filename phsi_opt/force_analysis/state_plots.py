"""Pictures of a missing force over the states, and against what it follows."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.dependence import leading, without_parameters
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import EVERYWHERE, strong_region
from phsi_opt.force_analysis.plot_parts import Bins, draw_band, draw_title, draw_zero
from phsi_opt.force_analysis.time_basis import period_of
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.presentation.axes import BASELINE, MODEL, axes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

N_CELLS = 14  # of a map, along each axis
MOST_DOTS = 4000  # values that are shown as dots
DOTS = "0.75"  # light grey: values behind their mean


def plot_map(
    analysis: ForceAnalysis, equation: str | None = None, ax: "Axes | None" = None
) -> "Axes":
    """Mean missing force over position and velocity, or over two states.

    The states are those that predict the force best; cells that were not visited are
    blank. Where only one state predicts the force, or there is only one, there are bars
    over that state.

    Args:
        analysis: of the missing force.
        equation: default: the one whose missing force is surest.
        ax: axes to draw on; None: a new figure.

    Raises:
        ModelError: the equation has no missing force.
    """
    force = EquationForce.of(analysis, equation)
    ax = axes_of(ax, (6.0, 4.6))
    names = map_variables(force)
    if len(names) < 2:
        _draw_bars(ax, force, names[0])
    else:
        _draw_map(ax, force, names)
    draw_title(ax, map_title(force, names))
    return ax


def map_variables(force: EquationForce) -> tuple[str, ...]:
    """Variables of a map: position and velocity of a momentum, else the best states.

    There may be only one state. Another pair of states takes their place where the
    force follows only that pair.
    """
    model = force.record.fit.model
    equation = force.equation
    positions = position_of_momentum(model)
    if equation in positions:
        usual = [positions[equation], f"dH_d{equation}"]
    else:
        listed = force.follows["variable"]
        usual = [name for name in listed if name in model.states][:2]
    best = leading(force.follows, equation)
    if best is None or "," not in best["variable"] or best["share"] < CLEAR_PATTERN:
        return tuple(usual)
    pair = best["variable"].split(", ")
    is_usual = equation in pair and usual[0] in pair
    return tuple(usual if is_usual else pair)


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
    def of(cls, force: EquationForce, names: tuple[str, ...]) -> "ForceMap":
        """The map over the first two of the names."""
        a = force.record.variable(names[0])
        b = force.record.variable(names[1])
        count, edges_a, edges_b = np.histogram2d(a, b, N_CELLS)
        total, _, _ = np.histogram2d(a, b, (edges_a, edges_b), weights=force.w)
        mean = np.ma.masked_where(count == 0, total / np.maximum(count, 1))
        return cls(edges_a, edges_b, mean)

    @property
    def limit(self) -> float:
        """The largest size of the force."""
        if not self.mean.count():
            return 1.0
        return float(np.ma.max(np.ma.abs(self.mean)))


def _draw_map(ax: "Axes", force: EquationForce, names: tuple[str, ...]) -> None:
    """Mean force in cells of two variables; red is positive, blue negative."""
    found = ForceMap.of(force, names)
    mesh = ax.pcolormesh(
        found.edges_a,
        found.edges_b,
        found.mean.T,
        cmap="RdBu_r",
        vmin=-found.limit,
        vmax=found.limit,
    )
    ax.figure.colorbar(mesh, ax=ax, label=force.force_label("mean missing force"))
    ax.set_xlabel(force.variable_label(names[0]))
    ax.set_ylabel(force.variable_label(names[1]))


def _draw_bars(ax: "Axes", force: EquationForce, name: str) -> None:
    """Mean force and its spread over one variable."""
    bins = Bins.of(force.record.variable(name), force.w)
    ax.bar(
        bins.centre,
        bins.mean,
        width=0.9 * bins.width,
        color=MODEL,
        yerr=bins.std,
        ecolor=BASELINE,
        label="mean and spread",
    )
    draw_zero(ax)
    ax.set_xlabel(force.variable_label(name))
    ax.set_ylabel(force.force_label())
    ax.legend(frameon=False)


def map_title(force: EquationForce, names: tuple[str, ...]) -> str:
    """Where over the variables the force is strong, in a sentence."""
    begin = f"d{force.equation}/dt:"
    if force.is_uncertain:
        return f"{begin} no missing force is sure"
    region = strong_region(force.record, force.w, names)
    if region == EVERYWHERE:
        return f"{begin} the missing force acts all over the visited states"
    return f"{begin} the missing force is strong where {force.region_words(region)}"


def plot_dependence(
    analysis: ForceAnalysis,
    variable: str | None = None,
    equation: str | None = None,
    ax: "Axes | None" = None,
) -> "Axes":
    """The missing force against a variable: mean and spread in bins.

    What other values of the model's parameters would explain is taken off (see
    `without_parameters`), but not against time.

    Args:
        analysis: of the missing force.
        variable: default: the one that predicts the force best.
        equation: default: the one whose missing force is surest.
        ax: axes to draw on; None: a new figure.

    Raises:
        ModelError: the equation has no missing force, or the force was not compared
            with the variable.
    """
    force = EquationForce.of(analysis, equation)
    variable = force.single_variable(variable)
    ax = axes_of(ax, (6.0, 4.6))
    found = Dependence.of(force, variable)
    draw_dependence(ax, found.z, found.w)
    ax.set(xlabel=found.label, ylabel=force.force_label())
    draw_title(ax, dependence_title(force, variable))
    return ax


@dataclass(frozen=True, eq=False)
class Dependence:
    """The missing force beside a variable.

    Attributes:
        z: the variable, (n_intervals,); folded where the force is a wave along it.
        w: the force, (n_intervals,), less what other values of the parameters explain.
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
            z = (z - force.record.t[0] if variable == "t" else z) % period
            label = f"{label}, folded to the period of {period:.3g}"
        if variable == "t":
            return cls(z, force.w, label)
        w = without_parameters(force.record, force.equation, variable, force.wave)
        return cls(z, w, label)


def _folding_period(force: EquationForce, variable: str) -> float | None:
    """Period of a force that follows a variable as a wave."""
    if variable != "t":
        wave = force.wave
        if wave is None or wave.position != variable:
            return None
        return wave.period
    if force.share_of("t") < CLEAR_PATTERN:
        return None
    return period_of(force.record, force.equation)


def draw_dependence(ax: "Axes", z: np.ndarray, w: np.ndarray) -> None:
    """Draw dots, and mean and standard deviation in bins, of w (n,) over z (n,)."""
    bins = Bins.of(z, w)
    step = max(1, len(z) // MOST_DOTS)
    ax.plot(z[::step], w[::step], ".", ms=3, color=DOTS, label="force")
    ax.plot(
        bins.centre, bins.mean, "o-", color=MODEL, ms=4, lw=1.4, label="mean in bins"
    )
    lower = bins.mean - bins.std
    upper = bins.mean + bins.std
    draw_band(ax, bins.centre, lower, upper, "std. deviation")
    draw_zero(ax)
    ax.margins(y=0.25)
    ax.legend(
        frameon=False,
        ncols=3,
        loc="upper center",
        columnspacing=1.0,
        handletextpad=0.4,
    )


def dependence_title(force: EquationForce, variable: str) -> str:
    """Whether the force follows the variable, in a sentence."""
    equation = force.equation
    if force.is_uncertain:
        return f"d{equation}/dt: no missing force is sure"
    share = force.share_of(variable)
    predicted = f"{variable}, which predicts {100 * max(share, 0.0):.0f} % of it"
    if share >= CLEAR_PATTERN:
        return f"The force in d{equation}/dt follows {predicted}"
    if force.is_constant:
        begin = f"The force in d{equation}/dt is constant; what varies hardly follows"
        return f"{begin} {variable}"
    return (
        f"The force in d{equation}/dt follows no single variable clearly: the best, "
        f"{variable}, predicts {100 * max(share, 0.0):.0f} % of it"
    )
