"""The result of `identify`: estimates with their covariance, noise and outcome.

A file leaves the estimated states out: they are as long as the record, and a fit is
used without them.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from phsi_opt.arguments import require_known, require_share, typed
from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, shown, some_of
from phsi_opt.estimation.fit_file import (
    NOT_IN_FILES,
    Content,
    check_keys,
    decoded,
    encoded,
    read_json,
)
from phsi_opt.estimation.free_runs import (
    Runs,
    WithResiduals,
    channels,
    free_runs,
    plot_run,
)
from phsi_opt.estimation.identified import DIGITS, Identified
from phsi_opt.estimation.prediction import Prediction
from phsi_opt.export.targets import exported_path
from phsi_opt.later import Later, Remade
from phsi_opt.model.directions import factors_of
from phsi_opt.model.laws import parameter_words
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import parameter_units
from phsi_opt.model.slots import Entry
from phsi_opt.model.symbolic import dictionary_rows, structure_rows
from phsi_opt.model.terms import Term
from phsi_opt.model_error.disturbances import Process
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.optimization.ipopt import Outcome
from phsi_opt.optimization.program import Program
from phsi_opt.presentation.numbers import estimate_text
from phsi_opt.presentation.sentences import lines
from phsi_opt.presentation.summary import (
    Part,
    Summarised,
    Summary,
    filled,
    printed_table,
)
from phsi_opt.presentation.units import scale_of, spaced
from phsi_opt.simulation.simulate import simulate
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import checked_data
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.writing import write_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

FORMAT = "phsi_opt fit 3"
IDENTIFIER = re.compile(r"[A-Za-z_]\w*")
LONG_NUMBER = re.compile(r"(?<![\w.])\d+\.\d{7,}(?:e[+-]?\d+)?")


SENSOR_ERROR = "sensor error"  # kind of a row
OF_SENSOR = "sensor of "  # where it is, before the name of a state


@dataclass(frozen=True)
class ModelErrorRow:
    """One disturbance that acts besides the model.

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


