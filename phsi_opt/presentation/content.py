"""All that is said of a study: numbers, arrays and words, apart from how it is drawn.

Terminal, notebooks, Markdown, the HTML report, ``--json`` and the page are made of
these records. Nothing here knows of fits or diagnoses; they travel between processes.
Numbers that are not known are NaN in arrays, and None elsewhere.
"""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.presentation.numbers import number, with_error
from phsi_opt.presentation.units import Scale

Number = float | None

TRAINING = "training"
HELD_OUT = "held out"
# Severities, each with a word that is printed beside its colour.
GOOD = "good"
LOOK = "look"
BAD = "bad"
SEVERITY_WORDS = {GOOD: "In order", LOOK: "Worth a look", BAD: "Not in order"}


# ---- the verdict ---------------------------------------------------------------------


@dataclass(frozen=True)
class Answer:
    """What is to be understood at once, and its details; "" for nothing.

    ``question`` is what it answers, such as "Since when", where it is asked.
    """

    lead: str
    detail: str = ""
    question: str = ""

    def __str__(self) -> str:
        return f"{self.lead} {self.detail}".strip()


@dataclass(frozen=True)
class Headline:
    """The verdict on the present model.

    Attributes:
        status: in a phrase; ``severity``: how bad that is.
        sentence: what was found and what it changed.
        answers: what is wrong, where, since when, what to add.
        beside: a remark on the status, such as "fast disturbance"; "": none.
        certainty: how sure it is that something is missing, and whether why is known.
        caution: what else to know before anything is believed; "" for nothing.
    """

    status: str
    severity: str
    sentence: str
    answers: tuple[Answer, ...]
    beside: str = ""
    certainty: str = ""
    caution: str = ""


@dataclass(frozen=True)
class Check:
    """A check of the residuals or the fit: its subject, severity, and finding."""

    subject: str
    severity: str
    said: str

    @property
    def word(self) -> str:
        """The severity in words."""
        return SEVERITY_WORDS[self.severity]


@dataclass(frozen=True)
class ErrorStep:
    """The free-run errors of one step; ``held_out`` is None where nothing is."""

    label: str
    train: Number
    held_out: Number
    floor: Number
    bic: Number = None

    @property
    def judged(self) -> Number:
        """The error on data held out, or else on the training data."""
        return self.train if self.held_out is None else self.held_out

    def change(self, number: int) -> str:
        """What the step of a number did, such as "+ Coulomb friction on p"."""
        is_addition = number > 0 and not self.label.startswith("without ")
        return f"+ {self.label}" if is_addition else self.label


# ---- models and free runs ------------------------------------------------------------


@dataclass(frozen=True)
class ParameterRow:
    """A parameter with its 95 % interval, whose ends are None where not known.

    ``remark`` says what is odd about it.
    """

    name: str
    value: float
    std_error: float
    lower: Number
    upper: Number
    remark: str
    unit: str

    @property
    def interval(self) -> str:
        """The interval in words, and what is odd about it."""
        known = self.lower is not None and self.upper is not None
        ends = f"{number(self.lower)} to {number(self.upper)}" if known else ""
        return ", ".join(filter(None, (ends, self.remark)))


@dataclass(frozen=True)
class Equations:
    """A model: ``heading``, its equations a line each, and its parameters."""

    heading: str
    lines: tuple[str, ...]
    parameters: tuple[ParameterRow, ...]


@dataclass(frozen=True, eq=False)
class Channel:
    """One measured channel along a run, thinned for drawing.

    Attributes:
        name: of the state; ``unit``: its unit, or "".
        noise: standard deviation of the measurements; None: not known.
        t: (n,) times; ``measured``: (n,) values.
        models: (n,) simulated values of each model, as `StudyContent.names`.
        errors: root mean square of the residual of each model, of all samples.
        movement: standard deviation of all that was measured.
    """

    name: str
    unit: str
    noise: Number
    t: np.ndarray
    measured: np.ndarray
    models: tuple[np.ndarray, ...]
    errors: tuple[Number, ...]
    movement: float = 0.0

    def share_off(self, model: int) -> float:
        """The error of a model over the movement."""
        return (self.errors[model] or 0.0) / self.movement if self.movement else 0.0


