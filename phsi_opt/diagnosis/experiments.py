"""The experiment that comes next: what tells two models apart, or sharpens a parameter.

An experiment is designed within limits (`diagnosis/design_problem.py`), and what it
promises is checked by simulating: each of two models in turn is taken for the truth,
and the other one is fitted to the present record and the experiment together. What it
cannot imitate is the log Bayes factor to expect. The standard errors to expect of one
model are those of the design: the information of record and experiment together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.arguments import is_of, require, require_known
from phsi_opt.comparison.compare import compare
from phsi_opt.criteria import DECISIVE_EVIDENCE
from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.copies import copies_in, counted_once
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.design_problem import (
    Design,
    Plan,
    PlannedModel,
    designs,
)
from phsi_opt.errors import ModelError, PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.model.model import Model
from phsi_opt.optimization.column_function import in_numbers
from phsi_opt.presentation.numbers import range_words
from phsi_opt.presentation.units import scale_of, spaced
from phsi_opt.simulation.simulate import SampledInputs, free_run
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.writing import write_whole


@dataclass(frozen=True, eq=False)
class Experiment:
    """An experiment within limits, and what it is expected to tell.

    Attributes:
        t: (n_samples,) times, in s.
        u: (n_samples, n_inputs) inputs, as the data have them.
        inputs: their names.
        x0: the start by state; where it is not to be chosen, that of the record.
        kind: "multisine", "steps", "chirp", or "start" for a model without inputs.
        log_bayes: expected logarithm of the Bayes factor, the name of each model to
            that for it where it is the true one. One that contains the other imitates
            it, and is then not rejected. Empty where parameters are to be told.
        std_errors: standard errors of the parameters, present and expected. One that
            the record does not tell, NaN, is taken as its own size.
        hold: between the samples, as in the data.
        units: of times, inputs, states and parameters, by name.
    """

    t: np.ndarray
    u: np.ndarray
    inputs: tuple[str, ...]
    x0: Mapping[str, float]
    kind: str
    log_bayes: Mapping[str, float] = field(default_factory=dict)
    std_errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    hold: Hold = "linear"
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """What to do, and what it is expected to tell."""
        told = []
        for name, (before, after) in self.std_errors.items():
            scale = scale_of(self.units.get(name, ""))
            known = "unknown" if np.isnan(before) else f"{before / scale.size:.2g}"
            reached = f"{after / scale.size:.2g}{spaced(scale.unit)}"
            told.append(f"{name} from {known} to {reached}")
        if told:
            less = f"it reduces the standard error of {', '.join(told)}"
            return f"{self.words}: {less}."
        first, second = self.log_bayes
        best = max(self.log_bayes.values())
        if best < DECISIVE_EVIDENCE:
            return (
                f"No experiment within these limits distinguishes {first} from "
                f"{second}: the best has a log Bayes factor of {best:.2g}."
            )
        truths = [
            f"{value:.3g} if {name} is true" for name, value in self.log_bayes.items()
        ]
        return f"{self.words}: expected log Bayes factor {', '.join(truths)}."

    @property
    def words(self) -> str:
        """The experiment in words, its input with range and length, or its start."""
        time = scale_of(self.units.get("t", ""))
        length = f"{time.shown(self.t[-1] - self.t[0]):.3g}{spaced(time.unit)}"
        parts = []
        for name, values in zip(self.inputs, self.u.T, strict=True):
            scale = scale_of(self.units.get(name, ""))
            least, most = scale.shown(np.array([values.min(), values.max()])).tolist()
            parts.append(f"{name} from {range_words(least, most, scale.unit)}")
        if self.kind == "start":
            for name, value in self.x0.items():
                scale = scale_of(self.units.get(name, ""))
                parts.append(f"{name} = {scale.shown(value):.3g}{spaced(scale.unit)}")
            return f"Start at {', '.join(parts)} and measure for {length}"
        kind = self.kind if self.kind == "steps" else f"a {self.kind}"
        return f"Apply {kind} for {length}, {', '.join(parts)}"

    def to_csv(self, path: str | Path) -> Path:
        """Write times and inputs for the rig, in the units of the data.

        Raises:
            DataError: the file cannot be written.
        """
        names = ["t", *self.inputs]
        scales = [scale_of(self.units.get(name, "")) for name in names]
        heads = [
            f"{name} [{scale.unit}]" if scale.unit else name
            for name, scale in zip(names, scales, strict=True)
        ]
        columns = np.column_stack([self.t, self.u]).T
        rows = zip(
            *(
                scale.shown(column).tolist()
                for scale, column in zip(scales, columns, strict=True)
            ),
            strict=True,
        )
        lines = [",".join(f"{value:.10g}" for value in row) for row in rows]
        return write_whole(path, "\n".join([",".join(heads), *lines, ""]))

    def __str__(self) -> str:
        return self.sentence

    __repr__ = __str__


def next_experiment(
    fits: Mapping[str, Fit],
    data: Measurements,
    noise: Mapping[str, float],
    limits: Mapping[str, Any] | None = None,
    start: Mapping[str, Any] | None = None,
    sharpen: str | None = None,
    seed: int = 0,
) -> Experiment:
    """Design the experiment that tells two models apart, or the parameters of one.

    Args:
        fits: one or two fits to the data, by names that are told.
        data: the present record; its longest trajectory gives sampling and length.
        noise: standard deviation by measured state.
        limits: lower and upper by input, state, or formula of these (such as "p/m");
            the longest duration as "t". What is not given stays within its range in the
            data. In SI units.
        start: by state a number, or a lower and an upper one to choose from. States
            that are not given start as in the record, or without inputs anywhere within
            their limits.
        sharpen: a parameter of the first model; None: all.
        seed: of the inputs that the search begins with.

    Raises:
        ModelError: limits that contradict each other, or of something unknown.
        SolveError: no experiment that keeps within the limits was found.
    """
    data = counted_once(data, copies_in(data))  # as the fits did
    known = [_FittedModel(fit, data, _longest(data), noise) for fit in fits.values()]
    first = known[0]
    if sharpen is not None:
        require_known(sharpen, first.model.free, f"parameter {sharpen!r} is unknown")
    if len(known) == 1 and not first.model.free:
        raise ModelError(
            "the model has no free parameter that an experiment could tell; free one "
            "with model.with_free, and fit it."
        )
    plan = _plan(first, limits or {}, start or {})
    planned = [one.planned for one in known]
    place = None if sharpen is None else first.model.free.index(sharpen)
    found = sorted(designs(plan, planned, place, seed), key=lambda one: -one.gain)
    for design in found:
        checked = _checked(design, plan, known, tuple(fits), sharpen)
        if checked is not None:
            return checked
    ranges = [
        f"{name} {low:g} to {high:g}" for name, (low, high) in plan.limits.items()
    ]
    raise SolveError(
        f"no experiment keeps within the limits ({', '.join(ranges)}), or none can be "
        "simulated; widen them, or allow a shorter duration with limits={'t': ...}."
    )


def _longest(data: Measurements) -> int:
    return int(np.argmax([run.n_samples for run in data.trajectories]))


def _plan(
    first: "_FittedModel",
    limits: Mapping[str, Any],
    start: Mapping[str, Any],
    most: int = 2000,
) -> Plan:
    """Times, limits and what is free, of at most so many samples.

    Raises:
        ModelError: limits that contradict each other, or of something unknown.
    """
    data, model = first.data, first.model
    run = data.trajectories[first.number]
    gap = float(np.median(np.diff(run.t)))
    duration = limits.get("t", run.t[-1] - run.t[0])
    expected = f"a finite duration above {gap:g} s, the time between two samples"
    is_long = is_of(duration, float) and gap < duration < np.inf
    require(is_long, "limits['t']", duration, expected)
    t = gap * np.arange(min(int(duration / gap + 1e-9) + 1, most))
    known = dict(zip(data.states, data.stacked("x").T, strict=True))
    known |= dict(zip(data.inputs, data.stacked("u").T, strict=True))
    chosen: dict[str, tuple[float, float]] = {}
    for name in (*data.measured, *model.inputs):
        # The motion of the model is not noisy, and may go a little beyond the data.
        own = first.course[:, model.index(name)] if name in model.states else ()
        every = np.append(known[name], own)
        chosen[name] = float(np.nanmin(every)), float(np.nanmax(every))
    for name, given in limits.items():
        if name != "t":
            model.function(name)  # says what is unknown
            chosen[name] = _range(f"limits[{name!r}]", given)
    for name in model.inputs:
        low, high = chosen[name]
        expected = f"limits={{{name!r}: (lower, upper)}}: in the data it is constant"
        require(low < high, name, low, expected)
    for name in start:
        require_known(name, model.states, f"state {name!r} of start is unknown")
    starts = {} if model.inputs else {n: chosen[n] for n in model.states if n in chosen}
    for name, given in start.items():
        is_one = is_of(given, float) and np.isfinite(given)
        starts[name] = (given, given) if is_one else _range(f"start[{name!r}]", given)
    for name, own in zip(model.states, first.x0.tolist(), strict=True):
        low, high = chosen.get(name, (-np.inf, np.inf))
        least, most = starts.get(name, (own, own))
        expected = f"one within the limits of {name}, {low:g} to {high:g}"
        require(least <= high and most >= low, f"start[{name!r}]", least, expected)
    inputs = tuple(model.inputs)
    holds = hold_of_each(data.hold, data.inputs)
    hold = {name: str(holds[data.inputs.index(name)]) for name in inputs}
    return Plan(t, inputs, hold, first.sigma, chosen, starts)


def _range(name: str, given: Any) -> tuple[float, float]:
    is_pair = np.shape(given) == (2,) and all(is_of(one, float) for one in given)
    fine = is_pair and -np.inf < given[0] < given[1] < np.inf
    require(fine, name, given, "a lower and a larger upper number")
    return float(given[0]), float(given[1])


def _checked(
    design: Design,
    plan: Plan,
    known: Sequence["_FittedModel"],
    names: Sequence[str],
    sharpen: str | None,
) -> Experiment | None:
    """A design with what it tells when simulated; None: it cannot be simulated."""
    first = known[0]
    x0 = dict(zip(first.model.states, first.x0.tolist(), strict=True)) | design.start
    log_bayes: dict[str, float] = {}
    std_errors: dict[str, tuple[float, float]] = {}
    if len(known) == 2:
        for name, truth, imitator in zip(names, known, known[::-1], strict=True):
            misfits = []
            for designed in (None, design):
                shown = truth.measurements(designed, plan)
                fit = None if shown is None else imitator.fitted_to(shown)
                if fit is None:
                    return None
                misfits.append(_misfit(fit))
            log_bayes[name] = max(float(misfits[1] - misfits[0]) / 2, 0.0)
    else:
        if first.measurements(design, plan) is None:
            return None
        for name, after in zip(first.model.free, design.std_errors, strict=True):
            if sharpen in (None, name):
                std_errors[name] = first.present[name], float(after)
    data = first.data
    return Experiment(
        plan.t,
        design.u,
        plan.inputs,
        x0,
        design.kind,
        log_bayes,
        std_errors,
        data.hold,
        {**first.fit.parameter_units, **data.units},
    )


def _misfit(fit: Fit) -> float:
    """Squares of residuals over the noise, and of the way to the means of priors."""
    squares = fit.loss_value * fit.n_values
    for name, value in fit.estimates.items():
        prior = fit.entry(name).parameter.prior
        if prior is not None:
            squares += ((value - prior[0]) / prior[1]) ** 2
    return squares


@dataclass(frozen=True, eq=False)
class _FittedModel:
    """A fitted model in one trajectory, a number, of its measurements."""

    fit: Fit
    data: Measurements
    number: int
    noise: Mapping[str, float]

    @property
    def sigma(self) -> dict[str, float]:
        """Noise by measured state."""
        return {name: self.noise[name] for name in self.data.measured}

    @cached_property
    def model(self) -> Model:
        """With the parameters of the trajectory, of which none is its own."""
        own = self.fit.model_of(self.data.trajectories[self.number].name)
        shared = own.with_fixed({name: own.values[name] for name in own.free})
        return shared.with_free(own.free)

    @cached_property
    def courses(self) -> Sequence[np.ndarray]:
        """(n_samples, n_states) its states in each trajectory."""
        runs = self.fit.states
        if len(runs) != self.data.n_trajectories:
            runs = compare(self.fit, self.data).simulated
        return runs

    @property
    def course(self) -> np.ndarray:
        """(n_samples, n_states) its states in the trajectory."""
        return self.courses[self.number]

    @property
    def x0(self) -> np.ndarray:
        """(n_states,) its start there."""
        return np.asarray(self.course[0])

    def _estimate(self, name: str) -> str:
        """What the fit calls a parameter of the trajectory."""
        own = f"{name}[{self.data.trajectories[self.number].name}]"
        return own if own in self.fit.names else name

    @property
    def present(self) -> dict[str, float]:
        """Standard errors of the free parameters, NaN where the record tells none."""
        errors = self.fit.std_errors
        return {n: errors.get(self._estimate(n), np.nan) for n in self.model.free}

    @property
    def planned(self) -> PlannedModel:
        """What a design needs of it."""
        free = self.model.free
        values = np.abs(self.model.theta)
        covariance = np.diag(np.where(values > 0, values, 1.0) ** 2)
        places = [k for k, name in enumerate(free) if np.isfinite(self.present[name])]
        rows = [self.fit.names.index(self._estimate(free[k])) for k in places]
        covariance[np.ix_(places, places)] = self.fit.covariance[np.ix_(rows, rows)]
        # A fit's steps are so fine that their error does not count.
        steps = -(-max((int(np.max(one)) for one in self.fit.steps), default=1) // 4)
        spread = np.std(self.course, axis=0)
        return PlannedModel(self.model, self.x0, covariance, spread, steps)

    def measurements(self, design: Design | None, plan: Plan) -> Measurements | None:
        """Its course in the record and a design, without noise; None: it has none."""
        data = self.data
        # Runs with parameters of their own do not move as this one.
        numbers = (
            [self.number] if self.fit.by_trajectory else range(data.n_trajectories)
        )
        runs = [data.trajectories[number] for number in numbers]
        n = 1000  # samples of each run; more tell almost the same
        times = [run.t[:n] for run in runs]
        inputs = [run.u[:n] for run in runs]
        starts = [self.courses[number][0] for number in numbers]
        if design is not None:
            x0 = self.x0.copy()
            for name, value in design.start.items():
                x0[self.model.index(name)] = value
            columns = list(map(data.inputs.index, plan.inputs))
            u = np.zeros((len(plan.t), len(data.inputs)))
            u[:, columns] = design.u
            times.append(plan.t)
            inputs.append(u)
            starts.append(x0)
        shown = []
        for t, u, x0 in zip(times, inputs, starts, strict=True):
            y = self.shown(t, u, x0)
            if y is None:
                return None
            shown.append(y)
        return Measurements.from_arrays(
            times,
            shown,
            inputs if data.inputs else None,
            states=data.states,
            inputs=data.inputs,
            units=data.units,
            hold=data.hold,
        )

    def shown(self, t: np.ndarray, u: np.ndarray, x0: np.ndarray) -> np.ndarray | None:
        """What sensors show, (n_samples, n_states), NaN where none is."""
        model, data = self.model, self.data
        columns = list(map(data.inputs.index, model.inputs))
        hold = hold_of_each(data.hold, data.inputs)[columns]
        try:
            x = free_run(model, t, x0, u[:, columns], data.hold)
        except SolveError:
            return None
        inputs = SampledInputs.of(model, t, u[:, columns], hold)
        driven = inputs.u[inputs.samples]
        (y,) = in_numbers(model.output(), x.T, driven.T, t[None], model.theta)
        measured = np.full((len(t), len(data.states)), np.nan)
        for name in data.measured:
            measured[:, data.states.index(name)] = y[model.index(name)]
        return measured

    def fitted_to(self, shown: Measurements) -> Fit | None:
        """The model fitted to what another one shows, at known noise, or None."""
        steps = max((int(np.max(one)) for one in self.fit.steps), default=1)
        loss = MaximumLikelihood(noise=self.sigma, steps=steps)
        try:
            return identify(self.model, shown, loss)
        except PhsiOptError:
            return None
