"""What the page shows of a study: plain records that travel between processes.

Made in the worker from a study; the views draw them and ask nothing else.
"""

import datetime as dt
from dataclasses import dataclass

import numpy as np

from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.durations import date_words, scale_of_time
from phsi_opt.presentation.numbers import number, with_error
from phsi_opt.presentation.report_content import Answer

TRAINING = "training"
HELD_OUT = "held out"
# Standard deviations beyond which the missing force counts as sure, at one time.
SURE = 2.0


@dataclass(frozen=True)
class ErrorStep:
    """One step of the staircase: errors of the free run, in the study's unit.

    ``held_out`` is None where nothing is held out.
    """

    number: int
    label: str
    train: float
    held_out: float | None
    floor: float

    @property
    def judged(self) -> float:
        """The error on data held out, or else on the training data."""
        return self.train if self.held_out is None else self.held_out


@dataclass(frozen=True, eq=False)
class ChannelCurves:
    """One measured channel of a run.

    Attributes:
        name: of the state.
        unit: its unit, or "".
        measured: (n_samples,), NaN where missing.
        shown: (n_samples,) by the sensor in the free run.
        noise: standard deviation of the measurements.
    """

    name: str
    unit: str
    measured: np.ndarray
    shown: np.ndarray
    noise: float

    @property
    def residual(self) -> np.ndarray:
        """Measured less shown, (n_samples,)."""
        return self.measured - self.shown

    @property
    def share_off(self) -> float:
        """Root mean square of the residual over the standard deviation measured."""
        movement = float(np.nanstd(self.measured))
        off = float(np.sqrt(np.nanmean(self.residual**2)))
        return off / movement if movement > 0 else 0.0


@dataclass(frozen=True, eq=False)
class RunCurves:
    """One run with all its channels.

    Attributes:
        name: of the run.
        part: ``TRAINING`` or ``HELD_OUT``.
        t: (n_samples,) times.
        channels: those that were measured.
        origin: the moment at which the time is 0; None where times are no dates.
    """

    name: str
    part: str
    t: np.ndarray
    channels: tuple[ChannelCurves, ...]
    origin: dt.datetime | None = None

    @property
    def title(self) -> str:
        """Such as 'run 3, held out'."""
        return f"{self.name}, {self.part}"

    def holds(self, t: float) -> bool:
        """Whether a time lies within the record."""
        return bool(self.t[0] <= t <= self.t[-1])

    @property
    def misfit(self) -> float:
        """Mean squared residual in variances of the noise, of the worst channel."""
        worst = 0.0
        for channel in self.channels:
            scaled = channel.residual / channel.noise
            if np.isfinite(scaled).any():
                worst = max(worst, float(np.nanmean(scaled**2)))
        return worst


@dataclass(frozen=True, eq=False)
class ForceCurve:
    """The missing force of one equation along one run.

    Attributes:
        run: its name.
        part: ``TRAINING`` or ``HELD_OUT``.
        equation: the state whose rate lacks the force.
        unit: of the force, or "".
        t: (n_intervals,) middles of the intervals.
        force: (n_intervals,).
        std: (n_intervals,) its standard deviation.
        origin: the moment at which the time is 0; None where times are no dates.
    """

    run: str
    part: str
    equation: str
    unit: str
    t: np.ndarray
    force: np.ndarray
    std: np.ndarray
    origin: dt.datetime | None = None


@dataclass(frozen=True)
class CandidateRow:
    """One candidate of the ranking.

    Attributes:
        effect: such as "coulomb friction on p".
        evidence: how clearly it is there, such as "decisive, log evidence 95".
        coefficient: its size.
        std_error: of the coefficient.
        unit: of both; "" where it is not known.
        train: the training error that it would leave.
        held_out: the error on data held out that it would leave; NaN: not known.
        confusable_with: effects that the data cannot tell from it.
        lost: why it is not named; "" where nothing speaks against it.
        is_proposed: whether the diagnosis proposes it.
    """

    effect: str
    evidence: str
    coefficient: float
    std_error: float
    unit: str
    train: float
    held_out: float
    confusable_with: tuple[str, ...]
    lost: str
    is_proposed: bool

    @property
    def size(self) -> str:
        """The coefficient with its standard error; "" where it has none."""
        if not np.isfinite(self.coefficient) or not np.isfinite(self.std_error):
            return ""  # it ended at a bound
        return f"{with_error(self.coefficient, self.std_error)}{spaced(self.unit)}"


@dataclass(frozen=True)
class Diagnosed:
    """What the diagnosis of the present model said.

    Attributes:
        verdict: in one phrase.
        reason: in a sentence.
        is_missing: whether something is missing.
        is_named: whether what is missing has a name, at least partly.
        certainty: how sure that is, in one line.
        beside: what stands beside the verdict; "" for nothing.
        sentences: where it fails, an equation each.
        equation: the one whose missing force is the surest; "" where none is.
        run: that of the training data in which this force is strongest; "" likewise.
        window: of this run, from when to when it is strongest; None: at no time.
        missing: what is missing, in a sentence or two.
        wrong: what is wrong.
        where: the place where the missing force is strongest.
        since: the time from which it is sure, in words.
        to_do: what to do where nothing is named.
        proposed: the effect to add next; "" for none.
        nearest: the effect that comes nearest where none is named; "" for none.
        averaged: how many samples to average, where a force shakes; 0 where none does.
        candidates: best first.
    """

    verdict: str
    reason: str
    is_missing: bool
    is_named: bool
    certainty: str
    beside: str
    sentences: tuple[str, ...]
    equation: str
    run: str
    window: tuple[float, float] | None
    missing: str
    wrong: Answer
    where: Answer
    since: Answer
    to_do: Answer
    proposed: str
    nearest: str
    averaged: int
    candidates: tuple[CandidateRow, ...]


