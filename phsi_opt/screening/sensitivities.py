"""What a candidate's coefficients do to the defects of a record and to what its sensors
show.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from phsi_opt.initialization.relative_guesses import corner_widths, intervals_at_rest
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.screening.linearized_record import LINEARIZATION_SCHEME
from phsi_opt.transcription.augmented_states import MemoryIntegration
from phsi_opt.transcription.defects import defect_function, defect_jacobian
from phsi_opt.transcription.sensors import output_slopes, outputs

if TYPE_CHECKING:
    from phsi_opt.screening.score_test import Screen


@dataclass(frozen=True, eq=False)
class Trial:
    """An effect in the model: names of its linear coefficients, values to try per inner
    parameter, frequency.
    """

    effect: Effect
    model: Model
    linear: list[str]
    tried: dict[str, np.ndarray]
    frequency: str | None


class Columns:
    """What a trial's coefficients do to the defects and to what is shown, as functions
    of its inner parameters.
    """

    def __init__(self, screen: "Screen", trial: Trial) -> None:
        self.screen, self.trial = screen, trial
        self.chosen = [trial.model.free.index(name) for name in trial.linear]
        n_runs, n_old = screen.values.shape[1], screen.model.n_states
        self.states = screen.obeying if trial.effect.slot == "sensor" else screen.x
        self.memory = (
            MemoryIntegration(trial.model, screen.grid, self.states)
            if trial.effect.memory
            else None
        )
        self.slopes = self.function = None
        self.grid = screen.grid if self.memory is None else screen.grid.apart()
        if trial.effect.slot != "sensor" and self.chosen:
            self.slopes = defect_jacobian(
                trial.model, self.grid, LINEARIZATION_SCHEME, self.chosen, n_runs, n_old
            )
        elif trial.effect.slot != "sensor":
            self.function = defect_function(
                trial.model, self.grid, LINEARIZATION_SCHEME, n_runs, n_old
            )
        self.rest = self._rest()

    def _states(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States at the nodes, and at the nodes of the intervals: a memory acts there
        with its mean.

        A memory shorter than an interval is not what lies half way between its values
        at the ends.
        """
        if self.memory is None:
            return self.states, self.states
        memory = self.memory(theta)
        x = memory.states
        means = memory.interval_means
        along = x[
            np.column_stack(
                [self.screen.grid.begin, self.screen.grid.begin + 1]
            ).ravel()
        ]
        along[:, -means.shape[1] :] = np.repeat(means, 2, axis=0)
        return x, along

    def _rest(self) -> np.ndarray:
        """Defects of a body at rest, (n_defects, 1 or 0 columns), where the effect is
        dry friction on a momentum.

        There the friction is what the rest of the model makes it, whatever its
        coefficient.
        """
        screen, entries = self.screen, self.screen.model.entries
        new = [
            (name, guess)
            for name, guess in corner_widths(self.trial.model).items()
            if name not in entries
        ]
        defects = np.zeros((screen.grid.n_intervals, screen.model.n_states))
        for name, guess in (
            new[:1]
            if self.trial.effect.equation in position_of_momentum(screen.model)
            else ()
        ):
            still = intervals_at_rest(
                self.trial.model,
                screen.grid,
                screen.x,
                guess.of,
                self.trial.model.values[name],
            )
            row = screen.model.index(self.trial.effect.equation)
            defects[still, row] = -screen.defects.reshape(defects.shape)[still, row]
        return defects.reshape(-1, 1)[:, : int(defects.any())]

    @cached_property
    def own(self) -> "Columns | None":
        """The columns along the states of the fit."""
        return None if self.screen.own is None else Columns(self.screen.own, self.trial)

    def __call__(self, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """D (n_defects, k) and Y (n_nodes * n_states, k)."""
        screen, model, grid = self.screen, self.trial.model, self.screen.grid
        theta = screen.theta_at(model, values)
        x, along = self._states(theta)
        n_old, k = screen.model.n_states, max(len(self.chosen), 1)
        D, Y = (
            np.zeros((grid.n_intervals, n_old, k)),
            np.zeros((grid.n_nodes, n_old, k)),
        )
        if self.slopes is not None:
            D = np.array(self.slopes(along.T, theta)).reshape(
                grid.n_intervals, model.n_states, k
            )[:, :n_old]
        elif self.function is None:
            if self.chosen:
                Y = output_slopes(model, grid, x, theta).in_parameters[
                    :, :n_old, self.chosen
                ]
            else:
                Y = (
                    np.array(outputs(model, grid, ca.DM(x.T), ca.DM(theta))).T[
                        :, :n_old
                    ]
                    - screen.shown
                )[..., None]
        else:
            d = np.array(self.function(along.T, theta)).T[:, :n_old]
            D = (d - screen.defects.reshape(grid.n_intervals, n_old))[..., None]
        D, Y, n_rest = (
            np.nan_to_num(D.reshape(-1, k)),
            np.nan_to_num(Y.reshape(-1, k)),
            self.rest.shape[1],
        )
        if n_rest:
            D = np.hstack([np.where(self.rest != 0, 0.0, D), self.rest])
        return D, np.pad(Y, ((0, 0), (0, n_rest)))
