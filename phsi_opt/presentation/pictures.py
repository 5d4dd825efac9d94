"""Pictures of comparisons, missing forces and histories; each takes ``ax`` and says in
its title what to see.
"""

from textwrap import fill
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.interpolate import PchipInterpolator

if TYPE_CHECKING:
    from phsi_opt.comparison.compare import Comparison
    from phsi_opt.comparison.profile_likelihood import Profile
    from phsi_opt.diagnosis.record import Diagnosis

MEASURED, MODEL, FLOOR = "0.55", "C0", "C2"
PER_INCH = 10  # letters of a label


def plot_comparison(
    comparison: "Comparison", ax: Axes | None = None, trajectory: int = 0
) -> Axes:
    """Measurements and free run of one trajectory; the title gives the error beside the
    noise floor.
    """
    ax = _axes(ax, (8.0, 3.6))
    run, x = comparison.data.trajectories[trajectory], comparison.shown[trajectory]
    deviation = None if comparison.bands is None else comparison.bands[trajectory]
    seen = [
        k
        for k, name in enumerate(comparison.model.states)
        if name in comparison.data.measured
    ]
    for n, k in enumerate(seen):
        name = comparison.model.states[k]
        ax.plot(
            run.t,
            run.x[:, k],
            ".",
            ms=3,
            color=MEASURED if n == 0 else f"C{n + 3}",
            label=f"{name} measured",
        )
        color = MODEL if n == 0 else f"C{n}"
        ax.plot(run.t, x[:, k], "-", lw=1.4, color=color, label=f"{name} free run")
        if deviation is not None:
            low, high = x[:, k] - 2 * deviation[:, k], x[:, k] + 2 * deviation[:, k]
            label = "run, two std. deviations" if n == 0 else None
            ax.fill_between(
                run.t, low, high, color=color, alpha=0.25, lw=0, label=label
            )
    units = {comparison.data.units.get(comparison.model.states[k], "") for k in seen}
    ax.set(
        xlabel=_label("t", comparison.data.units.get("t", "")),
        title=_verdict(comparison, run.name),
    )
    ax.set_ylabel(
        _label(
            ", ".join(comparison.model.states[k] for k in seen),
            units.pop() if len(units) == 1 else "",
        )
    )
    ax.margins(y=0.2)
    ax.legend(loc="upper right", frameon=False, ncols=2)
    return ax


def plot_missing_force(
    diagnosis: "Diagnosis", ax: Axes | None = None, trajectory: int = 0
) -> Axes:
    """The missing force with two standard deviations: where the band leaves zero, the
    model lacks something.
    """
    ax = _axes(ax, (8.0, 3.6))
    frame = diagnosis.missing_force
    part = frame[frame["trajectory"] == trajectory]
    for n, row in enumerate(diagnosis.estimate.prior.rows):
        name = diagnosis.fit.model.states[row]
        w, s = part[name].to_numpy(), part[f"std_{name}"].to_numpy()
        ax.plot(part["t"], w, color=f"C{n}", lw=1.4, label=f"missing in d{name}/dt")
        ax.fill_between(
            part["t"],
            w - 2 * s,
            w + 2 * s,
            color=f"C{n}",
            alpha=0.2,
            lw=0,
            label="two standard deviations",
        )
    ax.axhline(0, color="0.3", lw=0.8)
    units = diagnosis.data.units
    states = {
        units.get(diagnosis.fit.model.states[row], "")
        for row in diagnosis.estimate.prior.rows
    }
    unit = (
        f"{states.pop()}/{units['t']}"
        if len(states) == 1 and "" not in states and units.get("t")
        else ""
    )
    ax.set(
        xlabel=_label("t", units.get("t", "")),
        ylabel=_label("missing force", unit),
        title="Where the band leaves zero, a force is missing",
    )
    ax.margins(y=0.2)
    ax.legend(loc="upper right", frameon=False, ncols=2)
    return ax


def plot_profile(profile: "Profile", ax: Axes | None = None) -> Axes:
    """The profile of a parameter; the interval is where it stays below the threshold."""
    ax = _axes(ax, (6.0, 3.6))
    value, rise = profile.points.T
    # The signed root of the rise is nearly straight, so a smooth curve goes through few
    # points.
    root = PchipInterpolator(value, np.sign(value - profile.value) * np.sqrt(rise))
    inside = np.linspace(value[0], value[-1], 200)
    ax.plot(inside, root(inside) ** 2, "-", color=MODEL, label="profile")
    ax.plot(value, rise, "o", color=MODEL, ms=4, label="re-fits")
    half = (profile.curvature[1] - profile.curvature[0]) / 2
    along = np.linspace(
        min(value[0], profile.curvature[0]), max(value[-1], profile.curvature[1]), 200
    )
    ax.plot(
        along,
        profile.threshold * ((along - profile.value) / half) ** 2,
        "--",
        color=MEASURED,
        label="curvature",
    )
    ax.axhline(
        profile.threshold,
        color=FLOOR,
        lw=1.0,
        ls=":",
        label=f"{100 * profile.level:.3g} %",
    )
    ax.set(
        xlabel=profile.name,
        ylabel="rise of -2 log likelihood",
        ylim=(0, 2 * profile.threshold),
    )
    ax.set_title(
        f"{profile.name}: {profile.ci_lower:.4g} to {profile.ci_upper:.4g}, where the profile is below the line"
    )
    ax.legend(frameon=False, loc="upper center", ncols=2)
    return ax


def plot_history(history: pd.DataFrame, ax: Axes | None = None, unit: str = "") -> Axes:
    """Free-run error per step: training, held out, and the noise floor it can fall to."""
    ax = _axes(ax, (7.0, 3.8))
    steps = history["step"].to_numpy()
    ax.plot(steps, history["train_rmse"], "o--", color=MEASURED, label="training")
    if np.isfinite(history["held_out_rmse"]).any():
        ax.plot(steps, history["held_out_rmse"], "o-", color=MODEL, label="held out")
    ax.plot(
        steps,
        history["noise_floor"],
        ":",
        color=FLOOR,
        label="noise floor",
        marker="_",
        ms=14,
    )
    width = max(
        int(PER_INCH * ax.get_window_extent().width / ax.figure.dpi / len(steps)), 8
    )
    ax.set_xticks(
        steps,
        [
            fill(_change(i, str(name)), width)
            for i, name in enumerate(history["effect"])
        ],
    )
    ax.set(
        ylabel=_label("free-run rmse", unit),
        title="Free-run error after each added effect",
    )
    ax.set_ylim(
        0,
        1.25
        * float(
            np.nanmax(
                history[["train_rmse", "held_out_rmse", "noise_floor"]].to_numpy()
            )
        ),
    )
    ax.margins(x=0.2)
    ax.legend(frameon=False)
    return ax


def _change(step: int, label: str) -> str:
    return label if step == 0 or label.startswith("without ") else f"+ {label}"


def _axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    return plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax


def _label(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _verdict(comparison: "Comparison", run: str) -> str:
    return f"Free run of {run}: rmse {comparison.rmse:.3g}, noise floor {comparison.noise_floor:.3g} (all runs)"
