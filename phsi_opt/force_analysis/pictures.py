"""Pictures of a missing force: over time, and against what it follows.

Each is a record that page, report and axes draw alike; `plot_where` has them all in one
figure.
"""

from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.analysis import ForceAnalysis, strength_words, when_answer
from phsi_opt.force_analysis.dependence import TIME_NAME, without_parameters
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.waves import period_of
from phsi_opt.presentation.content import (
    TRAINING,
    Follows,
    Force,
    ForceRun,
    thinned,
)
from phsi_opt.presentation.numbers import label
from phsi_opt.presentation.units import Scale, scale_of_time

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# ---- as records ----------------------------------------------------------------------


def samples_of_each(n_curves: int) -> int:
    """How many samples are drawn of each of so many curves.

    At most two for each pixel of a wide screen.
    """
    return int(np.clip(60_000 / max(n_curves, 1), 120, 1_500))


def force_of(force: EquationForce, time: Scale) -> Force:
    """All that is drawn of a missing force; ``time`` is the unit of its times."""
    return Force(
        force.equation_words,
        force.quantity,
        force_runs(force, TRAINING, time),
        force.record.along.runs.index(force.window.trajectory),
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
        known = (name, part, force.equation_words, force.quantity, scale.unit)
        runs.append(ForceRun(*known, t, w, std, origin))
    return tuple(runs)


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
    step = max(1, len(z) // samples_of_each(1))
    said = said or _dependence_words(force, variable)
    labels = (x_label, label(f"missing {force.quantity}", force.scale.unit))
    points = (z[::step], w[::step])
    shown = None if law is None else law[::step] / force.scale.size
    return Follows(heading, *labels, *points, centre, mean, std, said, shown)


def _dependence_words(force: EquationForce, variable: str) -> str:
    """How much of the variation of a force a variable predicts."""
    percent = 100 * force.share_of(variable)
    told = force.variable_words(variable)
    of = f"variation of the {force.quantity} missing in {force.equation_words}"
    less = ""
    if variable != TIME_NAME and force.by_parameters.shape[1]:
        less = " (shown after removing what other parameter values could explain)"
    if percent < 10:
        told = f"No variable clearly; {told}"
        of = f"{of}, most of all"
    return f"{told} predicts {percent:.0f} % of the {of}{less}"


# ---- on axes -------------------------------------------------------------------------


def plot_where(analysis: ForceAnalysis, equation: str | None = None) -> "Figure":
    """Force over time, and against what it follows, in one figure."""
    import matplotlib.pyplot as plt

    from phsi_opt.presentation.charts import draw, follows_chart, force_chart, set_title

    force = analysis.force_in(equation)
    time = scale_of_time(float(force.record.t.max()), force.record.units.get("t", ""))
    found = force_of(force, time)
    panels = (
        (force_chart([found.runs[found.shown]], time.unit), when_answer(force).lead),
        (follows_chart(found.follows), found.follows.sentence),
    )
    figure, axes = plt.subplots(1, 2, figsize=(12.0, 5.0), layout="constrained")
    for ax, (chart, title) in zip(axes, panels, strict=True):
        draw(ax, chart)
        set_title(ax, fill(title, width=50), fontsize=10)
    figure.suptitle(fill(strength_words(force), width=120), fontsize=11)
    return figure
