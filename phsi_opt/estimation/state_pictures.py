"""The picture of a fit's states: what was measured, and what was estimated of it."""

from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, did_you_mean
from phsi_opt.estimation.fit_record import FitRecord
from phsi_opt.transcription.alignment import aligned_once

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from phsi_opt.presentation.pictures import Channel


def states_picture(
    fit: FitRecord,
    data: Measurements,
    trajectory: str | int,
    ax: "Axes | None",
    state: str | None,
) -> "Axes":
    """Measured and estimated states of one trajectory (see `Fit.plot_states`).

    Raises:
        DataError: the data are not those of the fit, the fit was loaded from a file,
            or a name is unknown.
    """
    from phsi_opt.presentation.pictures import draw_state, plot_states

    data = aligned_once(fit.model, data)
    _check(fit, data)
    number = data.trajectory_number(trajectory)
    run = data.trajectories[number]
    channels = _channels(fit, data, number)
    t_unit = data.units.get("t", "")
    title = f"Measured and estimated states of {run.name}"
    if ax is None:
        return plot_states(run.t, channels, t_unit=t_unit, title=title).axes[0]
    draw_state(ax, run.t, channels[_number(data, state)], t_unit)
    ax.set_title(title)
    return ax


def _check(fit: FitRecord, data: Measurements) -> None:
    """The states of the fit belong to these data."""
    if not fit.states:
        raise DataError(
            "the fit has no estimated states: a file does not keep them, and PHSILoss "
            "estimates none. Call identify, or compare(fit, data).plot()."
        )
    lengths = [len(x) for x in fit.states]
    given = [run.n_samples for run in data.trajectories]
    if lengths != given:
        raise DataError(
            f"the fit has states for trajectories of {lengths} samples, the data have "
            f"{given}; give the measurements that were fitted."
        )


def _number(data: Measurements, state: str | None) -> int:
    """Place of a state; None: the first one measured."""
    if state is None:
        return data.states.index(data.measured[0])
    if state not in data.states:
        raise DataError(
            f"state={state!r} is not one of {', '.join(data.states)}."
            f"{did_you_mean(state, data.states)}"
        )
    return data.states.index(state)


def _channels(fit: FitRecord, data: Measurements, number: int) -> "list[Channel]":
    from phsi_opt.presentation.pictures import Channel

    run = data.trajectories[number]
    estimated = np.asarray(fit.states[number])
    channels = []
    for k, name in enumerate(data.states):
        unit = data.units.get(name, "")
        channels.append(Channel(name, unit, run.x[:, k], estimated[:, k], None))
    return channels
