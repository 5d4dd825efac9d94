"""Pictures of a missing force: over time, over states, against what it follows.

Each is a record that page, report and axes draw alike; `plot_where` has them all in one
figure, with the frequencies of the force. Titles say what to see.
"""

from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import CHANCE_LEVEL, CLEAR_PATTERN
from phsi_opt.force_analysis.analysis import ForceAnalysis, dependence_title, sentence
from phsi_opt.force_analysis.dependence import TIME_NAME, without_parameters
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import is_mostly_constant
from phsi_opt.force_analysis.waves import period_of, spectrum
from phsi_opt.presentation.content import (
    TRAINING,
    Follows,
    Force,
    ForceMap,
    ForceRun,
    thinned,
)
from phsi_opt.presentation.numbers import label
from phsi_opt.presentation.units import Scale, frequency_unit, scale_of_time

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from phsi_opt.presentation.charts import Chart

MOST_PER_CURVE = 1_500  # two for each pixel of a wide screen


# ---- as records ----------------------------------------------------------------------


def samples_of_each(n_curves: int) -> int:
    """How many samples are drawn of each of so many curves."""
    return int(np.clip(60_000 / max(n_curves, 1), 120, MOST_PER_CURVE))


def force_of(force: EquationForce, time: Scale) -> Force:
    """All that is drawn of a missing force; ``time`` is the unit of its times."""
    return Force(
        f"d{force.equation}/dt",
        force.quantity,
        sentence(force),
        force_runs(force, TRAINING, time),
        force.strongest_run,
        map_of(force),
        follows_of(force),
    )


def force_runs(force: EquationForce, part: str, time: Scale) -> tuple[ForceRun, ...]:
    """A force along each trajectory of its part of the data."""
    record = force.record
    scale = force.scale
    most = samples_of_each(len(record.along.runs))
    runs = []
    for place, name in enumerate(record.along.runs):
        inside = np.flatnonzero(record.run == place)
        kept = inside[thinned([force.w[inside]], most)]
        t = record.t[kept] / time.size
        w = force.w[kept] / scale.size
        std = force.deviation[kept] / scale.size
        origin = record.origin_of(name)
        known = (name, part, force.equation, force.quantity, scale.unit)
        runs.append(ForceRun(*known, t, w, std, origin))
    return tuple(runs)


def map_of(force: EquationForce) -> ForceMap | None:
    """The mean force over the two variables of its map; None where there is one."""
    names = force.map_variables
    if len(names) < 2:
        return None
    from scipy.stats import binned_statistic_2d  # slow to load

    values = map(force.told, names[:2])
    found = binned_statistic_2d(*values, force.w / force.scale.size, "mean", bins=14)
    return ForceMap(
        force.variable_label(names[0]),
        force.variable_label(names[1]),
        label(f"mean missing {force.quantity}", force.scale.unit),
        (found.x_edge[:-1] + found.x_edge[1:]) / 2,
        (found.y_edge[:-1] + found.y_edge[1:]) / 2,
        found.statistic.T,
    )


