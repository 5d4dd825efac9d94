"""What a candidate's coefficients do to the defects of a record and to its sensors.

A force changes the defects, a sensor's fault what is shown. An effect with a memory
acts with states of its own, which are integrated along those of the record. A body at
rest has no friction law: there the force is whatever the rest of the model asks for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.initialization.relative_guesses import corner_widths, intervals_at_rest
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.structure import effort_of, position_of_momentum
from phsi_opt.optimization.bounded_step import bounded_least_squares
from phsi_opt.screening.linearized_record import Change, LinearizedRecord
from phsi_opt.statistics import TINY
from phsi_opt.transcription.augmented_states import MemoryIntegration
from phsi_opt.transcription.defects import parameter_slopes
from phsi_opt.transcription.integrators import SCHEME
from phsi_opt.transcription.sensors import output_slopes, outputs

# Share of the diagonal that is added to the correlations of traces: two that are equal
# to rounding still factorise.
CORRELATION_RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Trial:
    """An effect in the model, with what is to be found and what is to be tried."""

    effect: Effect  # the candidate
    model: Model  # the base model with it
    linear: list[str]  # names of its coefficients, in which it is linear
    tried: dict[str, np.ndarray]  # values to try, (n_values,) by inner parameter
    # Name of the inner parameter that is a frequency, if there is one.
    frequency: str | None
    # What its wave runs along, where its value is sought; else None.
    scanned: str | None


@dataclass(frozen=True, eq=False)
class Regression:
    """Coefficients within their bounds, and what they explain."""

    # (k,); one where an effect without a coefficient is there as a whole.
    coefficients: np.ndarray
    drop: float  # fall of the misfit, in units of the noise variance
    information: np.ndarray  # of the coefficients, (k, k)


class Sensitivities:
    """The change by a trial's coefficients, as a function of inner parameters."""

    def __init__(self, linearized: LinearizedRecord, trial: Trial) -> None:
        self.linearized = linearized
        self.trial = trial
        self.states = linearized.states
        self._shape = (linearized.grid.n_intervals, linearized.model.n_states)
        self._memory: MemoryIntegration | None = None
        self._grid = linearized.grid
        if trial.effect.memory:
            self._memory = MemoryIntegration(trial.model, self._grid, self.states)
            self._grid = self._grid.apart()  # the two ends of every interval
        self._places = list(map(trial.model.free.index, trial.linear))
        self.at_rest = self._defects_at_rest()

    def __call__(self, values: dict[str, float]) -> Change:
        """The change at inner parameters' values, per unit of each coefficient."""
        linearized = self.linearized
        k = max(len(self._places), 1)
        theta = linearized.parameters_of(self.trial.model, values)
        at_nodes, at_ends = self._states_with_memory(theta)
        n_at_rest = self.at_rest.shape[1]
        of_defects = np.zeros((self._shape[0] * self._shape[1], k))
        of_outputs = np.zeros((self.states.size, k + n_at_rest))
        if self.trial.effect.slot == "sensor":
            change = self._output_change(at_nodes, theta)
            of_outputs[:, :k] = _finite(change.reshape(-1, k))
        else:
            change = self._defect_change(at_ends, theta)
            of_defects = _finite(change.reshape(-1, k))
        if n_at_rest:
            moving = np.where(self.at_rest != 0, 0.0, of_defects)
            of_defects = np.hstack([moving, self.at_rest])
        return Change(of_defects, of_outputs)

    def traces(self, changes: Sequence[Change]) -> np.ndarray:
        """What changes leave in the residual, (n_values, k of all of them)."""
        return self.linearized.traces(
            np.hstack([change.of_defects for change in changes]),
            np.hstack([change.of_outputs for change in changes]),
        )

    def regression(
        self, trace: np.ndarray, slope: np.ndarray | float = 0.0
    ) -> Regression:
        """Regress the record's residual on a trace (n_values, k) within bounds.

        Beside the misfit the log likelihood may have a ``slope`` (k,).
        """
        trial = self.trial
        information = trace.T @ trace
        right = trace.T @ self.linearized.residual + slope
        if not trial.linear:
            drop = float(2 * right[0] - information[0, 0])
            return Regression(np.ones(1), drop, information)
        size = np.sqrt(np.maximum(np.diag(information), TINY))
        correlation = information / np.outer(size, size)
        factor = np.linalg.cholesky(correlation + CORRELATION_RIDGE * np.eye(len(size)))
        bounds = []
        for name in trial.linear:
            parameter = trial.model.entries[name].parameter
            bounds.append((parameter.lower, parameter.upper))
        # Friction that holds a body at rest may explain up to all of its defects.
        bounds += [(0.0, 1.0)] * (trace.shape[1] - len(bounds))
        lower, upper = np.array(bounds).T * size
        z = np.linalg.solve(factor, right / size)
        scaled = np.linalg.solve(factor.T, z)
        if np.any(scaled < lower) or np.any(scaled > upper):
            upper = np.maximum(upper, lower + TINY)
            scaled = bounded_least_squares(factor.T, z, lower, upper)
        c = scaled / size
        return Regression(c, float(2 * c @ right - c @ information @ c), information)

    def _defect_change(self, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """(n_intervals, n_states, k)"""
        n_intervals, n_states = self._shape
        places = self._places
        model, grid = self.trial.model, self._grid
        known = parameter_slopes(model, grid, SCHEME, theta, x, places, n_states)
        if places:
            slopes = known.slopes.reshape(n_intervals, -1, len(places))
            return slopes[:, :n_states]
        without = self.linearized.defects.reshape(self._shape)
        return (known.d[:, :n_states] - without)[..., None]

    def _output_change(self, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """(n_nodes, n_states, k)"""
        model, grid = self.trial.model, self.linearized.grid
        n_states = self._shape[1]
        if self._places:
            by_theta = output_slopes(model, grid, x, theta).in_parameters
            return by_theta[:, :n_states, self._places]
        with_effect = outputs(model, grid, x, theta)
        return (with_effect[:, :n_states] - self.linearized.shown)[..., None]

    def _states_with_memory(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States at the nodes, and at the two ends of every interval."""
        # A memory acts on an interval with its mean: one that is shorter than an
        # interval is not what lies half way between its values at the ends.
        if self._memory is None:
            return self.states, self.states
        states, means = self._memory(theta)
        begin = self.linearized.grid.begin
        at_ends = states[np.column_stack([begin, begin + 1]).ravel()]
        at_ends[:, -means.shape[1] :] = np.repeat(means, 2, axis=0)
        return states, at_ends

    def _defects_at_rest(self) -> np.ndarray:
        """Defects of a body at rest, (n_intervals * n_states, 1 or 0 columns)."""
        # Where the effect is dry friction on a momentum: at rest the friction is what
        # the rest of the model makes it, whatever its coefficient.
        linearized, model = self.linearized, self.trial.model
        equation = self.trial.effect.equation
        found = np.zeros(self._shape)
        effort = ""  # of a momentum
        if equation in position_of_momentum(linearized.model):
            effort = effort_of(linearized.model, equation)
        # Widths of the effect's own corner, and the formula that is rounded.
        widths = []
        for name, guess in corner_widths(model).items():
            is_own = name not in linearized.model.entries
            if is_own and guess.of == effort:
                widths.append((name, guess.of))
        if widths:
            name, of = widths[0]
            width = model.values[name]
            still = intervals_at_rest(model, linearized.grid, self.states, of, width)
            row = linearized.model.index(equation)
            found[still, row] = -linearized.defects.reshape(self._shape)[still, row]
        return found.reshape(-1, 1)[:, : int(found.any())]


def _finite(values: np.ndarray) -> np.ndarray:
    """A copy of the values, zero where the model has none."""
    if np.isfinite(np.sum(values)):
        return values.copy()
    return np.nan_to_num(values)