@dataclass(frozen=True, eq=False, kw_only=True)
class FitUncertainty:
    """How well the estimates of a fit are known.

    Attributes:
        covariance: (n_names, n_names) of the estimates; NaN where it is not known.
        source: what the standard errors come from.
        covariances: (n_names, n_names) by source, all that were worked out.
        freedom: (n_names,) degrees of freedom of the variances; None: those that the
            residuals leave.
        model_error_rows: the disturbances that were found.
        log_evidence: of the model with these disturbances.
        warnings: sentences to read before the numbers are used.
    """

    covariance: np.ndarray
    source: Source = Source.NOISE
    covariances: Mapping[Source, np.ndarray] = field(default_factory=dict)
    freedom: np.ndarray | None = None
    model_error_rows: tuple[ModelErrorRow, ...] = ()
    log_evidence: float = np.nan
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Identified, WithResiduals, Summarised):
    """A fitted model: values, standard errors, solver's outcome and provenance.

    ``print(fit)`` shows the equations with standard errors, the outcome and warnings.

    - Numbers: ``parameters`` (a table), ``estimates``, ``std_errors``,
      ``intervals(level)``, ``correlations``, ``noise``, ``bic``.
    - Equations: ``equations()`` and ``latex()`` in the names of the parameters;
      ``sympy()`` and ``casadi()`` with the fitted numbers.
    - Simulation: ``simulate(t, x0, u)``, and with a band ``predict(t, x0, u)``;
      ``model`` is the fitted model, ``model_of(trajectory)`` that of one trajectory.
    - Residuals: ``residuals``, ``autocorrelation()``, and ``plot()``, which draws the
      measurements with the free run of the fit.
    - Forms: ``print(fit)``, ``plot_parameters()``, ``save(path)`` and
      ``Fit.load(path)``.
    - For others: ``export(path)`` writes C, an FMU, Modelica or MATLAB; ``program`` is
      the nonlinear program.
    - Reliability: ``outcome`` says how the solver ended; read ``warnings`` before you
      use the numbers.

    A fit is never changed in place. The attributes of `Identified` belong to it too.

    Attributes:
        names: Names of the estimated parameters. One that every trajectory has of its
            own appears as ``m[run 1]``, ``m[run 2]``, and stands in ``values`` and in
            the model with its mean. Default: the free parameters of the model.
        by_trajectory: Values of the free parameters by name, for every trajectory by
            name; empty where all parameters are shared.
        loss: Name of the loss, such as "MaximumLikelihood".
        loss_value: The loss at the solution, without its L1 terms and priors.
        uncertainty: What the standard errors come from, and what to know before the
            numbers are used. It can cost more than the estimates, and is worked out
            when one of the properties that read it is first asked for: ``covariance``,
            ``std_errors``, ``intervals``, ``model_error``, ``warnings`` and others.
        noise: Standard deviation of the measurement noise by state, in the state's
            unit; empty for `PHSILoss`.
        outcome: What the solver said.
        n_values: Number of residuals, that is of measured values used.
        bic: Bayesian information criterion; NaN for `PHSILoss`, whose residuals are not
            independent.
        units: Unit by name, of states, inputs and the time ``t``.
        provenance: What the fit was made from: version, loss, settings, digest of the
            data.
        start: Values of free parameters from which the solver began, by name; where a
            fit went on from another one, those of that.
        states: Estimated states at the samples, (n_samples, n_states) per trajectory;
            empty for a loaded fit.
        steps: Integration steps in every gap between samples, (n_samples - 1,) per
            trajectory.
        huber: Residuals beyond this many standard deviations counted linearly (see
            `MaximumLikelihood`); None: all counted squared.
        has_model_error: Whether a random force was part of the likelihood
            (``model_error=True``).
        doubts: What ``caution`` says, worked out when it is first asked for.
        remade_program: Makes ``program``.
        data: The measurements of the fit, in the model's order; None for a loaded fit.
    """

    names: tuple[str, ...] = ()
    by_trajectory: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    loss: str
    loss_value: float
    uncertainty: Later[FitUncertainty]
    noise: Mapping[str, float]
    outcome: Outcome
    n_values: int
    bic: float = np.nan
    units: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)
    states: tuple[np.ndarray, ...] = ()
    steps: tuple[np.ndarray, ...] = ()
    huber: float | None = None
    has_model_error: bool = False
    doubts: Later[str] = field(default_factory=partial(Later.known, ""))
    remade_program: Remade[Program] = field(
        default_factory=Remade, metadata=NOT_IN_FILES
    )
    data: Measurements | None = field(default=None, metadata=NOT_IN_FILES)

    def __post_init__(self) -> None:
        if not self.names:
            object.__setattr__(self, "names", self.model.free)

    @property
    def caution(self) -> str:
        """The warning to read first, empty if there is none.

        The free run on the data of the fit leaves them (of fits with ``states``), or
        the model oscillates faster than their samples show.
        """
        return self.doubts.value

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the estimates in the order of ``names``, (n_names, n_names).

        NaN where it is not known.
        """
        return self.uncertainty.value.covariance

    @property
    def covariances(self) -> Mapping[Source, np.ndarray]:
        """Covariances by source, (n_names, n_names), all that were worked out.

        That of white noise is the inverse of the likelihood's information.
        """
        return self.uncertainty.value.covariances

    @property
    def std_error_source(self) -> Source:
        """What the standard errors come from, one of `Source`.

        White noise, the scatter between trajectories, or model error.
        """
        return self.uncertainty.value.source

    @property
    def model_error_rows(self) -> tuple[ModelErrorRow, ...]:
        """The rows of `model_error`."""
        return self.uncertainty.value.model_error_rows

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence for the model, log Z.

        ::

            log p(y | model) = log of the integral over states and disturbances
                               - (number of free parameters) log(n_values) / 2

        What acts besides the model, a force that it lacks or errors of sensors that
        last, is integrated out, its size chosen by the same evidence (`model_error`
        names it). Starting states have a flat prior of density one in their units. The
        difference between two fits of the same measurements is the logarithm of the
        Bayes factor: from 3 (a factor of 20) it is strong, from 4.6 (100) decisive. NaN
        for a fit by `PHSILoss`, or with L1.
        """
        return self.uncertainty.value.log_evidence

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences to read before the numbers are used."""
        return (*filter(None, (self.caution,)), *self.uncertainty.value.warnings)

    @cached_property
    def estimates(self) -> dict[str, float]:
        """Estimated value of every parameter in ``names``, by name."""
        known = dict(self.values)
        for run, own_values in self.by_trajectory.items():
            known |= {f"{name}[{run}]": value for name, value in own_values.items()}
        return {name: known[name] for name in self.names}

    @cached_property
    def std_errors(self) -> dict[str, float]:
        """Standard error by name, in the unit of the parameter.

        Of all ``names`` and of all parameters of the model; NaN for one that is fixed,
        that ended at a bound, or about which the data say nothing.
        """
        found = np.sqrt(np.diag(self.covariance)).tolist()
        by_name = dict(zip(self.names, found, strict=True))
        return dict.fromkeys(self.model.entries, np.nan) | by_name

    @cached_property
    def parameter_units(self) -> dict[str, str]:
        """Unit of every parameter by name, stated or from those of the measurements.

        It is "" where the units of states, inputs and time do not tell it.
        """
        return parameter_units(self.model, self.units)

    @property
    def correlations(self) -> "pd.DataFrame":
        """Correlations of the estimates, (n_names, n_names), by name both ways."""
        std_errors = np.sqrt(np.diag(self.covariance))
        correlations = self.covariance / np.outer(std_errors, std_errors)
        return printed_table(correlations, index=self.names, columns=self.names)

    @property
    def degrees_of_freedom(self) -> np.ndarray:
        """How well each variance is known, (n_names,), for Student's quantiles."""
        n = len(self.names)
        freedom = self.uncertainty.value.freedom
        return np.full(n, max(self.n_values - n, 1)) if freedom is None else freedom

    @property
    def standard_errors(self) -> "pd.DataFrame":
        """Standard errors of the estimates by where they come from.

        A row per estimate with its name as index. Columns: ``std_error``, the one that
        is given everywhere; ``freedom``, its degrees of freedom; and one per source
        that was worked out (`Source`), such as "white noise", what the likelihood says
        if residuals are independent.
        """
        table = printed_table(index=list(self.names))
        table["std_error"] = np.sqrt(np.diag(self.covariance))
        table["freedom"] = self.degrees_of_freedom
        for source, covariance in self.covariances.items():
            table[str(source)] = np.sqrt(np.diag(covariance))
        return table

    @typed
    def independent_share(self, names: Sequence[str]) -> float:
        """Share of the residuals that is independent, for what these parameters tell.

        The variance of the parameters from white noise alone over the variance that
        they have: the mean over their k directions, ``k / trace(C_white^-1 C)``, at
        most one. A gain of the likelihood by them is worth this share of it (Rotnitzky
        and Jewell, Biometrika 77, 1990). One for a fit with ``model_error=True``, whose
        likelihood knows of it already.

        Args:
            names: of estimated parameters.

        Returns:
            The share; NaN where a covariance is not known.
        """
        if self.std_error_source == Source.NOISE or self.has_model_error:
            return 1.0
        places = [self.names.index(name) for name in names if name in self.names]
        chosen = np.ix_(places, places)
        white = self.covariances[Source.NOISE][chosen]
        given = self.covariance[chosen]
        if not places or not np.isfinite([white, given]).all():
            return float("nan")
        ratio = np.trace(np.linalg.pinv(white, hermitian=True) @ given) / len(places)
        return float(min(1 / max(ratio, TINY), 1.0))

    @property
    def model_error(self) -> "pd.DataFrame":
        """What acts besides the model, as the record shows it.

        Columns: where (equation or sensor), kind (force, function of a state, sensor
        error), size (standard deviation), time (correlation time), unit of the size,
        share (of the typical rate of that equation, or of the channel's spread). Empty
        where nothing but white noise shows.
        """
        time = scale_of(self.units.get("t", ""))
        rows = []
        for row in self.model_error_rows:
            scale = scale_of(row.unit)
            told = {"size": row.size / scale.size, "time": row.time / time.size}
            rows.append(vars(row) | told | {"unit": scale.unit})
        columns = [column.name for column in fields(ModelErrorRow)]
        return printed_table(rows, columns=columns)

    def intervals(self, level: float = 0.95) -> "pd.DataFrame":
        """Confidence intervals of the estimates, from their standard errors.

        The limits are::

            value +- t * std_error

        where t is the quantile of Student's distribution. Its `degrees_of_freedom` are
        n_values - n_names where white noise is all there is: the noise was estimated
        from the same data. Where trajectories give the standard
        errors, or disturbances that were estimated, they are fewer. Where the curvature
        misleads (a bent valley, a bound near by), `profile` gives better limits: these
        are symmetric and may lie beyond a bound, at which a report cuts them.

        Args:
            level: Probability that an interval covers the true value, between 0 and 1.

        Returns:
            A row per estimate with its name as index and the columns ``value``,
            ``ci_lower`` and ``ci_upper``, the limits of confidence. The limits are NaN
            for a parameter without a standard error. (``lower`` and ``upper`` in
            ``parameters`` are something else: the bounds that the solver kept.)

        Raises:
            DataError: ``level`` does not lie between 0 and 1.
        """
        require_share("level", level, DataError)
        half = self._std_errors_within(level) * np.sqrt(np.diag(self.covariance))
        values = np.array(list(self.estimates.values()))
        limits = np.column_stack([values, values - half, values + half])
        columns = ["value", "ci_lower", "ci_upper"]
        return printed_table(limits, index=list(self.estimates), columns=columns)

    def _std_errors_within(self, level: float) -> np.ndarray:
        """Standard errors in half an interval of confidence, (n_names,)."""
        limits = -scipy.special.stdtrit(self.degrees_of_freedom, (1 - level) / 2)
        return np.asarray(limits)

    def model_of(self, trajectory: str | int) -> Model:
        """The model with the parameters of one trajectory.

        Args:
            trajectory: Name of the trajectory, or its number among those of the fit,
                counted from 0 (negative: from the end).

        Returns:
            The model with the trajectory's own values; with the means of the fit for a
            name that the fit has not seen, and where all parameters are shared.

        Raises:
            DataError: The fit has no trajectory of that number.
        """
        name = self._trajectory_name(trajectory)
        return self.model.with_values(self.by_trajectory.get(name, {}))

    def _trajectory_name(self, trajectory: str | int) -> str:
        """Name of a trajectory; that of a number is "" where parameters are shared."""
        names = list(self.by_trajectory)
        if isinstance(trajectory, str):
            return trajectory
        if not names:
            return ""
        if not -len(names) <= trajectory < len(names):
            raise DataError(
                f"there is no trajectory {trajectory}; the fit has {len(names)}, "
                f"counted from 0: {', '.join(names)}."
            )
        return names[trajectory]

    def entry(self, name: str) -> Entry:
        """The model's entry of an estimate, such as that of m for ``m[run 1]``.

        Args:
            name: One of ``names``, or of any parameter of the model.

        Raises:
            ModelError: there is no such parameter.
        """
        require_known(name, self._entries, f"parameter {shown(name)} is unknown")
        return self._entries[name]

    @cached_property
    def _entries(self) -> dict[str, Entry]:
        found = dict(self.model.entries)
        for entry in self.model.entries.values():
            found.update(dict.fromkeys(self._values_of(entry), entry))
        return found

    def _values_of(self, entry: Entry) -> dict[str, float]:
        """Values of one parameter of the model: one, or one per trajectory."""
        if not (entry.parameter.per_trajectory and self.by_trajectory):
            return super()._values_of(entry)
        names = [f"{entry.name}[{run}]" for run in self.by_trajectory]
        return {name: self.estimates[name] for name in names}

    def simulate(
        self, t: Any, x0: Any, u: Any = None, trajectory: str | int | None = None
    ) -> np.ndarray:
        """Simulate the fitted model from given starting states.

        An integration by SciPy, independent of the transcription that the fit was made
        with. Inputs are held between samples as the measurements declared it.

        Args:
            t: (n_samples,) times, increasing; the simulation starts at ``t[0]``.
            x0: (n_states,) states at ``t[0]``.
            u: (n_samples, n_inputs) inputs at the times, or a function of the time;
                None: the model has none.
            trajectory: Name or number of the trajectory whose own parameters are meant;
                None: the means over the trajectories.

        Returns:
            (n_samples, n_states) states at the times.

        Raises:
            DataError: The trajectory has no parameters of its own in this fit.
            SolveError: The simulation broke off before the last time.
        """
        if trajectory is None:
            return super().simulate(t, x0, u)
        self._check_own(trajectory)
        return simulate(self.model_of(trajectory), t, x0, u, hold=self.hold)

    def _check_own(self, trajectory: str | int) -> None:
        if self._trajectory_name(trajectory) not in self.by_trajectory:
            known = some_of(list(self.by_trajectory), "none: all parameters are shared")
            raise DataError(
                f"trajectory {shown(trajectory)} has no parameters of its own in this "
                f"fit; known are {known}."
            )

    def predict(
        self, t: Any, x0: Any, u: Any = None, trajectory: str | int | None = None
    ) -> Prediction:
        """Simulate for new inputs, with the standard deviation of the states.

        To first order in the parameters theta, with their covariance C::

            var x(t) = dx/dtheta C dx/dtheta'

        by central differences along the directions of C. A parameter whose covariance
        is not known is taken as exact.

        Args:
            t: (n_samples,) times, as in `simulate`.
            x0: (n_states,) states at ``t[0]``, taken as exact.
            u: (n_samples, n_inputs) inputs, or a function of the time; None: none.
            trajectory: Name or number of the trajectory whose own parameters are meant;
                None: the means over the trajectories.

        Returns:
            The states with their standard deviation; ``plot()`` draws the band.

        Raises:
            DataError: The trajectory has no parameters of its own in this fit.
            SolveError: The simulation broke off before the last time.

        Examples:
            >>> found = fit.predict([0.0, 0.5, 1.0], x0=[1.0, 0.0])
            >>> print(found.states.shape, found.std[0].tolist())
            (3, 2) [0.0, 0.0]
        """
        states = self.simulate(t, x0, u, trajectory)
        model = self.model if trajectory is None else self.model_of(trajectory)
        runs = list(self.by_trajectory)
        if trajectory is not None:
            runs = [self._trajectory_name(trajectory)]
        of_names = np.zeros((len(model.free), len(self.names)))
        for name, row in zip(model.free, of_names, strict=True):
            own = [name] if name in self.names else [f"{name}[{run}]" for run in runs]
            row[list(map(self.names.index, own))] = 1 / len(own)
        covariance = of_names @ np.nan_to_num(self.covariance) @ of_names.T
        is_known = np.diag(covariance) > 0
        known = list(compress(model.free, is_known))
        covariance = covariance[np.ix_(is_known, is_known)]
        sd = np.sqrt(np.diag(covariance))
        sizes, directions = np.linalg.eigh(covariance / np.outer(sd, sd))
        short = 0.01  # of a standard deviation: far above the tolerance of the solver
        variance = np.zeros_like(states)
        for size, direction in zip(np.maximum(sizes, 0.0), directions.T, strict=True):
            step = dict(zip(known, short * np.sqrt(size) * sd * direction, strict=True))
            ends = []
            for sign in (1.0, -1.0):
                values = {n: model.values[n] + sign * s for n, s in step.items()}
                moved = model.with_values(values)
                ends.append(simulate(moved, t, x0, u, hold=self.hold))
            variance += ((ends[0] - ends[1]) / (2 * short)) ** 2
        times = np.asarray(t, dtype=float)
        std = np.sqrt(variance)
        names = tuple(self.model.states)
        return Prediction(times, states, std, names, self.units)

    @property
    def program(self) -> Program:
        """The nonlinear program of the fit in CasADi's symbols, made anew.

        Variables, objective, constraints, bounds and a start, to be changed and solved
        by any solver of CasADi. A likelihood has the noise of the fit as its setting
        ``p``. Its optimum is that of the fit; where the noise was estimated, to a
        hundredth of a standard error.

        Raises:
            DataError: The fit was loaded, comes from another process, or has
                ``model_error=True``.

        Examples:
            >>> import casadi
            >>> program = fit.program
            >>> quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
            >>> solver = casadi.nlpsol("solver", "ipopt", program.nlp, quiet)
            >>> z = np.array(solver(**program.arguments)["x"]).ravel()
            >>> np.allclose(program.values(z)["theta"], list(fit.estimates.values()))
            True
        """
        if self.remade_program.work is None:
            raise DataError(
                "this fit has no program: it was loaded from a file, comes from "
                "another process, or has model_error=True, which is no single program. "
                "Fit the model here: identify(fit.model, data)."
            )
        return self.remade_program.work()

    # ---- along the measurements of the fit -------------------------------------------

    @cached_property
    def _along(self) -> tuple[Measurements, Runs, Runs]:
        """Measurements, what the sensors show in a free run, and the residuals."""
        if self.data is None:
            raise DataError(
                "a fit that was read from a file has no measurements; give them: "
                "ph.compare(fit, data) has their residuals and draws them."
            )
        aligned = checked_data(self.model, self.data)
        starts = self.states or [np.nan_to_num(run.x) for run in aligned.data]
        parameters = parameters_of(self, aligned.data)
        found = free_runs(self.model, aligned, starts, parameters)
        return aligned.data, *found[1:]

    @property
    def _residuals(self) -> tuple[Measurements, Runs]:
        data, _, residuals = self._along
        return data, residuals

    @property
    def residuals(self) -> Runs:
        """Measured minus free run, (n_samples, n_states) per trajectory.

        The free run begins at the estimated state; NaN where nothing was measured.

        Raises:
            DataError: The fit was read from a file, without its measurements.
        """
        return self._along[2]

    def plot(self, ax: "Axes | None" = None, trajectory: str | int = 0) -> "Axes":
        """Draw the fit: measurements and free run, the residuals below them.

        The band of the residuals covers two standard deviations of the noise; `compare`
        draws a band of the prediction, and other measurements.

        Args:
            ax: Axes whose place is divided among the states; None: a new figure.
            trajectory: Name of the trajectory, or its number, counted from 0.

        Returns:
            The axes; ``fit.plot().figure.savefig("fit.png")`` stores the picture.

        Raises:
            DataError: There is no such trajectory, or the fit was read from a file.
        """
        data, shown, _ = self._along
        number = data.trajectory_number(trajectory)
        found = channels(data, shown, self.noise, number)
        title = f"Fit of {data.trajectories[number].name}"
        return plot_run(data, found, number, title, ax)

    # ---- as file, picture and text ---------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the fit as a JSON file that `load` reads.

        The file contains numbers and formulas as text: model, values, covariance,
        outcome and provenance, with all digits, but not the estimated states.

        Args:
            path: Of the file, such as "fit.json". An existing file is overwritten.

        Raises:
            DataError: The file cannot be written.
        """
        write_whole(path, json.dumps(self.content(), indent=1) + "\n")

    @partial(typed, error=DataError)
    def export(
        self,
        path: str | Path,
        comparison: Summarised | None = None,
        trajectory: str | int | None = None,
    ) -> Path:
        """Write the fitted model for other programs; the suffix of the path decides.

        - ``.c``: C99 that allocates no memory: dx/dt, what the sensors show, a step of
          the classical Runge-Kutta scheme, the parameters as a struct.
        - ``.fmu``: FMI 2.0 for co-simulation, with its sources and a program for this
          machine, which needs a C compiler. Steps are as short as their error asks;
          inputs are held, or change by their derivatives.
        - ``.mo``: a model in Modelica.
        - ``.m``: a function of MATLAB or Octave for ``ode45``.

        Numbers are in the computed units, as in ``values``. Estimates with standard
        errors and units, noise and warnings stand in comments, in an FMU in attributes.
        An input ``delayed(u, tau)`` is one more input in C and MATLAB, behind the
        others.

        Args:
            path: Of the file. An existing file is overwritten.
            comparison: What `compare` found on data that were not used for the fit; its
                errors are told too.
            trajectory: Name or number of the trajectory whose own parameters are meant;
                None: the means over the trajectories.

        Returns:
            The path.

        Raises:
            DataError: The suffix is not known, the file cannot be written, there is no
                C compiler for an FMU, or the trajectory has no parameters of its own.
            ModelError: A term has no form in these languages.

        Examples:
            >>> fit.export("spring.c", ph.compare(fit, test)).name
            'spring.c'
        """
        place = exported_path(path)
        run = ""
        if trajectory is not None:
            self._check_own(trajectory)
            run = self._trajectory_name(trajectory)
        from phsi_opt.export.write import Exported, write_model  # SymPy is slow

        model = self.model_of(run)
        start = np.zeros(model.n_states)
        if self.states:
            start = self.states[[*self.by_trajectory].index(run) if run else 0][0]
        estimates = {name: _estimate(self, name, run) for name in model.entries}
        facts = {"fit": self, "title": _title(self), "equations": equation_lines(self)}
        facts |= {"run": run, "comparison": comparison}
        header = lines(__package__, "exported", **facts)
        units = {**self.units, **self.parameter_units}
        told = Exported(model, start, units, estimates, header)
        return write_model(told, place)

    @classmethod
    @partial(typed, error=DataError)
    def load(cls, path: str | Path) -> "Fit":
        """Read a fit that `save` wrote.

        No code from the file is executed: formulas are parsed with a list of allowed
            functions.

        Args:
            path: Of the file.

        Returns:
            The fit that was saved, except for ``states``, which is empty.

        Raises:
            DataError: The file cannot be read, has another format, is damaged, or
                contains an invalid formula.
        """
        return read_json(path, FORMAT, "a fit", cls.from_content)

    @typed
    def content(self, states: bool = False) -> Content:
        """The fit as numbers, text, lists and mappings: what `save` writes.

        Args:
            states: Whether the estimated states are in it.
        """
        kept = self if states else replace(self, states=())
        return {"format": FORMAT, **encoded(kept)}

    @classmethod
    def from_content(cls, content: Content) -> "Fit":
        """The fit from the numbers and text that `content` returned.

        Raises:
            DataError: A part of the content has a value that no fit can have.
            ModelError: The model in the content is not valid.
            LookupError, TypeError, ValueError, AttributeError: The content is damaged.
        """
        known = dict(content)
        del known["format"]
        fit = decoded(cls, known)
        model = fit.model
        unknown = Theta.of(model, tuple(fit.by_trajectory) or ("",))
        check_keys(dict.fromkeys(fit.names), unknown.names)
        for values in fit.by_trajectory.values():
            check_keys(values, model.free)
        _check_names(fit.noise, model.states)
        _check_names(fit.units, (*model.states, *model.inputs, "t"))
        hold = checked_hold(fit.hold, model.inputs)
        n = len(fit.names)
        covariance = fit.covariance.reshape(n, n)
        freedom = fit.degrees_of_freedom
        if freedom.shape != (n,):
            raise DataError(f"{freedom.size} degrees of freedom for {n} estimates")
        for what, numbers in {
            "the variances of the estimates": np.diag(covariance).tolist(),
            "noise": list(fit.noise.values()),
            "degrees of freedom": freedom.tolist(),
            "n_values": [fit.n_values],
        }.items():
            if np.any(np.array(numbers) < 0):
                raise DataError(f"{what}: {numbers}; none can be negative")
        by_source = fit.covariances.items()
        uncertainty = replace(
            fit.uncertainty.value,
            covariance=covariance,
            covariances={source: one.reshape(n, n) for source, one in by_source},
        )
        return replace(fit, hold=hold, uncertainty=Later.known(uncertainty))

    def plot_parameters(self, ax: "Axes | None" = None) -> "Axes":
        """Draw every estimate with its 95 % interval.

        Intervals are drawn in percent of the estimate's absolute value; the labels give
        the numbers with their units. Orange intervals reach beyond zero. A square marks
        a parameter that ended at a bound, an open circle one without a standard error
        (``warnings`` says why).

        Args:
            ax: Axes to draw on; None: a new figure.

        Returns:
            The axes of the picture.
        """
        from phsi_opt.presentation.pictures import plot_estimates

        table = self.parameters.set_index("name").loc[list(self.names)]
        level = 0.95  # the convention of most tables and pictures
        table["half_width"] = self._std_errors_within(level)
        table["half_width"] *= table["std_error"]
        table["at_bound"] = table.index.isin(self.outcome.at_bounds)
        return plot_estimates(table.reset_index(), level, ax)

    def _summary(self) -> Summary:
        """For notebooks and rich: as the text, the parameters in a table."""
        shown = self.parameters[["name", "value", "std_error", "unit"]]
        equations = Part(code="\n".join(equation_lines(self)))
        remarks = Part(text="\n".join(_remarks(self)))
        return Summary(_title(self), (equations, Part(table=shown), remarks))

    def __str__(self) -> str:
        equations = (f"  {row}" for row in equation_lines(self))
        remarks = filled("\n".join(_remarks(self)), "  ")
        return "\n".join([filled(_title(self)), *equations, remarks])

    __repr__ = __str__


def parameters_of(fit: Fit, data: Measurements) -> dict[str, dict[str, float]]:
    """Values of the free parameters by name, for every trajectory by name.

    A trajectory that the fit has not seen by its name gets the means of the fit.
    """
    means = {name: fit.values[name] for name in fit.model.free}
    own = fit.by_trajectory
    return {run.name: means | dict(own.get(run.name, {})) for run in data.trajectories}


def lasting_noise(
    rows: Sequence[ModelErrorRow], states: Sequence[str], longest: float
) -> tuple[Process, ...]:
    """The errors of sensors among the rows that last no longer than a time."""
    found = []
    for row in rows:
        if row.kind == SENSOR_ERROR and row.time <= longest:
            channel = states.index(row.where.removeprefix(OF_SENSOR))
            found.append(Process(channel, row.size, row.time))
    return tuple(found)


def _check_names(names: Iterable[str], known: Sequence[str]) -> None:
    for name in names:
        require_known(name, known, f"{name!r} is not in the model", DataError)


# ---- text ----------------------------------------------------------------------------


def _title(fit: Fit) -> str:
    states = ", ".join(fit.model.states)
    title = f"Fit of {type(fit.model).__name__} by {fit.loss}: {states}"
    return f"{fit.caution}\n{title}".lstrip()


def equation_lines(fit: Fit) -> list[str]:
    """Structure, terms, and the parameters of formulas by name; a line each.

    Coefficients and inner parameters of a dictionary's terms stand in the terms, those
    of directions behind them.
    """
    rows = structure_rows(fit.model)
    rows += dictionary_rows(fit.model, partial(_term, fit))
    own = fit.model.names_in_formulas
    of_directions = set()
    for placed in fit.model.placed():
        factors = factors_of(placed.equation, fit.model.states)
        of_directions |= set(map(placed.parameter_name, factors))
    for name, entry in fit.model.entries.items():
        fixed = " (fixed)" if entry.parameter.fixed else ""
        if fixed or name in own or name in of_directions:
            told = name if name in own else parameter_words(fit.model, name)
            rows.append(f"{told} = {_estimate(fit, name)}{fixed}")
    rounded = partial(LONG_NUMBER.sub, lambda found: f"{float(found[0]):.{DIGITS}g}")
    return list(map(rounded, rows))


def _remarks(fit: Fit) -> list[str]:
    """What ``answers.jinja`` says: noise, standard errors, solver, warnings."""
    # By how much other sources differ, where it is more than a third.
    errors = fit.standard_errors.drop(columns="freedom")
    ratios = errors.div(errors.pop("std_error"), axis=0).agg(["min", "max"]).T
    limit = 4 / 3
    different = ratios[(ratios["max"] >= limit) | (ratios["min"] <= 1 / limit)]
    rows = different.drop(index=str(fit.std_error_source), errors="ignore").itertuples()
    return lines(__package__, "remarks", fit=fit, different=list(rows)).splitlines()


def _term(fit: Fit, term: Term, place: str, number: int) -> str:
    """A formula as it is; a term with every parameter replaced by its estimate."""
    if term.is_formula:
        return term.body

    def estimate_of(match: re.Match[str]) -> str:
        name = match[0]
        if name not in term.inner:
            return name
        return f"({_estimate(fit, term.parameter_name(place, name))})"

    # In one pass: a unit that was put in may have the name of another parameter.
    coefficient = f"({_estimate(fit, term.parameter_name(place))})"
    return term.product(coefficient, IDENTIFIER.sub(estimate_of, term.body))


def _estimate(fit: Fit, name: str, run: str = "") -> str:
    """Value +- standard error and unit.

    Of a parameter per trajectory that of a ``run``; without one only the mean.
    """
    parameter = fit.model.entries[name].parameter
    scale = scale_of(fit.parameter_units[name])
    unit = spaced(scale.unit)
    is_own = parameter.per_trajectory and bool(fit.by_trajectory)
    key = f"{name}[{run}]" if is_own and run else name
    size = fit.estimates.get(key, fit.values[name])
    value = scale.shown(size)
    if parameter.fixed:
        digits = DIGITS if parameter.guess is None else 3  # a rough rule gave it
        return f"{value:.{digits}g}{unit}"
    if is_own and not run:
        return f"{value:.6g}{unit}, mean over trajectories"
    if key in fit.outcome.at_bounds:
        bound = parameter.nearest_bound(size)
        return f"{scale.shown(bound):.6g}{unit}, at its bound"
    return f"{estimate_text(value, fit.std_errors[key] / scale.size)}{unit}"
