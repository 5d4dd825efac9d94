"""What an identification found: the model with its values, tables and equations.

`Identified` is what every method of identification returns; `FitRecord` adds what
`identify` knows of its estimates: covariance, noise, the solver's outcome. How a fit is
printed, stored and drawn stands in `fit`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from phsi_opt.arguments import require_known, require_share, typed
from phsi_opt.data.checks import Hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, shown, some_of
from phsi_opt.later import Later
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import parameter_units
from phsi_opt.model.slots import Entry
from phsi_opt.model.symbolic import Expressions, argument_symbols
from phsi_opt.model_error.disturbances import Process
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.optimization.ipopt import Outcome
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.units import scale_of
from phsi_opt.simulation.simulate import rates, simulate
from phsi_opt.statistics import TINY, student_limit

if TYPE_CHECKING:
    import pandas as pd
    import sympy as sp

COLUMNS = "name slot equation value std_error lower upper unit fixed"  # of parameters
DIGITS = 6  # of printed numbers: more than most data tell
MOST_TERMS = 2_000  # that a right-hand side is multiplied out to: some seconds


@dataclass(frozen=True, eq=False, kw_only=True)
class Identified:
    """A model with the values that were found, and what can be done with it.

    Attributes:
        model: The model; the found values are the values of its parameters.
        hold: How inputs are held between samples, "linear", "zero" or "cubic", or by
            input, as the measurements declared it.
        seconds: Wall time of the whole identification, starting values included.
        removed: Names of the terms that were pruned, in order.
    """

    model: Model
    hold: Hold = "linear"
    seconds: float = np.nan
    removed: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """Value of every parameter by name."""
        return self.model.values

    @property
    def std_errors(self) -> Mapping[str, float]:
        """Standard error by name; NaN where it is not known."""
        return dict.fromkeys(self.model.entries, np.nan)

    @property
    def parameter_units(self) -> Mapping[str, str]:
        """Unit of every parameter by name; "" where it is not known."""
        return {name: one.parameter.unit for name, one in self.model.entries.items()}

    @property
    def parameters(self) -> "pd.DataFrame":
        """Table of the parameters, a row each, fixed ones included.

        Columns: ``name``, ``slot`` (H, R, F or sensor), ``equation`` (empty for H),
        ``value``, ``std_error`` (NaN where not known), ``lower`` and ``upper`` (the
        bounds that the solver kept), ``unit`` (of these numbers), ``fixed``. A
        parameter that every trajectory has of its own has a row per trajectory. Limits
        of confidence are those of `Fit.intervals`.
        """
        rows = []
        for entry in self.model.entries.values():
            parameter = entry.parameter
            scale = scale_of(self.parameter_units[entry.name])
            bounds = map(scale.shown, (parameter.lower, parameter.upper))
            after = (*bounds, scale.unit, parameter.fixed)
            for name, value in self._values_of(entry).items():
                known = (scale.shown(value), self.std_errors[name] / scale.size)
                rows.append((name, entry.slot, entry.equation, *known, *after))
        return printed_table(rows, columns=COLUMNS.split())

    def _values_of(self, entry: Entry) -> dict[str, float]:
        """Values of one parameter of the model by name."""
        return {entry.name: self.values[entry.name]}

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """Simulate the fitted model from given starting states, by SciPy.

        Inputs are held between samples as the measurements declared it.

        Args:
            t: (n_samples,) times, increasing; the simulation starts at ``t[0]``.
            x0: (n_states,) states at ``t[0]``.
            u: (n_samples, n_inputs) inputs at the times, or a function of the time;
                None: the model has none.

        Returns:
            (n_samples, n_states) states at the times.

        Raises:
            DataError: An argument has the wrong shape.
            SolveError: The simulation broke off before the last time.
        """
        return simulate(self.model, t, x0, u, hold=self.hold)

    def sympy(self, named: bool = False) -> "dict[str, sp.Expr]":
        """The fitted model as SymPy expressions.

        Args:
            named: whether the parameters of formulas keep their names; coefficients of
                a dictionary's terms are numbers in any case.

        Returns:
            ``H``, and for every state ``R_<state>``, ``F_<state>`` and the right-hand
            side ``d<state>/dt``, in the names of states, inputs and ``t``; right-hand
            sides are multiplied out where that gives no more than `MOST_TERMS` terms.
        """
        import sympy as sp

        from phsi_opt.model.sympy_backend import SYMPY, n_expanded

        model = self.model
        # Real while it differentiates, or |q| has no simple derivative; plain names in
        # the result.
        x = sp.symbols(model.states, real=True)
        u = sp.symbols(model.inputs, real=True)
        t = sp.Symbol("t", real=True)
        values = {name: sp.Float(value) for name, value in self.values.items()}
        names = model.names_in_formulas if named else ()
        own = sp.symbols(names, real=True)
        values |= zip(names, own, strict=True)
        parts = Expressions(model, x, u, t, values, SYMPY)
        expressions = {"H": sp.sympify(parts.energy)}
        by_state = (model.states, parts.loss, parts.force, parts.rates)
        for state, loss, force, rate in zip(*by_state, strict=True):
            expressions[f"R_{state}"] = sp.sympify(loss)
            expressions[f"F_{state}"] = sp.sympify(force)
            is_short = n_expanded(rate) <= MOST_TERMS
            expressions[f"d{state}/dt"] = sp.expand(rate) if is_short else rate
        plain = {symbol: sp.Symbol(symbol.name) for symbol in (*x, *u, t, *own)}
        return {name: e.xreplace(plain) for name, e in expressions.items()}

    def casadi(self) -> ca.Function:
        """The fitted model as a CasADi function (x, u, t) -> dx, with dx = dx/dt.

        x is (n_states,), u (n_inputs,), t a number; the fitted numbers stand in it. An
        input ``delayed(u, tau)`` is one more of u, behind the others.
        """
        function = rates(self.model.rhs(), self.model.theta)
        x, u, t = argument_symbols(function)
        n_late = len(self.model.delays)  # the slopes in them do not count
        u = u[: u.numel() - n_late]
        dx = function(x, ca.vertcat(u, *[0.0] * n_late), t)
        return ca.Function("rates", [x, u, t], [dx], ["x", "u", "t"], ["dx"])

    def equations(self) -> list[str]:
        """The right-hand sides, one text per state: ``dp/dt = -c*p/m - k*q``.

        Parameters of formulas have their names, whose values are in ``parameters``;
        coefficients of a dictionary's terms are numbers with 6 digits. No term is left
        out, however small.
        """
        from phsi_opt.model.sympy_backend import formula_text

        return [f"d{s}/dt = {e}" for s, e in self._rounded(formula_text).items()]

    def latex(self) -> str:
        """The right-hand sides as an aligned LaTeX block, as in `equations`."""
        import sympy as sp

        rows = self._rounded(sp.latex).items()
        body = " \\\\\n".join(rf"\dot{{{symbol}}} &= {e}" for symbol, e in rows)
        return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"

    def _rounded(self, text_of: "Callable[[sp.Expr], str]") -> dict[str, str]:
        """The right-hand side of every state as text."""
        import sympy as sp

        from phsi_opt.model.sympy_backend import without_steps

        exact = self.sympy(named=True)
        found = {}
        for state in self.model.states:
            rounded = without_steps(exact[f"d{state}/dt"]).n(DIGITS)
            whole = [one for one in rounded.atoms(sp.Float) if float(one).is_integer()]
            rounded = rounded.xreplace({one: sp.Integer(one) for one in whole})
            found[text_of(sp.Symbol(state))] = text_of(rounded)
        return found


# ---- the record of `identify` --------------------------------------------------------

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
class FitRecord(Identified):
    """What an identification found, with its tables.

    The attributes of `Identified` belong to it too.

    Attributes:
        names: Names of the estimated parameters. One that every trajectory has of its
            own appears as ``m[run 1]``, ``m[run 2]``, and stands in ``values`` and in
            the model with its mean. Default: the free parameters of the model.
        by_trajectory: Values of the free parameters by name, for every trajectory by
            name; empty where all parameters are shared.
        loss: Name of the loss, such as "MaximumLikelihood".
        loss_value: The loss at the solution, without its L1 terms.
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
        states: Estimated states at the samples, (n_samples, n_states) per trajectory;
            empty for a loaded fit.
        steps: Integration steps in every gap between samples, (n_samples - 1,) per
            trajectory.
        huber: Residuals beyond this many standard deviations counted linearly (see
            `MaximumLikelihood`); None: all counted squared.
        has_model_error: Whether a random force was part of the likelihood
            (``model_error=True``).
        doubts: What ``caution`` says, worked out when it is first asked for.
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
    states: tuple[np.ndarray, ...] = ()
    steps: tuple[np.ndarray, ...] = ()
    huber: float | None = None
    has_model_error: bool = False
    doubts: Later[str] = field(default_factory=partial(Later.known, ""))

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
        return np.asarray(student_limit((1 - level) / 2, self.degrees_of_freedom))

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
        if self._trajectory_name(trajectory) not in self.by_trajectory:
            known = some_of(list(self.by_trajectory), "none: all parameters are shared")
            raise DataError(
                f"trajectory {shown(trajectory)} has no parameters of its own in this "
                f"fit; known are {known}."
            )
        return simulate(self.model_of(trajectory), t, x0, u, hold=self.hold)


def parameters_of(fit: FitRecord, data: Measurements) -> dict[str, dict[str, float]]:
    """Values of the free parameters by name, for every trajectory by name.

    A trajectory that the fit has not seen by its name gets the means of the fit.
    """
    means = {name: fit.values[name] for name in fit.model.free}
    own = fit.by_trajectory
    return {run.name: means | dict(own.get(run.name, {})) for run in data.trajectories}


def parameter_matrix(
    model: Model, per_trajectory: Mapping[str, Mapping[str, float]]
) -> np.ndarray:
    """Free parameters as columns, (n_free, n_trajectories), of values by trajectory."""
    rows = [[one[name] for one in per_trajectory.values()] for name in model.free]
    return np.array(rows, dtype=float).reshape(len(rows), len(per_trajectory))


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
