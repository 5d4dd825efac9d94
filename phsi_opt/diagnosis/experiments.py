"""Which experiment would tell two fitted models apart that the record does not.

The first model is taken for the truth. It is simulated in experiments that the record
suggests: other starts, other inputs, a longer record and further sensors, each of one
change and of a size that the record itself gives; inputs are not optimised. The second
model imitates it as well as it can: it is fitted to the simulated record and the
experiment together. Its residual, over the noise, is the separation: a difference that
re-fitting removes does not count. Where the second model imitates the first everywhere
(it may contain it), the two change places.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.comparison.compare import compare
from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import PhsiOptError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.force_analysis.waves import spectrum
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_rows
from phsi_opt.optimization.column_function import in_numbers
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.units import scale_of, spaced
from phsi_opt.simulation.simulate import SampledInputs, free_run
from phsi_opt.statistics import TINY
from phsi_opt.transcription.losses import MaximumLikelihood

if TYPE_CHECKING:
    import pandas as pd

# Standard deviations of the whole experiment from which two models count as told apart.
SEPARATED_MODELS = 5.0
# Standard deviations per value below which two predictions are the same.
SAME_PREDICTION = 1e-3
MOST_SAMPLES = 1000  # of the record that are looked at

# Starts, in distances of the record's start from its mean.
START_STRETCHES = (0.25, 0.5, 2.0, 3.0)
# Distance from the mean, in standard deviations of a state, up to which a start cannot
# be put further out.
LEAST_START_DISTANCE = 0.05
START_SHIFT = 2.0  # of one position, in its standard deviations
INPUT_GAINS = (0.5, 2.0, 3.0)  # inputs, in those of the record
SINE_FREQUENCIES = (0.3, 1.0, 3.0)  # in dominant frequencies of the record
# Samples in a period of a sine, at least: with two it is not seen.
SAMPLES_PER_PERIOD = 4
N_REPEATS = 3  # of the record's inputs, in a longer record

# Steps of an imitation, in those of the fit, whose errors are a tenth of the noise: of
# order four, they are then far below what an experiment could show.
FINER_STEPS = 4


@dataclass(frozen=True, eq=False)
class Separation:
    """The experiments that were tried, best first.

    Attributes:
        table: a row per experiment. Columns: experiment (in words), separation (root
            mean square of the residual after re-fitting, in standard deviations of the
            noise, per value measured), separates (whether the models count as told
            apart).
        in_record: the separation in the record itself.
        alike: whether the two predict the same in every experiment.
    """

    table: "pd.DataFrame"
    in_record: float
    alike: bool

    @property
    def sentence(self) -> str:
        """The best experiment in words."""
        if self.table.empty:
            return "no experiment could be simulated with both models"
        none = "none of the simulated experiments distinguishes them"
        if self.alike:
            return f"{none}: the two models are equivalent"
        best = self.table.iloc[0]
        size = f"{best['separation']:.2g} noise standard deviations"
        if not best["separates"]:
            return f"{none}; the best is {best['experiment']}, by {size}"
        return (
            f"{best['experiment']}: the two predictions then differ by {size}; "
            f"in this record by {self.in_record:.2g}."
        )

    def __str__(self) -> str:
        return f"{self.sentence}\n{self.table}"

    __repr__ = __str__


def separating(
    first: Fit, second: Fit, data: Measurements, noise: np.ndarray
) -> Separation:
    """Look for an experiment that tells one fitted model from another.

    The first fit is taken for the truth. The experiments, best first, are derived from
    the longest trajectory of the data that both were fitted to.

    Raises:
        SolveError: the record itself cannot be simulated with both models.
    """
    number = int(np.argmax([run.n_samples for run in data.trajectories]))
    # A model with memory has more states than its noise names.
    by_state = dict(zip(first.model.states, noise.tolist(), strict=False))
    one = _FittedModel(first, data, number)
    other = _FittedModel(second, data, number)
    found = _separation(one, other, by_state)
    return _separation(other, one, by_state) if found.alike else found


def _separation(
    truth: "_FittedModel", imitator: "_FittedModel", noise: Mapping[str, float]
) -> Separation:
    """How well every experiment tells the imitator from the truth."""
    data, spread, record = truth.data, truth.spread, truth.record
    sigma = {name: noise[name] for name in data.measured}
    # A further sensor would have the same share of the spread as those there are.
    shares = [sigma[name] / max(spread[name], TINY) for name in sigma]
    for name in data.states:
        if spread[name] > 0:
            sigma.setdefault(name, float(np.mean(shares)) * spread[name])

    def misfit(experiments: Sequence[Experiment]) -> float | None:
        measured = truth.measurements(experiments)
        return None if measured is None else imitator.misfit(measured, sigma)

    in_record = misfit([record])
    if in_record is None:
        raise imitator.not_simulated()
    rows = []
    for experiment in experiments(truth):
        in_both = misfit([record, experiment])
        if in_both is not None:
            added = max(in_both - in_record, 0.0)
            size = np.sqrt(added / experiment.n_values)
            rows.append((experiment.name, size, bool(added >= SEPARATED_MODELS**2)))
    table = printed_table(rows, columns=["experiment", "separation", "separates"])
    table = table.sort_values(
        "separation", ascending=False, kind="stable", ignore_index=True
    )
    alike = bool((table["separation"] < SAME_PREDICTION).all())
    return Separation(table, float(np.sqrt(in_record / record.n_values)), alike)


# ---- experiments ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Experiment:
    """An experiment with times and inputs (n_samples, n_inputs), in words."""

    name: str
    t: np.ndarray
    u: np.ndarray
    measured: tuple[str, ...]
    x0: np.ndarray  # (n_states,) of the model that is simulated

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return len(self.t) * len(self.measured)


def experiments(truth: "_FittedModel") -> Iterator[Experiment]:
    """The experiments that a record suggests, each with one change."""
    itself = truth.record
    yield from _other_starts(truth)
    frequency = dominant_frequency(truth)
    for column in range(len(truth.data.inputs)):
        yield from _other_inputs(truth, column, frequency)
    t = itself.t
    duration = t[-1] - t[0] + np.median(np.diff(t))
    times = np.concatenate([t + k * duration for k in range(N_REPEATS)])
    inputs = np.tile(itself.u, (N_REPEATS, 1))
    name = f"a record {N_REPEATS} times as long"
    yield replace(itself, name=name, t=times, u=inputs)
    for state, spread in truth.spread.items():
        if state not in truth.data.measured and spread > 0:
            measured = (*itself.measured, state)
            yield replace(itself, name=f"{state} measured, too", measured=measured)


def _other_starts(truth: "_FittedModel") -> Iterator[Experiment]:
    """Further out from the mean; each position moved, or each state without any."""
    itself = truth.record
    model = truth.model
    x0 = itself.x0
    spread = truth.spread
    places = list(map(model.index, truth.data.states))
    mean = np.mean(truth.course, axis=0)
    distance = np.abs(x0[places] - mean) / np.maximum(list(spread.values()), TINY)
    if np.max(distance) > LEAST_START_DISTANCE:
        for stretch in START_STRETCHES:
            moved = x0.copy()
            moved[places] = mean + stretch * (x0[places] - mean)
            yield replace(
                itself,
                name=f"initial states {stretch:g} times as far from the mean",
                x0=moved,
            )
    for row in position_rows(model) or range(len(places)):
        state = model.states[row]
        shift = START_SHIFT * spread[state]
        moved = x0.copy()
        moved[row] += shift
        name = f"initial {state} higher by {truth.words(shift, state)}"
        yield replace(itself, name=name, x0=moved)


def _other_inputs(
    truth: "_FittedModel", column: int, frequency: float
) -> Iterator[Experiment]:
    """One input, louder and softer, as sines, and as a sweep of their frequencies."""
    itself = truth.record
    name = truth.data.inputs[column]
    values = itself.u[:, column]
    size = float(np.std(values) or abs(np.mean(values)))
    if size == 0:
        return
    changes = {f"multiplied by {gain:g}": gain * values for gain in INPUT_GAINS}
    mean = float(np.mean(values))
    amplitude = np.sqrt(2) * size
    t = itself.t - itself.t[0]
    highest = 1 / SAMPLES_PER_PERIOD / float(np.median(np.diff(itself.t)))
    for factor in SINE_FREQUENCIES:
        f = factor * frequency
        if f < highest:
            period = truth.words(1 / f, "t")
            sine = np.sin(2 * np.pi * f * t)
            words = f"as a sine of period {period} with the same rms"
            changes[words] = mean + amplitude * sine
    low = SINE_FREQUENCIES[0] * frequency
    high = SINE_FREQUENCIES[-1] * frequency
    rise = (high - low) * t**2 / (2 * t[-1])
    sweep = np.sin(2 * np.pi * (low * t + rise))
    periods = f"{truth.words(1 / low, 't')} to {truth.words(1 / high, 't')}"
    words = f"as a sweep of periods {periods} with the same rms"
    changes[words] = mean + amplitude * sweep
    for words, changed in changes.items():
        u = itself.u.copy()
        u[:, column] = changed
        yield replace(itself, name=f"{name} {words}", u=u)


def dominant_frequency(truth: "_FittedModel") -> float:
    """Frequency of most power in the measured states, in periods per unit of time."""
    t = truth.record.t
    columns = list(map(truth.data.states.index, truth.data.measured))
    y = truth.course[:, columns]
    y = (y - y.mean(axis=0)) / np.maximum(y.std(axis=0), TINY)
    found = spectrum(t, np.zeros(len(t), dtype=int), y)
    return float(found.frequencies[np.argmax(np.sum(found.amplitudes**2, axis=1))])


# ---- imitation -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _FittedModel:
    """A fitted model in one trajectory, a number, of its measurements."""

    fit: Fit
    data: Measurements
    number: int

    @cached_property
    def model(self) -> Model:
        """With the parameters of the trajectory, of which none is its own."""
        own = self.fit.model_of(self.data.trajectories[self.number].name)
        shared = own.with_fixed({name: own.values[name] for name in own.free})
        return shared.with_free(own.free)

    @cached_property
    def x0(self) -> np.ndarray:
        """(n_states,) its start there."""
        runs = self.fit.states
        if len(runs) != self.data.n_trajectories:
            runs = compare(self.fit, self.data).simulated
        return np.asarray(runs[self.number][0])

    @cached_property
    def record(self) -> Experiment:
        """Its trajectory, as it was."""
        run = self.data.trajectories[self.number]
        t, u = run.t[:MOST_SAMPLES], run.u[:MOST_SAMPLES]
        return Experiment("the record", t, u, self.data.measured, self.x0)

    @cached_property
    def course(self) -> np.ndarray:
        """What sensors of all states show along the record, (n_samples, n_states)."""
        shown = self.shown(self.record, self.data.states)
        if shown is None:
            raise self.not_simulated()
        return shown

    @cached_property
    def spread(self) -> dict[str, float]:
        """Standard deviation by state of the measurements, along the record."""
        deviations = np.std(self.course, axis=0).tolist()
        return dict(zip(self.data.states, deviations, strict=True))

    def not_simulated(self) -> SolveError:
        """Why its record cannot be compared with experiments."""
        name = self.data.trajectories[self.number].name
        return SolveError(
            f"trajectory {name!r} cannot be simulated with the model that has the "
            f"parameters {', '.join(self.model.free)}: it may be stiff, or its "
            "solution may diverge. Compare experiments with `simulate` instead."
        )

    def words(self, value: float, name: str) -> str:
        """A value with the unit of a state, an input or the time."""
        scale = scale_of(self.data.units.get(name, ""))
        return f"{value / scale.size:.3g}{spaced(scale.unit)}"

    def shown(self, experiment: Experiment, names: Sequence[str]) -> np.ndarray | None:
        """What sensors show, (n_samples, n_names); None: it cannot be simulated."""
        model = self.model
        columns = list(map(self.data.inputs.index, model.inputs))
        hold = hold_of_each(self.data.hold, self.data.inputs)[columns]
        u = experiment.u[:, columns]
        try:
            x = free_run(model, experiment.t, experiment.x0, u, self.data.hold)
        except SolveError:
            return None
        inputs = SampledInputs.of(model, experiment.t, u, hold)
        u = inputs.u[inputs.samples]
        (y,) = in_numbers(model.output(), x.T, u.T, experiment.t[None], model.theta)
        return y[list(map(model.index, names))].T

    def measurements(self, experiments: Sequence[Experiment]) -> Measurements | None:
        """The model's course without noise; None: it cannot be simulated."""
        data = self.data
        runs = []
        for experiment in experiments:
            shown = self.shown(experiment, experiment.measured)
            if shown is None:
                return None
            x = np.full((len(shown), len(data.states)), np.nan)
            x[:, list(map(data.states.index, experiment.measured))] = shown
            runs.append(x)
        return Measurements.from_arrays(
            [experiment.t for experiment in experiments],
            runs,
            [experiment.u for experiment in experiments] if data.inputs else None,
            states=data.states,
            inputs=data.inputs,
            units=data.units,
            hold=data.hold,
        )

    def misfit(self, shown: Measurements, noise: Mapping[str, float]) -> float | None:
        """Squared residuals of the best imitation in noise variances, or None."""
        # Each run of what is imitated has a start of its own; the noise is by state.
        most = max((int(np.max(steps)) for steps in self.fit.steps), default=1)
        known = {name: noise[name] for name in shown.measured}
        loss = MaximumLikelihood(noise=known, steps=FINER_STEPS * most)
        try:
            found = identify(self.model, shown, loss)
        except PhsiOptError:
            return None
        return float(found.loss_value * found.n_values)
