"""The experiments that a record suggests: what could be done otherwise than in it.

Other starts, other inputs, a longer record and further sensors, each of one change and
of a size that the record itself gives. Which of them is worth the effort is judged
elsewhere (`experiment_design`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_rows
from phsi_opt.statistics import TINY

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


@dataclass(frozen=True, eq=False)
class Experiment:
    """One experiment, derived from a record.

    The start of the record becomes centre + stretch (start - centre) + shift, for the
    states that ``centre`` and ``shift`` name.

    Attributes:
        name: in words.
        t: (n_samples,) times.
        u: (n_samples, n_inputs) inputs, in the order of the measurements.
        measured: names of the measured states.
        stretch: factor on the distance of the start from ``centre``.
        centre: by state.
        shift: by state, in its unit.
    """

    name: str
    t: np.ndarray
    u: np.ndarray
    measured: tuple[str, ...]
    stretch: float = 1.0
    centre: Mapping[str, float] = field(default_factory=dict)
    shift: Mapping[str, float] = field(default_factory=dict)

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return len(self.t) * len(self.measured)

    def start(self, model: Model, x0: np.ndarray) -> np.ndarray:
        """A model's starting state (n_states,), from that in the record."""
        moved = x0.copy()
        for name, centre in self.centre.items():
            k = model.index(name)
            moved[k] = centre + self.stretch * (x0[k] - centre)
        for name, shift in self.shift.items():
            moved[model.index(name)] += shift
        return moved


@dataclass(frozen=True, eq=False)
class SimulatedRecord:
    """What experiments are derived from: a record as a fitted model runs along it.

    Attributes:
        experiment: the record itself.
        data: the measurements it is taken from, for names and units.
        model: the fitted model.
        x0: (n_states,) its start in the record.
        shown: (n_samples, n_data_states) what sensors of all states of the measurements
            show.
    """

    experiment: Experiment
    data: Measurements
    model: Model
    x0: np.ndarray
    shown: np.ndarray

    @property
    def mean(self) -> dict[str, float]:
        """By state of the measurements, along the run."""
        means = np.mean(self.shown, axis=0)
        return dict(zip(self.data.states, means.tolist(), strict=True))

    @property
    def spread(self) -> dict[str, float]:
        """Standard deviation by state of the measurements, along the run."""
        deviations = np.std(self.shown, axis=0)
        return dict(zip(self.data.states, deviations.tolist(), strict=True))

    @property
    def sampling_time(self) -> float:
        """The usual one."""
        return float(np.median(np.diff(self.experiment.t)))


def experiments(record: SimulatedRecord) -> Iterator[Experiment]:
    """The experiments that a record suggests, each with one change."""
    yield from _stretched_starts(record)
    yield from _shifted_starts(record)
    yield from _other_inputs(record)
    yield _longer(record)
    yield from _further_sensors(record)


def _stretched_starts(record: SimulatedRecord) -> Iterator[Experiment]:
    mean = record.mean
    spread = record.spread
    distances = []
    for name in record.data.states:
        start = record.x0[record.model.index(name)]
        distances.append(abs(start - mean[name]) / max(spread[name], TINY))
    if max(distances) <= LEAST_START_DISTANCE:
        return
    for stretch in START_STRETCHES:
        name = f"start {stretch:g} times as far out"
        yield replace(record.experiment, name=name, stretch=stretch, centre=mean)


def _shifted_starts(record: SimulatedRecord) -> Iterator[Experiment]:
    """Each position moved; each state where the model has no positions."""
    spread = record.spread
    for row in position_rows(record.model) or range(len(record.data.states)):
        state = record.model.states[row]
        shift = START_SHIFT * spread[state]
        name = f"start with {state} higher by {_with_unit(shift, record.data, state)}"
        yield replace(record.experiment, name=name, shift={state: shift})


def _other_inputs(record: SimulatedRecord) -> Iterator[Experiment]:
    frequency = dominant_frequency(record)
    for column in range(len(record.data.inputs)):
        yield from _other_input(record, column, frequency)


