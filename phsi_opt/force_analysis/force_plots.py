"""Pictures of a missing force: over time, its frequencies, and all four in one figure.

Each panel says in its title what to see. Those over states stand in `state_plots`.
"""

from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from phsi_opt.criteria import SPECTRUM_LEVEL, SURE_DEVIATIONS
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.pace import is_mostly_constant
from phsi_opt.force_analysis.spectrum import Spectrum, spectrum
from phsi_opt.force_analysis.state_plots import (
    draw_dependence,
    draw_map,
    draw_title,
)
from phsi_opt.force_analysis.units import frequency_unit
from phsi_opt.force_analysis.words import sentence
from phsi_opt.presentation.axes import MEASURED, MODEL
from phsi_opt.presentation.pictures import plot_missing_force
from phsi_opt.statistics import TINY

SENTENCE_LETTERS = 120  # in a line of the sentence over four panels
# Share of the largest amplitude beyond whose last frequency the spectrum is cut off.
SHOWN_AMPLITUDE = 0.02
# Frequencies of the running mean over a level that is taken from few draws.
N_SMOOTHED = 9


def plot_where(analysis: ForceAnalysis, equation: str | None = None) -> Figure:
    """Force over time, over the states, against what it follows, and its frequencies.

    The sentence above says what it is.

    Of the equation whose missing force is surest, unless another is given.

    Raises:
        ModelError: the equation has no missing force.
    """
    force = analysis.force_in(equation)
    figure, axes = plt.subplots(2, 2, figsize=(12.0, 8.4), layout="constrained")
    draw_force(axes[0, 0], force)
    draw_map(axes[0, 1], force)
    draw_dependence(axes[1, 0], force)
    draw_spectrum(axes[1, 1], force)
    figure.suptitle(fill(sentence(force), SENTENCE_LETTERS), fontsize=11)
    return figure


def draw_force(ax: Axes, force: EquationForce) -> None:
    """The force where it is strongest: one trajectory, two standard deviations."""
    name = force.where["trajectory"]
    record = force.record
    equation = force.equation
    deviation = force.deviation
    columns = {"t": record.t, equation: force.w, f"std_{equation}": deviation}
    shown = record.run == record.trajectories.index(name)
    plot_missing_force(pd.DataFrame(columns)[shown], [equation], record.units, ax)
    is_sure = np.abs(force.w) > SURE_DEVIATIONS * deviation
    percent = f"{100 * np.mean(is_sure[shown]):.0f} %"
    begin = f"{name}: d{equation}/dt"
    draw_title(ax, f"{begin} surely lacks a force during {percent} of the time")


def draw_spectrum(ax: Axes, force: EquationForce) -> None:
    """Amplitude of the force by frequency, and what its uncertainty explains.

    The mean of the force is taken off.
    """
    record = force.record
    found = spectrum(record.t, record.run, force.w - force.w.mean())
    frequencies = found.frequencies
    level = _level(force)
    ax.plot(frequencies, found.amplitudes, color=MODEL, lw=1.4, label="missing force")
    text = "what its uncertainty explains"
    ax.fill_between(frequencies, 0, level, color=MEASURED, alpha=0.35, lw=0, label=text)
    ax.set_xlim(0, _last_shown(found))
    ax.set_ylim(0, 1.3 * max(found.amplitudes.max(), level.max(), TINY))
    unit = frequency_unit(record.units)
    ax.set(xlabel=f"frequency ({unit})", ylabel=force.force_label("amplitude"))
    ax.legend(frameon=False, loc="upper right")
    constant = is_mostly_constant(force.w)
    what = "mostly constant; what varies" if constant else "the missing force"
    seen = "nowhere above its uncertainty"
    is_above = found.amplitudes > level
    if is_above.any():
        above = Spectrum(frequencies[is_above], found.amplitudes[is_above])
        seen = f"strongest at {above.peak:.3g} {unit}"
    draw_title(ax, f"d{force.equation}/dt: {what} is {seen}")


def _level(force: EquationForce) -> np.ndarray:
    """Amplitude that the errors of the estimate reach, (n_frequencies,).

    A quantile of few draws is rough, the level itself is smooth: so it is averaged over
    neighbouring frequencies.
    """
    record = force.record
    draws = record.estimate.posterior.error_draws()[:, force.number]
    of_draws = spectrum(record.t, record.run, draws).amplitudes
    rough = np.quantile(of_draws, SPECTRUM_LEVEL, axis=1)
    return np.asarray(uniform_filter1d(rough, N_SMOOTHED, mode="nearest"))


def _last_shown(found: Spectrum) -> float | None:
    """The frequency behind the last one with a visible amplitude; None: show all."""
    amplitudes = found.amplitudes
    visible = np.flatnonzero(amplitudes > SHOWN_AMPLITUDE * amplitudes.max())
    last = len(amplitudes) - 1
    if not len(visible) or last < 1:
        return None
    return float(found.frequencies[min(visible[-1] + 1, last)])