def follows_of(
    force: EquationForce,
    variable: str = "",
    heading: str = "",
    said: str = "",
    law: np.ndarray | None = None,
) -> Follows:
    """A force against a variable, the one that predicts it best unless one is given.

    Where the force repeats in time, this is folded to the period. What other values of
    the parameters explain is taken off (see `without_parameters`), but not against
    time. A law (n_intervals,) is drawn through it.
    """
    from scipy.stats import binned_statistic  # slow to load

    variable = variable or force.single_variable
    z = force.told(variable)
    x_label = force.variable_label(variable)
    w = force.w
    if variable != TIME_NAME and law is None:  # beside a law no parameter is free
        w = without_parameters(force, variable)
    elif variable == TIME_NAME and force.share_of(TIME_NAME) >= CLEAR_PATTERN:
        period = period_of(force)
        if period is not None:
            period /= force.scale_of(variable).size
            z = (z - z[0]) % period
            x_label = f"{x_label}, folded to the period of {period:.3g}"
    w = w / force.scale.size
    binned = [binned_statistic(z, w, one, bins=16) for one in ("mean", "std")]
    count, edges = np.histogram(z, binned[0].bin_edges)
    columns = [(edges[:-1] + edges[1:]) / 2, *(one.statistic for one in binned)]
    centre, mean, std = np.array(columns)[:, count > 2]  # of fewer there is no spread
    step = max(1, len(z) // MOST_PER_CURVE)
    said = said or dependence_title(force, variable)
    labels = (x_label, label(f"missing {force.quantity}", force.scale.unit))
    points = (z[::step], w[::step])
    shown = None if law is None else law[::step] / force.scale.size
    return Follows(heading, *labels, *points, centre, mean, std, said, shown)


# ---- on axes -------------------------------------------------------------------------


def plot_where(analysis: ForceAnalysis, equation: str | None = None) -> "Figure":
    """Force over time, over states, against what it follows, and its frequencies."""
    import matplotlib.pyplot as plt

    from phsi_opt.presentation.charts import (
        Chart,
        draw,
        follows_chart,
        force_chart,
        set_title,
    )

    force = analysis.force_in(equation)
    time = scale_of_time(float(force.record.t.max()), force.record.units.get("t", ""))
    found = force_of(force, time)
    if found.map is None:
        over_states = follows_chart(follows_of(force, force.map_variables[0]))
    else:
        over_states = Chart(found.map.x_label, map=found.map)
    panels = (
        (force_chart([found.runs[found.shown]], time.unit), _sure_title(force)),
        (over_states, f"Mean missing {force.quantity} over the states"),
        (follows_chart(found.follows), found.follows.sentence),
        _frequencies(force),
    )
    figure, axes = plt.subplots(2, 2, figsize=(12.0, 8.4), layout="constrained")
    for ax, (chart, title) in zip(axes.flat, panels, strict=True):
        draw(ax, chart)
        set_title(ax, fill(title, width=62), fontsize=10)
    figure.suptitle(fill(found.sentence, width=120), fontsize=11)
    return figure


def _sure_title(force: EquationForce) -> str:
    """During how much of its strongest run a force is sure, in a sentence."""
    share = np.mean(force.is_sure[force.record.run == force.strongest_run])
    return (
        f"{force.window.trajectory}, d{force.equation}/dt: a {force.quantity} is "
        f"significantly missing during {100 * share:.0f} % of the time"
    )


def _frequencies(force: EquationForce) -> "tuple[Chart, str]":
    """Amplitude of the force by frequency, what its uncertainty explains, a title."""
    from scipy.ndimage import uniform_filter1d

    from phsi_opt.presentation.charts import (
        FROM_ZERO,
        MEASURED,
        MODEL,
        Chart,
        Curve,
        Panel,
    )

    record = force.record
    found = spectrum(record.t, record.run, force.w - force.w.mean())
    frequencies = found.frequencies
    amplitudes = found.amplitudes / force.scale.size
    draws = record.estimate.posterior.error_draws()[:, force.number]
    of_draws = spectrum(record.t, record.run, draws).amplitudes
    # A quantile of few draws is rough, the level itself is smooth.
    rough = np.quantile(of_draws, 1 - CHANCE_LEVEL, axis=1)
    level = uniform_filter1d(rough, size=9, mode="nearest") / force.scale.size
    # Cut off behind the last frequency with more than a fiftieth of the largest.
    shown = slice(np.flatnonzero(amplitudes >= amplitudes.max() / 50)[-1] + 2)
    f = frequencies[shown]
    curves = (
        Curve(f"missing {force.quantity}", f, amplitudes[shown], MODEL),
        Curve("explained by its uncertainty", f, level[shown], MEASURED, "dash"),
    )
    unit = frequency_unit(record.units)
    panel = Panel(label("amplitude", force.scale.unit), curves, scale=FROM_ZERO)
    what = f"the missing {force.quantity}"
    if is_mostly_constant(force.w):
        what = "mostly constant; its varying part"
    above = np.where(amplitudes > level, amplitudes, 0.0)
    seen = "nowhere larger than its uncertainty"
    if above.any():
        seen = f"strongest at {frequencies[np.argmax(above)]:.3g} {unit}"
    title = f"d{force.equation}/dt: {what} is {seen}"
    return Chart(f"frequency ({unit})", (panel,)), title
