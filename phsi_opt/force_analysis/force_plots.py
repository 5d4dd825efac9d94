"""Pictures of a missing force: over time, its frequencies, and all four in one figure.

Each takes an analysis and an equation (default: the one whose missing force is surest)
and says in its title what to see. Those over states stand in `state_plots`.
"""

from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phsi_opt.criteria import SPECTRUM_LEVEL, SURE_DEVIATIONS
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import is_mostly_constant
from phsi_opt.force_analysis.plot_parts import draw_band, draw_title, draw_zero
from phsi_opt.force_analysis.spectrum import Spectrum, spectrum
from phsi_opt.force_analysis.state_plots import plot_dependence, plot_map
from phsi_opt.force_analysis.units import frequency_unit
from phsi_opt.presentation.axes import MEASURED, MODEL, axes_of, label
from phsi_opt.statistics import TINY

SENTENCE_LETTERS = 120  # in a line of the sentence over four panels
# Share of the largest amplitude beyond whose last frequency the spectrum is cut off.
SHOWN_AMPLITUDE = 0.02
# Frequencies of the running mean over a level that is taken from few draws.
N_SMOOTHED = 9


def plot_where(analysis: ForceAnalysis, equation: str | None = None) -> Figure:
    """Force over time, over the states, against what it follows, and its frequencies.

    The sentence above says what it is.

    Args:
        analysis: of the missing force.
        equation: default: the one whose missing force is surest.

    Raises:
        ModelError: the equation has no missing force.
    """
    force = EquationForce.of(analysis, equation)
    equation = force.equation
    figure, axes = plt.subplots(2, 2, figsize=(12.0, 8.4), layout="constrained")
    plot_force(analysis, equation, ax=axes[0, 0])
    plot_map(analysis, equation, ax=axes[0, 1])
    plot_dependence(analysis, equation=equation, ax=axes[1, 0])
    plot_spectrum(analysis, equation, ax=axes[1, 1])
    figure.suptitle(fill(force.sentence, SENTENCE_LETTERS), fontsize=11)
    return figure


def plot_force(
    analysis: ForceAnalysis,
    equation: str | None = None,
    trajectory: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The missing force along one trajectory, with two standard deviations.

    Args:
        analysis: of the missing force.
        equation: default: the one whose missing force is surest.
        trajectory: its name; default: the one where the force is strongest.
        ax: axes to draw on; None: a new figure.

    Raises:
        ModelError: the equation has no missing force, or the trajectory is not there.
    """
    force = EquationForce.of(analysis, equation)
    name = trajectory or str(force.where["trajectory"])
    shown = _is_in_trajectory(force, name)
    ax = axes_of(ax, (8.0, 3.6))
    t = force.record.t[shown]
    w = force.w[shown]
    deviation = force.record.estimate.posterior.deviation[shown, force.number]
    half_width = SURE_DEVIATIONS * deviation
    ax.plot(t, w, color=MODEL, lw=1.2, label="missing force")
    draw_band(ax, t, w - half_width, w + half_width, "two standard deviations")
    draw_zero(ax)
    ax.set_xlabel(label("t", force.record.units.get("t", "")))
    ax.set_ylabel(force.force_label())
    ax.margins(y=0.25)
    ax.legend(loc="upper right", frameon=False, ncols=2)
    percent = f"{100 * np.mean(np.abs(w) > half_width):.0f} %"
    begin = f"{name}: d{force.equation}/dt"
    draw_title(ax, f"{begin} surely lacks a force during {percent} of the time")
    return ax


def _is_in_trajectory(force: EquationForce, name: str) -> np.ndarray:
    """Which intervals belong to a trajectory, (n_intervals,) of bool."""
    names = force.record.trajectories
    if name not in names:
        raise ModelError(
            f"trajectory={name!r} is not one of the record; "
            f"expected one of {', '.join(names)}.{did_you_mean(name, names)}"
        )
    return np.asarray(force.record.run == names.index(name))


def plot_spectrum(
    analysis: ForceAnalysis, equation: str | None = None, ax: Axes | None = None
) -> Axes:
    """Amplitude of the missing force by frequency, and what its uncertainty explains.

    The mean of the force is taken off.

    Args:
        analysis: of the missing force.
        equation: default: the one whose missing force is surest.
        ax: axes to draw on; None: a new figure.

    Raises:
        ModelError: the equation has no missing force.
    """
    force = EquationForce.of(analysis, equation)
    ax = axes_of(ax, (6.0, 4.0))
    w = force.w
    found = spectrum(force.record.t, force.record.run, w - w.mean())
    level = _level(force)
    unit = frequency_unit(force.record.units)
    ax.plot(
        found.frequencies, found.amplitudes, color=MODEL, lw=1.4, label="missing force"
    )
    ax.fill_between(
        found.frequencies,
        0,
        level,
        color=MEASURED,
        alpha=0.35,
        lw=0,
        label="what its uncertainty explains",
    )
    ax.set_xlim(0, _last_shown(found))
    ax.set_ylim(0, 1.3 * max(found.amplitudes.max(), level.max(), TINY))
    ax.set(xlabel=f"frequency ({unit})", ylabel=force.force_label("amplitude"))
    ax.legend(frameon=False, loc="upper right")
    draw_title(ax, _spectrum_title(force, found, level))
    return ax


def _level(force: EquationForce) -> np.ndarray:
    """Amplitude that the errors of the estimate reach, (n_frequencies,).

    A quantile of few draws is rough, the level itself is smooth: so it is averaged over
    neighbouring frequencies.
    """
    record = force.record
    draws = record.estimate.posterior.error_draws()[:, force.number]
    of_draws = spectrum(record.t, record.run, draws).amplitudes
    rough = np.quantile(of_draws, SPECTRUM_LEVEL, axis=1)
    padded = np.pad(rough, N_SMOOTHED // 2, "edge")
    weights = np.full(N_SMOOTHED, 1 / N_SMOOTHED)
    return np.convolve(padded, weights, "valid")


def _last_shown(found: Spectrum) -> float | None:
    """The frequency behind the last one with a visible amplitude; None: show all."""
    amplitudes = found.amplitudes
    visible = np.flatnonzero(amplitudes > SHOWN_AMPLITUDE * amplitudes.max())
    last = len(amplitudes) - 1
    if not len(visible) or last < 1:
        return None
    return float(found.frequencies[min(visible[-1] + 1, last)])


def _spectrum_title(force: EquationForce, found: Spectrum, level: np.ndarray) -> str:
    what = "the missing force"
    if is_mostly_constant(force.w):
        what = "mostly constant; what varies"
    begin = f"d{force.equation}/dt: {what} is"
    is_above = found.amplitudes > level
    if not is_above.any():
        return f"{begin} nowhere above its uncertainty"
    above = Spectrum(found.frequencies[is_above], found.amplitudes[is_above])
    unit = frequency_unit(force.record.units)
    return f"{begin} strongest at {above.peak:.3g} {unit}"
