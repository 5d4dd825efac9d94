"""What was found beside a model, as rows of a table: where, how large, how lasting."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.estimation.linearized_estimate import SolvedLikelihood
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.processes import Process
from phsi_opt.presentation.units import rate_unit
from phsi_opt.statistics import TINY

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
    solved: SolvedLikelihood, disturbances: Disturbances
) -> tuple[ModelErrorRow, ...]:
    """A row per disturbance beside white noise, forces first."""
    table = _Rows(solved)
    rows = []
    for force in disturbances.forces:
        rows.append(table.of_force(force.place, force.size, force.time, "force"))
    for function in disturbances.functions:
        state = solved.transcription.model.states[function.state]
        kind = f"function of {state}"
        rows.append(table.of_force(function.equation, function.size, np.nan, kind))
    for sensor in disturbances.sensors:
        rows.append(table.of_sensor(sensor))
    rows += table.of_noises(disturbances.sigma)
    return tuple(rows)


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


class _Rows:
    def __init__(self, solved: SolvedLikelihood) -> None:
        grid = solved.transcription.grid
        self._states = solved.transcription.model.states
        self._runs = solved.task.runs
        self._units = solved.task.data.units
        rates = grid.rates(solved.nodes)
        self._rates = np.sqrt(np.mean(rates**2, axis=0))
        self._y = grid.y

    def of_force(
        self, equation: int, size: float, time: float, kind: str
    ) -> ModelErrorRow:
        state = self._states[equation]
        share = size / max(float(self._rates[equation]), TINY)
        where = f"d{state}/dt"
        return ModelErrorRow(where, kind, size, time, self._rate_unit(state), share)

    def of_sensor(self, sensor: Process) -> ModelErrorRow:
        state = self._states[sensor.place]
        spread = max(float(np.nanstd(self._y[:, sensor.place])), TINY)
        where = f"{OF_SENSOR}{state}"
        unit = self._units.get(state, "")
        share = sensor.size / spread
        return ModelErrorRow(where, SENSOR_ERROR, sensor.size, sensor.time, unit, share)

    def of_noises(self, sigma: np.ndarray) -> list[ModelErrorRow]:
        """White noise of every trajectory, for the states of which it differs."""
        rows = []
        for k, state in enumerate(self._states):
            of_runs = sigma[:, k]
            measured = self._y[:, k]
            if np.ptp(of_runs) <= 0 or not np.isfinite(measured).any():
                continue
            spread = max(float(np.nanstd(measured)), TINY)
            for run, size in zip(self._runs, of_runs.tolist(), strict=True):
                where = f"{OF_SENSOR}{state}"
                kind = f"noise of {run}"
                unit = self._units.get(state, "")
                row = ModelErrorRow(where, kind, size, 0.0, unit, size / spread)
                rows.append(row)
        return rows

    def _rate_unit(self, state: str) -> str:
        unit = self._units.get(state, "")
        of_time = self._units.get("t", "")
        if not of_time:
            return unit and f"{unit} per unit of time"
        return rate_unit(unit or "1", of_time)