@dataclass(frozen=True, eq=False)
class Run:
    """One trajectory: its name, its part of the data, its channels.

    ``origin`` is the moment at which its time is 0; None where times are no dates.
    """

    name: str
    part: str
    channels: tuple[Channel, ...]
    origin: dt.datetime | None = None

    @property
    def title(self) -> str:
        """Such as "run 3 (held out)"."""
        return f"{self.name} ({self.part})"

    def holds(self, t: float) -> bool:
        """Whether a time lies within the record."""
        times = self.channels[0].t
        return bool(times[0] <= t <= times[-1])

    def worst(self, model: int) -> Channel:
        """The channel in which a model is off most, as a share of its movement."""
        return max(self.channels, key=lambda one: one.share_off(model))


# ---- what is missing -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ForceRun:
    """The missing force of one equation along one run.

    Attributes:
        run: its name; ``part``: of the data.
        equation: the state whose rate lacks the force; ``unit``: of the force.
        t: (n,) times; ``force``: (n,) and ``std``: (n,) its standard deviation.
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

    def near(self, t: float) -> tuple[float, float]:
        """Force and standard deviation at the nearest time."""
        place = int(np.argmin(np.abs(self.t - t)))
        return float(self.force[place]), float(self.std[place])


@dataclass(frozen=True, eq=False)
class ForceMap:
    """Mean force over two variables: middles of the cells, and (n_y, n_x) values."""

    x_label: str
    y_label: str
    label: str
    x: np.ndarray
    y: np.ndarray
    force: np.ndarray
    sentence: str

    @property
    def largest(self) -> float:
        """The largest size of a value; 1 where none is known."""
        known = np.abs(self.force[np.isfinite(self.force)])
        return float(known.max(initial=0.0)) or 1.0


@dataclass(frozen=True, eq=False)
class Follows:
    """A force against a variable: (n,) points, (n_bins,) mean and spread in bins."""

    heading: str
    x_label: str
    y_label: str
    x: np.ndarray
    force: np.ndarray
    centre: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    sentence: str


@dataclass(frozen=True, eq=False)
class Force:
    """The missing force of one equation, such as "dp/dt", and a sentence on it.

    Attributes:
        runs: along the training runs; ``shown``: number of the one shown first.
        map: over the states; None where there is only one.
        follows: against what predicts it best.
    """

    equation: str
    sentence: str
    runs: tuple[ForceRun, ...]
    shown: int
    map: ForceMap | None
    follows: Follows


@dataclass(frozen=True)
class Ranked:
    """A candidate effect.

    Attributes:
        effect: such as "coulomb friction on p".
        coefficient: its size, with its standard error and unit.
        evidence: how clearly it is there, such as "decisive, log evidence 95".
        share: of the squared error above the noise that it explains; None: not known.
        train: the training error with it; ``held_out``: on data held out.
        confused_with: effects that the data cannot tell from it.
        lost: why it is rejected; "" where nothing speaks against it.
    """

    effect: str
    coefficient: float
    std_error: float
    unit: str
    evidence: str
    share: Number
    train: Number
    held_out: Number
    confused_with: tuple[str, ...]
    lost: str

    @property
    def size(self) -> str:
        """The coefficient with its standard error and unit."""
        return f"{with_error(self.coefficient, self.std_error)} {self.unit}".rstrip()

    def error_with(self, unit: str) -> str:
        """The error with it, on the data that judge where that is known."""
        if self.held_out is not None:
            return f"{number(self.held_out)} {unit}".rstrip()
        if self.train is not None:
            return f"{number(self.train)} {unit}".rstrip() + " on training data"
        return ""


@dataclass(frozen=True)
class Diagnosed:
    """A diagnosis of one step's model.

    Attributes:
        heading: which model it looks at.
        told: all of it in a paragraph, as an engineer would write it.
        verdict: in a phrase; ``reason``: in a sentence.
        sentences: where the model fails, in words.
        forces: the missing force of each equation that has a sure one.
        ranking: the candidates, best first.
        proposed: the effects to add next; empty for none.
        nearest: the effect that comes nearest where none is named; "" for none.
        averaged: how many samples to average, where a force shakes; 0: none.
    """

    heading: str
    told: str
    verdict: str
    reason: str
    sentences: tuple[str, ...]
    forces: tuple[Force, ...]
    ranking: tuple[Ranked, ...]
    proposed: tuple[str, ...] = ()
    nearest: str = ""
    averaged: int = 0

    @property
    def listed(self) -> tuple[Ranked, ...]:
        """The candidates that a report lists."""
        return self.ranking[:12]


@dataclass(frozen=True, eq=False)
class Glance:
    """Where it shows: one channel of one run, and the force that is missing there.

    Attributes:
        run: number in `StudyContent.runs`; ``channel``: number of its channel.
        sentence: what to see.
        force: the force along that run; None where it was not estimated there.
        window: from when to when the force is strongest; None: at no time.
        t: when the model is off most while the force is sure; None: not known.
    """

    run: int
    channel: int
    sentence: str
    force: ForceRun | None = None
    window: tuple[float, float] | None = None
    t: float | None = None


# ---- all of it -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StudyContent:
    """A study as it stands, in the order in which it is read.

    Attributes:
        title: such as "Study of q".
        headline: the verdict on the present model.
        steps: the errors step by step, in ``unit``; ``errors``: where they have got.
        glance: where it shows best what the verdict says; None: nowhere.
        models: base model and present model.
        time: the unit of all times.
        names: of the models whose free runs are shown; the last is the present one.
        runs: measurements and free runs; ``shown``: number of the first one to show;
            ``runs_told``: what to see, and which are left out.
        forces: of the present model along all runs; empty unless they were asked for.
        laws: of the effects that were added; empty unless they were asked for.
        diagnoses: each of one step's model, the oldest first.
        is_diagnosed: whether the last of these looks at the present model.
        checks: of the residuals and the fit.
        settings: names and values that reproduce the study; ``code``: the calls.
        added: the effects that the present model has beyond the base model.
        stopped: why the automatic study stopped; "" where it did not run.
        unestablished: which of the effects added no diagnosis established.
        warning: what to do where the free run is flat; "" where it is not.
    """

    title: str
    headline: Headline
    steps: tuple[ErrorStep, ...]
    unit: str
    errors: str
    glance: Glance | None
    models: tuple[Equations, ...]
    time: Scale
    names: tuple[str, ...]
    runs: tuple[Run, ...]
    shown: int
    runs_told: str
    forces: tuple[ForceRun, ...]
    laws: tuple[Follows, ...]
    diagnoses: tuple[Diagnosed, ...]
    is_diagnosed: bool
    checks: tuple[Check, ...]
    settings: tuple[Answer, ...]
    code: str
    added: tuple[str, ...]
    stopped: str
    unestablished: tuple[str, ...]
    warning: str

    @property
    def present(self) -> Diagnosed | None:
        """The diagnosis of the present model; None before there is one."""
        return self.diagnoses[-1] if self.is_diagnosed else None

    def forces_along(self, run: Run) -> list[ForceRun]:
        """The missing force of each equation along a run."""
        place = (run.name, run.part)
        return [one for one in self.forces if (one.run, one.part) == place]


def unestablished_words(names: Sequence[str]) -> str:
    """What was added that no diagnosis established; "" for nothing."""
    return f"added, but not established: {', '.join(names)}" if names else ""


def thinned(curves: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Samples to draw, (n_drawn,) increasing: first, last, and extremes of each bin.

    Args:
        curves: (n_samples,) each, NaN where not known; of each, the least and the
            largest value of every bin are kept, and one NaN, for a gap.
        most: samples to draw at most, but for the first and the last one.
    """
    n_samples = len(curves[0])
    if n_samples <= most:
        return np.arange(n_samples)
    kept = {0, n_samples - 1}
    for part in np.array_split(np.arange(n_samples), max(most // (2 * len(curves)), 1)):
        for curve in curves:
            is_known = np.isfinite(curve[part])
            known = part[is_known]
            if len(known):
                kept |= {known[np.argmin(curve[known])], known[np.argmax(curve[known])]}
            if len(known) < len(part):
                kept.add(part[np.argmin(is_known)])
    return np.array(sorted(kept))
