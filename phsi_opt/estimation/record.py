"""A fit along measurements: what comparing and diagnosing need of both, made once.

Aligning measurements with a model, laying them out, collecting the parameters of every
trajectory and estimating the missing force (with it the noise) are the same for every
question that is asked of a fit. They are done here, and the record is handed on.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import (
    parameter_matrix,
    parameters_of,
)
from phsi_opt.estimation.force_search import longest_noise, missing_force_of
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.model_error_table import SENSOR_ERROR
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import AlignedData, Grid


@dataclass(frozen=True, eq=False)
class Record:
    """A fit beside one set of measurements.

    Attributes:
        fit: the fit.
        aligned: the measurements in the model's order, laid out.
        parameters: values of the free parameters by trajectory and name; for a
            trajectory that the fit has not seen, the means of the fit. Where they are
            `estimated_here` that is where the search for them begins.
        estimate: states, noise and missing force along the measurements. Of a candidate
            (see `refitted`) it is that of the base model: noise and starting states
            are then judged alike for all candidates.
    """

    fit: Fit
    aligned: AlignedData
    parameters: Mapping[str, Mapping[str, float]]
    estimate: ForceEstimate

    @classmethod
    def of(cls, fit: Fit, data: Measurements) -> "Record":
        """The record of a fit and measurements that hold its states and inputs.

        Raises:
            DataError: a state or input of the model is not in the measurements.
            SolveError: the missing force could not be estimated.
        """
        return cls.of_aligned(fit, AlignedData.of(fit.model, data))

    @classmethod
    def of_aligned(cls, fit: Fit, aligned: AlignedData) -> "Record":
        """`of` for measurements that were aligned with the model before.

        Raises:
            SolveError: the missing force could not be estimated.
        """
        aligned = aligned.for_model(fit.model)
        estimate = missing_force_of(fit, aligned.data, aligned.grid)
        return cls.beside(fit, aligned, estimate)

    @classmethod
    def beside(
        cls, fit: Fit, aligned: AlignedData, estimate: ForceEstimate
    ) -> "Record":
        """The record of a fit that begins at an estimate made before."""
        aligned = aligned.for_model(fit.model)
        return cls(fit, aligned, parameters_of(fit, aligned.data), estimate)

    def refitted(self, fit: Fit) -> "Record":
        """The same measurements beside the fit of a larger model."""
        return Record.beside(fit, self.aligned, self.estimate)

    @property
    def data(self) -> Measurements:
        """The measurements, states and inputs in the model's order."""
        return self.aligned.data

    @property
    def grid(self) -> Grid:
        """The measurements laid out, one interval between neighbouring samples."""
        return self.aligned.grid

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.fit.model

    @property
    def trajectories(self) -> tuple[str, ...]:
        """Names of the trajectories."""
        return tuple(run.name for run in self.data.trajectories)

    @cached_property
    def theta(self) -> np.ndarray:
        """The free parameters, (n_free, n_trajectories)."""
        return parameter_matrix(self.model, self.parameters)

    @property
    def sigma(self) -> np.ndarray:
        """Noise per state, (n_states,); one for states that nobody measured.

        With noise that lasts from sample to sample, all of it.
        """
        n_states = self.model.n_states
        known = self.estimate.sigma[:n_states]
        sigma = np.r_[known, np.ones(n_states - len(known))]
        if not self.has_correlated_noise:
            return sigma
        # Few of its values are independent: the longer record of the fit knows it too.
        of_fit = [self.fit.noise.get(name, 0.0) for name in self.model.states]
        return np.maximum(sigma, of_fit)

    @property
    def has_correlated_noise(self) -> bool:
        """Whether what is beside the model is noise of the sensors that lasts briefly.

        As the fit found it: for a few samples, and no force and no function of a state.
        """
        rows = self.fit.model_error_rows
        if self.fit.has_model_error:
            return False
        errors = [row.time for row in rows if row.kind == SENSOR_ERROR]
        others = [row for row in rows if row.kind != SENSOR_ERROR and row.time != 0]
        return bool(errors) and not others and max(errors) <= longest_noise(self.grid)

    @property
    def shows_correlated_noise(self) -> bool:
        """Whether noise of the sensors that lasts briefly is beside the model at all.

        A force may be beside it too, or a function of a state.
        """
        rows = self.fit.model_error_rows
        errors = [row.time for row in rows if row.kind == SENSOR_ERROR]
        return bool(errors) and min(errors) <= longest_noise(self.grid)

    @property
    def start(self) -> tuple[np.ndarray, ...]:
        """States of the estimate at the samples, (n_samples, n_known) per trajectory.

        The memory that a candidate adds is not in them.
        """
        return self.estimate.grid.split(self.estimate.x)

    @property
    def is_of_training(self) -> bool:
        """Whether the fit was made from these measurements, and knows their states."""
        return bool(self.fit.states) and self._was_fitted

    @property
    def _was_fitted(self) -> bool:
        """Whether the fit was made from these very measurements."""
        return self.fit.provenance.get("data_sha256") == self.data.digest

    def estimated_here(self, model: Model) -> set[str]:
        """Names of the parameters whose values these measurements give, not the fit.

        As starting states are: what every trajectory has of its own, where the fit was
        not made from these measurements.

        Args:
            model: the fitted one, or a larger one.
        """
        if self._was_fitted:
            return set()
        return {
            name for name in model.free if model.entries[name].parameter.per_trajectory
        }
