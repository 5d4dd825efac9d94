"""What measurements show before there is a model: the clock, and every channel.

Nothing is repaired and nothing is decided here. Each remark follows from a principle
that its function states; a reader decides whether it matters.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from operator import attrgetter

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from phsi_opt.data.channel_noise import (
    DEVIATION_PER_STEP,
    resolution,
    robust_deviation,
    scatter_of,
)
from phsi_opt.data.first_guess import FirstGuess, first_guess
from phsi_opt.data.trajectory import Trajectory, is_stepped, run_numbers
from phsi_opt.errors import some_of
from phsi_opt.presentation.numbers import called, number_of
from phsi_opt.presentation.units import date_words, spaced, time_words

REGULAR_STEPS = 0.01  # largest deviation of a step, of a clock that is regular
BEYOND = 5.0  # times by which an outlier is beyond what its surroundings do
MANY = 10  # equal samples that are no chance
NOT_HELD = 'but interpolated: if it is held, give hold="zero"'
MOST_GUESSED = 4  # states, as each takes a tenth of a second or more
LEAST_DAMPED = 2e-4  # damping ratio that is told; the least that is tried is half
NO_SAMPLES = np.array([], dtype=int)


@dataclass(frozen=True, eq=False)
class ChannelLook:
    """One channel; samples are numbered through all trajectories."""

    look: "DataLook"
    name: str
    hold: str  # of an input between samples; "" for a state
    values: np.ndarray  # (n_samples,), NaN where not measured

    @property
    def unit(self) -> str:
        return self.look.units[self.name]

    @property
    def called(self) -> str:
        return called(self.name, self.look.labels)

    @cached_property
    def known(self) -> np.ndarray:
        """The numbers of the samples that were measured."""
        return np.flatnonzero(np.isfinite(self.values))

    @cached_property
    def resolution(self) -> float:
        """The step in which it is quantised; 0 if it is not."""
        return resolution(np.split(self.values, self.look.ends))

    @cached_property
    def scatter(self) -> np.ndarray:
        """Run and residual of samples against their neighbours, see `scatter_of`."""
        return scatter_of(self.look.t, self.values, self.look.run)

    @cached_property
    def noise(self) -> float:
        """Standard deviation by differences of neighbours; it may be unknown, NaN."""
        if self.hold == "zero":  # steps are no noise
            return np.nan
        deviation = robust_deviation(self.scatter[1])
        return max(deviation, DEVIATION_PER_STEP * self.resolution)

    @cached_property
    def outliers(self) -> np.ndarray:
        """Single samples far from both neighbours."""
        if self.hold == "zero":  # a held pulse is meant
            return NO_SAMPLES
        known = self.known
        of_known = (self.look.t[known], self.values[known], self.look.run[known])
        return known[lone_peaks(*of_known, self.noise)]

    @cached_property
    def at_limit(self) -> np.ndarray:
        """Samples that stay at the largest or the smallest value."""
        return NO_SAMPLES if self.hold else samples_at_limit(self.values)


@dataclass(frozen=True, eq=False)
class DataLook:
    """Measurements as they are seen before there is a model.

    The attributes are those of `Measurements`; ``hold`` is that of each input.
    """

    trajectories: tuple[Trajectory, ...]
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    hold: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)

    def _stacked(self, what: str) -> np.ndarray:
        return np.concatenate([getattr(run, what) for run in self.trajectories])

    @cached_property
    def t(self) -> np.ndarray:
        """The times of all trajectories, (n_samples,)."""
        return self._stacked("t")

    @cached_property
    def run(self) -> np.ndarray:
        """The number of the trajectory of each sample, (n_samples,)."""
        return run_numbers(self.trajectories)

    @cached_property
    def ends(self) -> np.ndarray:
        """The numbers of the first samples of all trajectories but the first."""
        return np.flatnonzero(np.diff(self.run)) + 1

    # ---- the clock -------------------------------------------------------------------

    @cached_property
    def steps(self) -> np.ndarray:
        """The time to the next sample, (n_samples,); NaN at the end of a trajectory."""
        is_last = np.append(np.diff(self.run) != 0, True)
        return np.where(is_last, np.nan, np.diff(self.t, append=np.nan))

    @cached_property
    def typical_steps(self) -> np.ndarray:
        """The median step of each trajectory, (n_trajectories,)."""
        return np.array([np.median(np.diff(run.t)) for run in self.trajectories])

    @cached_property
    def relative_steps(self) -> np.ndarray:
        """The steps, (n_samples,), over the median step of their trajectory."""
        return self.steps / self.typical_steps[self.run]

    @cached_property
    def is_long(self) -> np.ndarray:
        """Which steps are longer than 1.5 typical ones, (n_samples,)."""
        return np.asarray(self.relative_steps > 1.5)

    @cached_property
    def is_uneven(self) -> bool:
        """Whether long steps are a tenth of all, or half of the time; none is a gap."""
        time = np.nansum(self.steps[self.is_long]) / np.nansum(self.steps)
        return bool(np.mean(self.is_long) > 0.1 or time > 0.5)

    @cached_property
    def gaps(self) -> np.ndarray:
        """The numbers of the samples before a gap of the clock."""
        if self.is_uneven:
            return NO_SAMPLES
        return np.flatnonzero(self.is_long)

    def clock_words(self) -> str:
        """How regular the samples are, where gaps are, and what is odd in the runs."""
        remarks = map(attrgetter("remark"), self.trajectories)
        of_reader = some_of(list(filter(None, remarks)))
        words = (self._regularity(), of_reader, self._odd_steps(), self._repeated())
        return "; ".join(filter(None, words))

    def _regularity(self) -> str:
        steps = self.steps if self.is_uneven else self.typical_steps
        low = np.nanmin(steps)
        high = np.nanmax(steps)
        is_one = high - low <= REGULAR_STEPS * high
        every = f"every {high:.4g}" if is_one else f"every {low:.4g} to {high:.4g}"
        every += spaced(self.units["t"])
        if self.is_uneven:
            return f"uneven, {every}"
        relative = np.delete(self.relative_steps, self.gaps)
        is_regular = not np.any(np.abs(relative - 1) > REGULAR_STEPS)
        jitter = f"jitter {100 * np.nanstd(relative):.2g} %"
        words = [every, "regular" if is_regular else jitter]
        if len(self.gaps):
            longest = int(self.gaps[np.argmax(self.steps[self.gaps])])
            size = time_words(self.steps[longest], self.units["t"])
            of = "of" if len(self.gaps) == 1 else "up to"
            place = self.place_words(longest)
            words.append(f"{number_of(len(self.gaps), 'gap')} {of} {size}, {place}")
        n_breaks = sum(len(breaks_of(run)) for run in self.trajectories)
        if n_breaks:
            words.append(f"an input changes in {n_breaks}: the states begin anew there")
        return ", ".join(words)

    def _odd_steps(self) -> str:
        """A run whose steps are a power of ten of the others', as in another unit."""
        typical = self.typical_steps
        powers = np.log10(typical / np.sort(typical)[len(typical) // 2])
        is_whole = np.abs(powers - np.round(powers)) < np.log10(1 + REGULAR_STEPS)
        for number in np.flatnonzero(is_whole & (np.round(powers) != 0))[:1]:
            run = self.trajectories[number].title
            factor = f"{10 ** powers[number]:.4g} times those of others"
            return f"the steps of {run} are {factor}: in another unit?"
        return ""

    def _repeated(self) -> str:
        """Samples that repeat the one before in all channels, though one has noise.

        By chance as many would be like the last but one. Many in a row are rest, or a
        sensor that is stuck, which is told of the channel.
        """
        measured = [one for one in self.channels if len(one.known)]
        has_noise = any(not one.resolution and one.noise > 0 for one in measured)
        y = np.array(list(map(attrgetter("values"), measured)))
        repeats = np.all(list(map(self._repeats, y)), axis=0)
        begins, lengths = _stretches(repeats)
        is_short = (lengths > 1) & (lengths < MANY)
        n = int(np.sum(lengths[is_short] - 1))
        by_chance = np.sum(np.all(y[:, 2:] == y[:, :-2], axis=0) & ~repeats[2:])
        if not has_noise or not max(MANY, BEYOND * by_chance) <= n < len(repeats) / 2:
            return ""
        place = self.place_words(begins[is_short][0] + 1)
        samples = number_of(n, "sample")
        return f"{samples} like the one before in all channels, the first {place}"

    def place_words(self, sample: int) -> str:
        """When a sample was taken, such as "at t = 3 s in run 2"."""
        run = self.trajectories[self.run[sample]]
        t = float(self.t[sample])
        moment = date_words(t, run.origin) or f"t = {t:.5g}{spaced(self.units['t'])}"
        is_alone = len(self.trajectories) == 1
        return f"at {moment}" if is_alone else f"at {moment} in {run.title}"

    # ---- the channels ----------------------------------------------------------------

    @cached_property
    def channels(self) -> tuple[ChannelLook, ...]:
        """The states and then the inputs, in their order."""
        values = (*self._stacked("x").T, *self._stacked("u").T)
        holds = ("",) * len(self.states) + self.hold
        look = partial(ChannelLook, self)
        return tuple(map(look, self.states + self.inputs, holds, values))

    @property
    def state_looks(self) -> tuple[ChannelLook, ...]:
        return self.channels[: len(self.states)]

    @cached_property
    def spoilt_words(self) -> tuple[str, ...]:
        """What is noticed of samples that may be spoilt, a phrase for each state."""
        words = []
        for one in self.state_looks:
            phrases = "; ".join(self.errors(one))
            if phrases and np.nanstd(one.values) > 0:
                words.append(f"{one.called}: {phrases}")
        return tuple(words)

    def remarks(self, one: ChannelLook) -> Iterator[str]:
        """What is noticed of a channel, a phrase each."""
        values = one.values[one.known]
        n_samples = len(one.values)
        if not len(values):
            yield "not measured"
            return
        if len(values) < n_samples:
            yield f"{n_samples - len(values)} of {n_samples} missing"
        yield from self._fill_values(one)
        if len(values) > 1 and np.ptp(values) == 0:
            yield "does not change"
            return
        yield from self.errors(one)
        if not one.hold and np.ptp(values) < MANY * one.resolution:
            yield "moves by few steps of its resolution"
        if not one.hold and one.noise > np.std(values) / 2:
            yield "changes mostly between neighbours: noise, or sampled too slowly"
        elif not one.hold:
            yield from self._trend(one)
        if one.hold == "cubic":  # as somebody said, or as a filter leaves it
            return
        if one.hold and is_stepped(np.split(one.values, self.ends)):
            is_held = one.hold == "zero"
            yield f"constant between jumps, {'held' if is_held else NOT_HELD}"
        elif one.hold and not one.resolution:
            yield from self._stays(one.values)

    def _trend(self, one: ChannelLook) -> Iterator[str]:
        """A line under the oscillation of each run, as a sensor that drifts adds it.

        A line that a motion without oscillation follows is no such trend.
        """
        rises = []
        for number, run in enumerate(self.trajectories):
            is_own = np.isfinite(one.values) & (self.run == number)
            t, y = self.t[is_own], one.values[is_own]
            slope, deviation = trend_of(t, y)
            rise = slope * np.ptp(run.t)
            is_sure = np.abs(slope) > BEYOND * deviation
            if not is_sure or np.abs(rise) < np.std(y - slope * t) / 4:
                return
            rises.append(rise)
        if np.abs(np.sum(np.sign(rises))) == len(rises):
            word = "rises" if rises[0] > 0 else "falls"
            size = f"{np.abs(np.median(rises)):.2g}{spaced(one.unit)}"
            yield f"trend: its mean {word} by {size} in a run"

    def guess(self, one: ChannelLook) -> FirstGuess | None:
        """What the state responds like, in the longest run that has all of it."""
        place = self.states.index(one.name)
        if place >= MOST_GUESSED or len(one.at_limit):
            return None
        for run in sorted(self.trajectories, key=lambda run: -run.n_samples):
            if np.isfinite(run.x[:, place]).all():
                is_held = np.array(self.hold) == "zero"
                return first_guess(run.t, run.x[:, place], run.u, is_held)
        return None

    def guess_words(self, one: ChannelLook) -> str:
        """The simplest linear system that a state responds like; "" for none."""
        found = self.guess(one) if not one.hold and len(one.known) else None
        if found is None:
            return ""
        time = self.units["t"]
        inputs = list(map(partial(called, labels=self.labels), self.inputs))
        source = some_of(inputs) if len(inputs) < 3 else "the inputs"
        if found.frequency > 0:
            period = time_words(1 / found.frequency, time)
            words = f"oscillates with a natural period of {period}"
            if found.damping > LEAST_DAMPED:
                words += f", damping ratio {found.damping:.2g}"
        else:
            follows = "its rate follows" if found.integrates else "follows"
            lag = f"with a lag of {time_words(found.lag, time)}"
            words = f"{follows} {source} {lag if found.lag else 'without a lag'}"
        if found.dead_time:
            words += f", dead time {time_words(found.dead_time, time)}"
        return f"{words}; explains {100 * found.explained:.3g} %"

    def errors(self, one: ChannelLook) -> Iterator[str]:
        """What a sensor or a logger may have spoilt, a phrase each."""
        values = one.values[one.known]
        if len(one.outliers):
            name = number_of(len(one.outliers), "peak" if one.hold else "outlier")
            first = "" if len(one.outliers) == 1 else "the first "
            kick = ": errors, or kicks of a controller" if one.hold else ""
            place = self.place_words(one.outliers[0])
            yield f"{name} of one sample, {first}{place}{kick}"
        for limit in np.unique(one.values[one.at_limit]):
            side = "highest" if limit == values.max() else "lowest"
            percent = 100 * np.mean(values == limit)
            yield f"at its {side} value in {percent:.2g} % of the samples"
        if not one.hold and not one.resolution:
            yield from self._stays(one.values)

    def _fill_values(self, one: ChannelLook) -> Iterator[str]:
        """Values that may stand for missing ones, such as -9999.

        They are five times as far from all others as these are from one another.
        """
        different = np.unique(one.values[one.known])
        for value in different[[0, -1]] if len(different) > 2 * MANY else ():
            others = different[different != value]
            places = np.flatnonzero(one.values == value)
            is_far = np.abs(others - value).min() > BEYOND * np.ptp(others)
            if is_far and not np.isin(places, one.outliers).all():
                n = number_of(len(places), "sample")
                place = self.place_words(places[0])
                yield f"{value:g} in {n}, far from all others, first {place}: missing?"

    def spoilt(self, one: ChannelLook) -> np.ndarray:
        """Which samples a sensor or a logger may have spoilt, (n_samples,)."""
        spoilt = np.zeros(len(one.values), bool)
        if not one.resolution:
            repeats = self._repeats(one.values)
            spoilt |= repeats & (np.sum(repeats) >= MANY)
        spoilt[one.outliers] = spoilt[one.at_limit] = True
        return spoilt

    def _repeats(self, values: np.ndarray) -> np.ndarray:
        """Which samples only repeat the one before in their run, (n_samples,)."""
        is_same = np.diff(values, prepend=np.nan) == 0
        is_same[1:] &= np.isfinite(self.steps[:-1])
        return is_same

    def _stays(self, values: np.ndarray) -> Iterator[str]:
        """Whether a channel keeps its values, or stops once, as a stuck sensor does."""
        repeats = self._repeats(values)
        begins, lengths = _stretches(repeats)
        length = lengths.max()
        begin = begins[np.argmax(lengths)]
        if np.mean(repeats) > 0.5:
            yield f"a new value every {np.mean(lengths):.3g} samples"
        elif length >= MANY:
            place = self.place_words(begin)
            yield f"stays at {values[begin]:.4g} for {length} samples, {place}"
        elif np.sum(repeats) >= MANY:
            percent = 100 * np.mean(repeats)
            yield f"repeats its previous value in {percent:.2g} % of the samples"

    @cached_property
    def rows(self) -> tuple[dict[str, object], ...]:
        """`_rows`, worked out once."""
        return tuple(self._rows())

    def _rows(self) -> Iterator[dict[str, object]]:
        """A row for the clock, and one for each channel; NaN for what is not known."""
        told = ("channel", "part", "unit", "lowest", "highest", "resolution", "noise")
        ends = (self.t.min(), self.t.max())
        clock = ("t", "time", self.units["t"], *ends, np.nan, np.nan)
        words = {"noticed": self.clock_words(), "guess": ""}
        yield dict(zip(told, clock, strict=True)) | words
        for one in self.channels:
            ends = (np.fmin.reduce(one.values), np.fmax.reduce(one.values))
            part = "input" if one.hold else "state"
            sizes = (*ends, one.resolution or np.nan, one.noise)
            row = dict(zip(told, (one.name, part, one.unit, *sizes), strict=True))
            words = {"noticed": "; ".join(self.remarks(one))}
            yield row | words | {"guess": self.guess_words(one)}


def trend_of(t: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of the line that a signal (n,) follows, and its standard deviation.

    Where it oscillates, the line goes through the means of whole periods, which begin
    where it rises through the line. Else it is that of least squares, whose deviation
    is not known: infinite.
    """
    if len(t) < 2:
        return 0.0, np.inf
    slope, offset = np.polyfit(t - t[0], y, 1)
    about = y - offset - slope * (t - t[0])
    far = np.flatnonzero(np.abs(about) > np.std(about) / 2)  # noise is nearer
    begins = far[1:][np.diff(np.sign(about[far])) > 0]
    if len(begins) <= MANY:
        return float(slope), np.inf
    lengths = np.diff(begins)
    y_means = np.add.reduceat(y[: begins[-1]], begins[:-1]) / lengths
    t_means = np.add.reduceat(t[: begins[-1]], begins[:-1]) / lengths
    line, spread = np.polyfit(t_means - t[0], y_means, 1, cov=True)
    return float(line[0]), float(np.sqrt(spread[0, 0]))


def breaks_of(run: Trajectory) -> np.ndarray:
    """The numbers of the samples before gaps in which an input is unknown.

    It is known if it is the same after the gap, or if interpolation over as many steps
    elsewhere in the run misses less than 3 % of its variance, as of a smooth input and
    as `is_stepped` leaves to noise. The
    states of a model begin anew after the gap, and need some samples on both sides.
    """
    if not run.u.shape[1]:
        return NO_SAMPLES
    look = DataLook((run,))
    missed = cache(partial(_missed_share, look))
    breaks = [-1]
    for k in look.gaps:
        if min(k - breaks[-1], run.n_samples - 1 - k) >= MANY:
            places = np.flatnonzero(run.u[k] != run.u[k + 1])
            n_steps = round(look.relative_steps[k])
            if any(missed(int(i), n_steps) > 0.03 for i in places):
                breaks.append(int(k))
    return np.array(breaks[1:], dtype=int)


def _missed_share(look: DataLook, place: int, n_steps: int) -> float:
    """Share of an input's variance that interpolation over so many steps misses.

    In the middle, where the input changes and there is no gap; one if that is nowhere.
    """
    u = look.trajectories[0].u[:, place]
    n_gaps = np.cumsum(look.is_long)
    is_known = (u[:-n_steps] != u[n_steps:]) & (n_gaps[:-n_steps] == n_gaps[n_steps:])
    first = np.flatnonzero(is_known)
    if not len(first):
        return 1.0
    half = n_steps // 2
    between = u[first] + half / n_steps * (u[first + n_steps] - u[first])
    return float(np.mean((u[first + half] - between) ** 2) / np.var(u))


def _stretches(repeats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where stretches of samples that repeat the one before begin; their lengths."""
    begins = np.flatnonzero(~repeats)
    return begins, np.diff(begins, append=len(repeats))


def lone_peaks(
    t: np.ndarray, y: np.ndarray, run: np.ndarray, noise: float, n_around: int = 5
) -> np.ndarray:
    """The numbers of single samples that are far from both of their neighbours.

    The deviation of a sample from the line through its neighbours, at even steps::

        d_i = y_i - (y_(i-1) + y_(i+1)) / 2

    An error of a single sample of the size a makes it a there and -a/2 beside it; a
    step of the signal, or a corner, does not. The sample is an outlier if its deviation
    has this pattern and is five times as large as all others within five samples, and
    as their standard deviation by noise (NaN: not known).
    """
    if len(y) < 3:
        return NO_SAMPLES
    with np.errstate(all="ignore"):  # where two runs meet
        share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
        between = (1 - share) * y[:-2] + share * y[2:]
    away = np.where(run[2:] == run[:-2], y[1:-1] - between, 0.0)
    # zero where a sample has no two neighbours
    around = sliding_window_view(np.pad(away, n_around + 1), 2 * n_around + 1)
    middle = np.s_[n_around - 1 : n_around + 2]
    near = around[:, middle]
    size = np.abs(near[:, 1])
    beside = near[:, ::2] / np.where(size > 0, near[:, 1], 1.0)[:, None]
    far = np.delete(around, middle, axis=1)
    by_noise = np.sqrt(1.5) * np.nan_to_num(noise)
    is_peak = size > BEYOND * np.maximum(by_noise, np.abs(far).max(axis=1))
    has_pattern = np.all((beside < -0.25) & (beside > -0.75), axis=1)
    return np.flatnonzero(is_peak & has_pattern)


def samples_at_limit(values: np.ndarray) -> np.ndarray:
    """The numbers of samples at a limit of a sensor: many exactly at an extreme.

    There are ten or more, and five times as many as at the value next to it; a smooth
    extreme of a quantised signal has at most about 2.4 times as many.
    """
    different, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    is_limit = np.zeros(len(values), bool)
    if len(different) > 2 * MANY:
        for end, beside in ((0, 1), (-1, -2)):
            if counts[end] >= max(MANY, BEYOND * counts[beside]):
                is_limit |= values == different[end]
    return np.flatnonzero(is_limit)