@dataclass(frozen=True)
class ParameterRow:
    """One parameter of the present model."""

    name: str
    value: float
    std_error: float
    unit: str


@dataclass(frozen=True)
class Snapshot:
    """A study as it stands.

    Attributes:
        unit: of the errors.
        t_unit: of the times.
        steps: the base model first.
        added: the effects that the present model has beyond the base model.
        equations: of the present model.
        parameters: of the present model.
        warning: what to do where the free run is flat; "" where it is not.
        caution: which parameters the data leave open; "" for none.
        runs: the free run beside the measurements, training and held out.
        forces: the missing force of each equation and run.
        diagnosed: None before the present model was diagnosed.
        stopped: why the automatic study stopped; "" where it did not run.
        unestablished: which of the effects added no diagnosis established, in words;
            "" for none.
    """

    unit: str
    t_unit: str
    steps: tuple[ErrorStep, ...]
    added: tuple[str, ...]
    equations: tuple[str, ...]
    parameters: tuple[ParameterRow, ...]
    warning: str
    caution: str
    runs: tuple[RunCurves, ...]
    forces: tuple[ForceCurve, ...]
    diagnosed: Diagnosed | None
    stopped: str
    unestablished: str

    @property
    def judged_part(self) -> str:
        """The part of the data that judges."""
        return TRAINING if self.steps[-1].held_out is None else HELD_OUT

    @property
    def first_run(self) -> int:
        """The number of the run that the diagnosis names, else of the worst one."""
        if self.diagnosed is not None:
            for number, run in enumerate(self.runs):
                if (run.name, run.part) == (self.diagnosed.run, TRAINING):
                    return number
        return self.worst_run

    @property
    def first_time(self) -> float | None:
        """The time of that run at which a sure force has done most, if there is any.

        It lies within the window that the diagnosis names, where it names one.
        """
        if self.diagnosed is None or not self.diagnosed.run:
            return None
        window = self.diagnosed.window or (-np.inf, np.inf)
        number_of_run = self.first_run
        run = self.runs[number_of_run]
        shown = self.worst_channel(number_of_run)
        (channel,) = (one for one in run.channels if one.name == shown)
        off = np.abs(np.nan_to_num(channel.residual))
        for curve in self.forces_along(run):
            if curve.equation == self.diagnosed.equation:
                return worst_within(curve, run.t, off, window)
        return None

    def worst_channel(self, run: int) -> str:
        """The channel of a run whose error is largest beside its movement."""
        sizes = [channel.share_off for channel in self.runs[run].channels]
        return self.runs[run].channels[int(np.argmax(sizes))].name

    @property
    def worst_run(self) -> int:
        """The number of the run of the judging data with the largest residuals."""
        sizes = []
        for run in self.runs:
            sizes.append(run.misfit if run.part == self.judged_part else -1.0)
        return int(np.argmax(sizes))

    def forces_along(self, run: RunCurves) -> list[ForceCurve]:
        """The missing force of each equation along a run."""
        found = []
        for curve in self.forces:
            if (curve.run, curve.part) == (run.name, run.part):
                found.append(curve)
        return found


def worst_within(
    curve: ForceCurve, t: np.ndarray, off: np.ndarray, window: tuple[float, float]
) -> float:
    """The time at which a run is farthest off while the missing force is sure.

    Where the force is sure at no time of the window, that at which it is surest.

    Args:
        curve: the missing force.
        t: (n_samples,) of the run; ``off``: sizes of its residual.
        window: of the run.
    """
    sureness = np.abs(curve.force) / curve.std
    inside = (curve.t >= window[0]) & (curve.t <= window[1])
    if not inside.any():
        inside = np.ones(len(curve.t), dtype=bool)
    is_sure = inside & (sureness > SURE)
    if not is_sure.any():
        return float(curve.t[np.argmax(np.where(inside, sureness, -1.0))])
    found = np.where(is_sure, np.interp(curve.t, t, off), -1.0)
    return float(curve.t[np.argmax(found)])


def force_near(curve: ForceCurve, t: float, t_unit: str = "") -> str:
    """What an equation lacks at a time, in a sentence."""
    place = int(np.argmin(np.abs(curve.t - t)))
    force = curve.force[place]
    std = curve.std[place]
    is_sure = abs(force) > SURE * std
    sure = "surely not zero" if is_sure else "may as well be zero"
    date = date_words(t, curve.origin)
    scale = scale_of_time(float(curve.t[-1]), t_unit)
    when = f"{number(t / scale.size, 3)}{spaced(scale.unit)}"
    when = f"{when} ({date})" if date else when
    return (
        f"At t = {when} of {curve.run}, "
        f"d{curve.equation}/dt lacks {with_error(force, std)}{spaced(curve.unit)} "
        f"(± one standard deviation; {sure})."
    )
