"""Free runs along measurements, and what they leave: residuals, and their pictures.

A free run begins at a known state and never looks at the measurements again; after a
gap with an unknown input it begins anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.arguments import require_count
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noticed import breaks_of
from phsi_opt.errors import SolveError
from phsi_opt.model.model import Model
from phsi_opt.presentation.content import Channel
from phsi_opt.presentation.numbers import called, label
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.units import scale_of
from phsi_opt.simulation.simulate import free_run
from phsi_opt.statistics import autocorrelation, rms
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.sensors import outputs_at_samples

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from phsi_opt.presentation.charts import Panel

Runs = tuple[np.ndarray, ...]  # (n_samples, n_states) each
Parameters = Mapping[str, Mapping[str, float]]  # free ones, by trajectory and name


def parameter_matrix(
    model: Model, per_trajectory: Mapping[str, Mapping[str, float]]
) -> np.ndarray:
    """Free parameters as columns, (n_free, n_trajectories), of values by trajectory."""
    rows = [[one[name] for one in per_trajectory.values()] for name in model.free]
    return np.array(rows, dtype=float).reshape(len(rows), len(per_trajectory))


def free_runs(
    model: Model,
    aligned: AlignedData,
    states: Sequence[np.ndarray],
    parameters: Parameters,
) -> tuple[Runs, Runs, Runs]:
    """Simulated states, what the sensors show of them, and measured minus shown.

    Numbers far beyond the measurements stand for a run that broke off.
    """
    data = aligned.data
    simulated = []
    for run, known in zip(data.trajectories, states, strict=True):
        own = model.with_values(parameters[run.name])
        ends = [0, *(breaks_of(run) + 1), run.n_samples]
        pieces = []
        for begin, end in pairwise(ends):
            x0 = known[begin]
            try:
                t, u = run.t[begin:end], run.u[begin:end]
                past = run.past if begin == 0 else None
                x = free_run(own, t, x0, u, data.hold, past)
            except SolveError:
                is_first = np.arange(end - begin)[:, None] == 0
                x = np.where(is_first, x0, 1e3 * np.nanstd(run.x))
            pieces.append(x)
        simulated.append(np.vstack(pieces))
    theta = parameter_matrix(model, parameters)
    shown = outputs_at_samples(model, aligned.grid, simulated, theta)
    residuals = [run.x - y for run, y in zip(data.trajectories, shown, strict=True)]
    return tuple(simulated), tuple(shown), tuple(residuals)


def channels(
    data: Measurements, shown: Runs, noise: Mapping[str, float], number: int
) -> list[Channel]:
    """Every measured channel along the trajectory of a number, in its unit.

    With a free run of each trajectory, and the noise by measured state.
    """
    run = data.trajectories[number]
    found = []
    for name in data.measured:
        k = data.states.index(name)
        scale = scale_of(data.units.get(name, ""))
        measured, simulated = map(scale.shown, (run.x[:, k], shown[number][:, k]))
        moved, off = map(_known, (measured, measured - simulated))
        channel = Channel(
            called(name, data.labels),
            scale.unit,
            noise[name] / scale.size if name in noise else None,
            run.t,
            measured,
            (simulated,),
            (rms(off) if len(off) else None,),
            float(np.std(moved)) if len(moved) else 0.0,
        )
        found.append(channel)
    return found


def _known(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def plot_run(
    data: Measurements,
    found: Sequence[Channel],
    number: int,
    title: str,
    ax: "Axes | None" = None,
) -> "Axes":
    """Measurements and free run of the trajectory of a number, residuals below."""
    from phsi_opt.presentation.charts import Chart, channel_panels, drawn, time_label

    run = data.trajectories[number]
    time = scale_of(data.units.get("t", ""))
    panels: list[Panel] = []
    for one in found:
        panels += channel_panels(replace(one, t=time.shown(run.t)), ("free run",))
    x_label = time_label(time.unit, run.origin)
    return drawn(Chart(x_label, tuple(panels)), title, ax)


class WithResiduals:
    """Residuals of free runs along measurements, and how they are correlated."""

    @property
    def _residuals(self) -> tuple[Measurements, Runs]:
        """The measurements, and measured minus shown."""
        raise NotImplementedError

    def autocorrelation(self, n_lags: int = 40) -> "pd.DataFrame":
        """Autocorrelation of the residuals of every measured state.

        With the residuals e_i of all trajectories::

            r_k = sum_i e_i e_(i+k) / sum_i e_i^2

        Of white noise 95 % of r_1, r_2, ... lie within ``1.96 / sqrt(n_values)`` (Box,
        Jenkins and Reinsel, 2008); a lasting r_k is a motion that the model lacks.

        Args:
            n_lags: Largest lag k, in samples; the longest trajectory limits it.

        Returns:
            A row per lag, 0 included, and a column per measured state beside ``lag``.

        Raises:
            ModelError: ``n_lags`` is no whole number of at least 1.

        Examples:
            >>> r = fit.autocorrelation(n_lags=2)
            >>> print(r["q"].round(1).tolist()[0], abs(r["q"][1]) < 0.2)
            1.0 True
        """
        require_count("n_lags", n_lags)
        data, residuals = self._residuals
        table = {"lag": np.arange(min(n_lags, max(map(len, residuals)) - 1) + 1)}
        for name in data.measured:
            k = data.states.index(name)
            table[name] = autocorrelation([run[:, k] for run in residuals], n_lags)
        return printed_table(table)

    def plot_autocorrelation(self, ax: "Axes | None" = None) -> "Axes":
        """Draw `autocorrelation`, with the band of 95 % for white noise.

        Args:
            ax: Axes whose place is divided among the states; None: a new figure.
        """
        from phsi_opt.presentation.charts import (
            MODEL,
            STEPS,
            Chart,
            Curve,
            Panel,
            drawn,
        )

        data, residuals = self._residuals
        panels = []
        table = self.autocorrelation()
        for name in data.measured:
            k = data.states.index(name)
            n_values = len(_known(np.concatenate(residuals)[:, k]))
            lags, r = table[["lag", name]].to_numpy().T
            curve = Curve("", lags, r, MODEL, STEPS)
            white = 1.96 / np.sqrt(max(n_values, 1))
            said = f"autocorrelation of the residuals of {called(name, data.labels)}"
            panels.append(
                Panel(said, (curve,), noise=white, band="95 % of white noise")
            )
        return drawn(Chart(label("lag", "samples"), tuple(panels)), "", ax)