def _other_input(
    record: SimulatedRecord, column: int, frequency: float
) -> Iterator[Experiment]:
    """One input, louder and softer, as sines, and as a sweep of their frequencies."""
    experiment = record.experiment
    values = experiment.u[:, column]
    size = float(np.std(values) or abs(np.mean(values)))
    if size == 0:
        return
    name = record.data.inputs[column]
    for gain in INPUT_GAINS:
        louder = _with_input(experiment, column, gain * values)
        yield replace(louder, name=f"{name} times {gain:g}")
    yield from _waves(record, column, frequency, np.sqrt(2) * size)


def _waves(
    record: SimulatedRecord, column: int, frequency: float, amplitude: float
) -> Iterator[Experiment]:
    """One input as a sine about its mean, and as a sweep."""
    data = record.data
    experiment = record.experiment
    name = data.inputs[column]
    mean = float(np.mean(experiment.u[:, column]))
    since_start = experiment.t - experiment.t[0]
    highest = 1 / SAMPLES_PER_PERIOD / record.sampling_time
    for factor in SINE_FREQUENCIES:
        f = factor * frequency
        if f < highest:
            sine = np.sin(2 * np.pi * f * since_start)
            driven = _with_input(experiment, column, mean + amplitude * sine)
            period = _with_unit(1 / f, data, "t")
            words = f"{name} a sine of period {period} and the same rms"
            yield replace(driven, name=words)

    low = SINE_FREQUENCIES[0] * frequency
    high = SINE_FREQUENCIES[-1] * frequency
    sweep = _sweep(since_start, low, high)
    driven = _with_input(experiment, column, mean + amplitude * sweep)
    shortest = _with_unit(1 / high, data, "t")
    words = f"{name} a sweep of periods {1 / low:.3g} to {shortest} and the same rms"
    yield replace(driven, name=words)


def _sweep(t: np.ndarray, low: float, high: float) -> np.ndarray:
    """A sine whose frequency rises evenly, over times (n_samples,) from zero."""
    rise = (high - low) * t**2 / (2 * t[-1])
    cycles = low * t + rise
    return np.asarray(np.sin(2 * np.pi * cycles))


def _with_input(experiment: Experiment, column: int, values: np.ndarray) -> Experiment:
    u = experiment.u.copy()
    u[:, column] = values
    return replace(experiment, u=u)


def _longer(record: SimulatedRecord) -> Experiment:
    """The inputs of the record, repeated."""
    t = record.experiment.t
    duration = t[-1] - t[0] + record.sampling_time
    times = np.concatenate([t + k * duration for k in range(N_REPEATS)])
    inputs = np.tile(record.experiment.u, (N_REPEATS, 1))
    name = f"a record {N_REPEATS} times as long"
    return replace(record.experiment, name=name, t=times, u=inputs)


def _further_sensors(record: SimulatedRecord) -> Iterator[Experiment]:
    """A sensor of each state that nobody measured and that moves."""
    experiment = record.experiment
    for state, spread in record.spread.items():
        if state not in record.data.measured and spread > 0:
            measured = (*experiment.measured, state)
            name = f"measuring {state} too"
            yield replace(experiment, name=name, measured=measured)


def _with_unit(value: float, data: Measurements, name: str) -> str:
    return f"{value:.3g} {data.units.get(name, '')}".rstrip()


def dominant_frequency(record: SimulatedRecord) -> float:
    """Frequency of most power in the measured states, in periods per unit of time.

    At least one period in the record.
    """
    t = record.experiment.t
    even = np.linspace(t[0], t[-1], len(t))
    power = np.zeros(len(even) // 2 + 1)
    for name in record.data.measured:
        shown = record.shown[:, record.data.states.index(name)]
        y = np.interp(even, t, shown)
        y = (y - y.mean()) / max(float(y.std()), TINY)
        power += np.abs(np.fft.rfft(y * np.hanning(len(y)))) ** 2
    frequencies = np.fft.rfftfreq(len(even), even[1] - even[0])
    strongest = 1 + int(np.argmax(power[1:]))
    return float(frequencies[strongest])
