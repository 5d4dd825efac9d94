"""The likelihood of a record, linearised at many points.

Defects and sensors are made once for a model and its grid, and so is the place of every
slope in the band of states and multipliers. A point then costs one evaluation and one
factorisation.
"""

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defect_derivatives import DefectLinearization
from phsi_opt.transcription.elimination import (
    REGULAR,
    ReducedSystem,
    Step,
    time_order,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import SensorLinearization


@dataclass(frozen=True, eq=False)
class LinearOutputs:
    """What the sensors show, in units of the noise.

    Attributes:
        residual: measured less shown, (n_nodes * n_states,); 0: unmeasured.
        weight: one over the noise, (n_nodes * n_states,); 0: unmeasured.
        places: (n_entries, 2) shown state and state of each slope in the states.
        in_states: these slopes, (n_nodes, n_entries).
        columns: (n_columns,) the scaled parameters that sensors have.
        in_theta: slopes in these, (n_nodes * n_states, n_columns).
        n_theta: number of all parameters.
    """

    residual: np.ndarray = field(repr=False)
    weight: np.ndarray = field(repr=False)
    places: np.ndarray
    in_states: np.ndarray = field(repr=False)
    columns: np.ndarray
    in_theta: np.ndarray = field(repr=False)
    n_theta: int

    def change(self, step: Step) -> np.ndarray:
        """Of what is shown by a step of all unknowns, (n_nodes * n_states, ...)."""
        by_states = self._through(step.x, *self.places.T)
        return by_states + self.in_theta @ step.theta[self.columns]

    def gradient(self, values: np.ndarray) -> Step:
        """The transposed of `change`, of values (n_nodes * n_states, ...)."""
        theta = np.zeros((self.n_theta, *values.shape[1:]))
        theta[self.columns] = self.in_theta.T @ values
        return Step(theta, self.in_states_times(values))

    def in_states_times(self, values: np.ndarray) -> np.ndarray:
        """The part of `gradient` in the states."""
        shown, state = self.places.T
        return self._through(values, state, shown)

    def _through(
        self, values: np.ndarray, rows: np.ndarray, columns: np.ndarray
    ) -> np.ndarray:
        """The matrix with the slopes at these places of every node, times values."""
        n_nodes = len(self.in_states)
        given = values.reshape(n_nodes, -1, *values.shape[1:])
        result = np.zeros_like(given)
        per_entry = self.in_states.T.reshape(-1, n_nodes, *[1] * (values.ndim - 1))
        for slope, row, column in zip(per_entry, rows, columns, strict=True):
            result[:, row] += slope * given[:, column]
        return result.reshape(values.shape)


@dataclass(frozen=True, eq=False)
class LinearPoint:
    """The linearised likelihood at one point.

    Attributes:
        defects: (n_intervals * n_states,).
        outputs: what the sensors show, parameters scaled.
        scale: size of each parameter, (n_theta,).
        reduced: the system with its states eliminated.
    """

    defects: np.ndarray = field(repr=False)
    outputs: LinearOutputs = field(repr=False)
    scale: np.ndarray
    reduced: ReducedSystem = field(repr=False)


class RecordLinearization:
    """The likelihood of a model along a record, made once for many points.

    Args:
        unknown: the layout of the vector of the model's parameters.
        grid: nodes and intervals.
        scheme: name of the integrator.
        sigma: (n_states,) noise.
    """

    def __init__(
        self, unknown: Theta, grid: Grid, scheme: str, sigma: np.ndarray
    ) -> None:
        model = unknown.model
        n_runs = len(unknown.runs)
        self._unknown = unknown
        self._grid = grid
        self._n_states = n = model.n_states
        self._weight = np.where(grid.measured, 1 / sigma, 0.0)
        self._defects = DefectLinearization(model, scheme, grid, n_runs)
        self._sensors = SensorLinearization(model, grid, n_runs)
        self._row, inner = self._defects.places.T
        self._is_in_state = inner < 2 * n
        self._state = inner[self._is_in_state]
        self._parameter = inner[~self._is_in_state] - 2 * n
        shown, of = self._sensors.places.T
        self._is_shown_state = of < n
        self._shown_state = self._sensors.places[self._is_shown_state]
        self._shown_parameter = np.array(
            [shown[~self._is_shown_state], of[~self._is_shown_state] - n]
        ).T
        self._pairs = _entries_of_one_row(self._shown_state)
        self._layout = self._band()

    def _band(self) -> BandLayout:
        """The places of all that `_factors` lists."""
        grid, n = self._grid, self._n_states
        n_x = grid.n_nodes * n
        node = n * np.arange(grid.n_nodes)
        interval = n_x + n * np.arange(grid.n_intervals)
        state = self._shown_state[:, 1]
        every_state = np.arange(n_x)
        row = np.add.outer(node, state[self._pairs[:, 0]]).ravel()
        column = np.add.outer(node, state[self._pairs[:, 1]]).ravel()
        defect = np.add.outer(interval, self._row[self._is_in_state]).ravel()
        of_state = np.add.outer(n * grid.begin, self._state).ravel()
        order = time_order(grid, ("node", n), ("interval", n))
        rows = np.concatenate([row, every_state, defect, of_state])
        columns = np.concatenate([column, every_state, of_state, defect])
        return BandLayout(rows, columns, order)

    def at(self, x: np.ndarray, theta: np.ndarray) -> LinearPoint:
        """Linearise at states (n_nodes, n_states) and parameters (n_theta,)."""
        by_trajectory = theta[self._unknown.table]
        values, slopes = self._defects.at(x, by_trajectory)
        in_theta = self._defects_in_theta(slopes[:, ~self._is_in_state])
        outputs = self._outputs(x, by_trajectory)
        squares = np.sum(in_theta**2, axis=0)
        squares[outputs.columns] += np.sum(outputs.in_theta**2, axis=0)
        scale = 1 / np.where(squares > 0, np.sqrt(squares), 1.0)
        scaled = outputs.in_theta * scale[outputs.columns]
        outputs = replace(outputs, in_theta=scaled)
        factors = self._factors(outputs, slopes[:, self._is_in_state])
        return LinearPoint(
            defects=values.ravel().copy(),
            outputs=outputs,
            scale=scale,
            reduced=self._reduced(factors, outputs, in_theta * scale),
        )

    def _defects_in_theta(self, slopes: np.ndarray) -> np.ndarray:
        """Slopes of the defects in theta, (n_intervals * n_states, n_theta)."""
        grid = self._grid
        result = np.zeros((grid.n_intervals, self._n_states, len(self._unknown)))
        places = self._unknown.table[:, grid.trajectory[grid.begin]]
        rows = self._row[~self._is_in_state]
        every = np.arange(grid.n_intervals)
        for slope, row, owner in zip(slopes.T, rows, self._parameter, strict=True):
            result[every, row, places[owner]] = slope
        n_defects = grid.n_intervals * self._n_states
        return result.reshape(n_defects, len(self._unknown))

    def _outputs(self, x: np.ndarray, by_trajectory: np.ndarray) -> LinearOutputs:
        grid, table = self._grid, self._unknown.table
        shown, slopes = self._sensors.at(x, by_trajectory)
        left = np.where(grid.measured, grid.y - shown, 0.0)
        owners = self._shown_parameter[:, 1]
        columns = np.unique(table[owners])
        in_theta = np.zeros((grid.n_nodes, self._n_states, len(columns)))
        every = np.arange(grid.n_nodes)
        of_parameters = slopes[:, ~self._is_shown_state]
        places = np.searchsorted(columns, table)
        for slope, (row, owner) in zip(
            of_parameters.T, self._shown_parameter, strict=True
        ):
            place = places[owner, grid.trajectory]
            in_theta[every, row, place] = self._weight[:, row] * slope
        of_states = slopes[:, self._is_shown_state]
        return LinearOutputs(
            residual=(self._weight * left).ravel(),
            weight=self._weight.ravel(),
            places=self._shown_state,
            in_states=self._weight[:, self._shown_state[:, 0]] * of_states,
            columns=columns,
            in_theta=in_theta.reshape(shown.size, len(columns)),
            n_theta=len(self._unknown),
        )

    def _factors(self, outputs: LinearOutputs, slopes: np.ndarray) -> Banded:
        """Of states and multipliers, parameters held."""
        first, second = self._pairs.T
        curvature = outputs.in_states[:, first] * outputs.in_states[:, second]
        diagonal = np.zeros((self._grid.n_nodes, self._n_states))
        for slope, state in zip(outputs.in_states.T, outputs.places[:, 1], strict=True):
            diagonal[:, state] += slope**2
        largest = float(np.max(diagonal, initial=0.0))
        shift = np.full(diagonal.size, REGULAR * max(largest, TINY))
        jacobian = slopes.ravel()
        entries = np.concatenate([curvature.ravel(), shift, jacobian, jacobian])
        return Banded.of(self._layout, entries)

    def _reduced(
        self, factors: Banded, outputs: LinearOutputs, in_theta: np.ndarray
    ) -> ReducedSystem:
        n_theta = len(self._unknown)
        of_states = np.zeros((outputs.residual.size, n_theta))
        curvature = np.zeros((n_theta, n_theta))
        if len(outputs.columns):
            of_states[:, outputs.columns] = outputs.in_states_times(outputs.in_theta)
            both = np.ix_(outputs.columns, outputs.columns)
            curvature[both] = outputs.in_theta.T @ outputs.in_theta
        coupling = np.concatenate([of_states, in_theta])
        return ReducedSystem.of_factors(
            self._grid, self._n_states, factors, coupling, curvature
        )


def _entries_of_one_row(places: np.ndarray) -> np.ndarray:
    """Every two entries of one row, as numbers among ``places``, (n_pairs, 2)."""
    rows = places[:, 0].tolist()
    numbers = range(len(rows))
    pairs = [(i, j) for i, j in product(numbers, numbers) if rows[i] == rows[j]]
    return np.array(pairs, dtype=int).reshape(-1, 2)
