"""What was found beside a model, as rows of a table: where, how large, how lasting."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.estimation.problem import Task
from phsi_opt.model_error.disturbances import Disturbances, Process
from phsi_opt.presentation.units import rate_unit
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import Grid

SENSOR_ERROR = "sensor error"  # kind of a row
OF_SENSOR = "sensor of "  # where it is, before the name of a state
MODEL_ERROR_COLUMNS = ("where", "kind", "size", "time", "unit", "share")


@dataclass(frozen=True)
class ModelErrorRow:
    """One disturbance beside a model.

    Attributes:
        where: equation, such as "dp/dt", or sensor, such as "sensor of q".
        kind: "force", "sensor error", "function of q", or "noise of run 1" where white
            noise differs between trajectories.
        size: standard deviation, in ``unit``.
        time: correlation time in the unit of the record's times; NaN for a function, 0
            for white noise.
        unit: of the size.
        share: of the typical rate of that equation, or of the channel's spread.
    """

    where: str
    kind: str
    size: float
    time: float
    unit: str
    share: float


def model_error_rows(
    task: Task, grid: Grid, nodes: np.ndarray, disturbances: Disturbances
) -> tuple[ModelErrorRow, ...]:
    """A row per disturbance beside white noise, forces first.

    Args:
        task: what was asked for.
        grid: nodes and measurements.
        nodes: (n_nodes, n_states) states.
        disturbances: what was found.
    """
    states = task.model.states
    units = task.data.units
    typical = np.sqrt(np.mean(grid.rates(nodes) ** 2, axis=0))
    rows = []

    def add(
        kind: str, place: int, size: float, time: float, *, is_sensor: bool = False
    ) -> None:
        state = states[place]
        if is_sensor:
            where, unit = f"{OF_SENSOR}{state}", units.get(state, "")
            whole = float(np.nanstd(grid.y[:, place]))
        else:
            where, unit = f"d{state}/dt", _rate_unit(units, state)
            whole = float(typical[place])
        share = size / max(whole, TINY)
        rows.append(ModelErrorRow(where, kind, size, time, unit, share))

    for force in disturbances.forces:
        add("force", force.place, force.size, force.time)
    for one in disturbances.functions:
        add(f"function of {states[one.state]}", one.equation, one.size, np.nan)
    for sensor in disturbances.sensors:
        add(SENSOR_ERROR, sensor.place, sensor.size, sensor.time, is_sensor=True)
    # White noise of every trajectory, for the states of which it differs.
    differs = np.ptp(disturbances.sigma, axis=0) > 0
    for k in np.flatnonzero(differs & grid.measured_states):
        for run, size in zip(task.runs, disturbances.sigma[:, k].tolist(), strict=True):
            add(f"noise of {run}", int(k), size, 0.0, is_sensor=True)
    return tuple(rows)


def _rate_unit(units: Mapping[str, str], state: str) -> str:
    unit = units.get(state, "")
    of_time = units.get("t", "")
    if not of_time:
        return unit and f"{unit} per unit of time"
    return rate_unit(unit or "1", of_time)


def lasting_noise(
    rows: Sequence[ModelErrorRow], states: Sequence[str], longest: float
) -> tuple[Process, ...]:
    """The errors of sensors among the rows that last no longer than a time."""
    found = []
    for row in rows:
        if row.kind == SENSOR_ERROR and row.time <= longest:
            channel = list(states).index(row.where.removeprefix(OF_SENSOR))
            found.append(Process(channel, row.size, row.time))
    return tuple(found)
