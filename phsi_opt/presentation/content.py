"""All that is said of a study: numbers, arrays and words, apart from how it is drawn.

Terminal, notebooks, Markdown, the HTML report, ``--json`` and the page are made of
these records. Nothing here knows of fits or diagnoses; they travel between processes.
Numbers that are not known are NaN in arrays, and None elsewhere.
"""

import datetime as dt
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import filterfalse
from operator import itemgetter
from typing import Any

import numpy as np

from phsi_opt.errors import some_of
from phsi_opt.presentation.numbers import (
    as_exact_as,
    label,
    lowered,
    number,
    proper_names,
    said,
    typeset,
    with_error,
)
from phsi_opt.presentation.units import Scale, scale_of_errors
from phsi_opt.statistics import rms

Number = float | None
Row = dict[str, str]  # of a table: a text by the name of its column

TRAINING = "training"
HELD_OUT = "held out"
VERDICT = "Verdict"  # the first question of every list of answers
NEXT = "What to do next"  # which each has, too
# Severities, each with a word that is printed beside its colour.
GOOD = "good"
LOOK = "look"
BAD = "bad"
SEVERITY_WORDS = {GOOD: "In order", LOOK: "Worth a look", BAD: "Not in order"}
# What people read for a verdict, whose own name is for programs.
VERDICT_WORDS = {
    "missing: named": "found",
    "missing: partly named": "found in part",
    "missing: unexplained": "cause unknown",
}


# ---- the verdict ---------------------------------------------------------------------


@dataclass(frozen=True)
class Answer:
    """A question, what is to be understood at once, details, and which call does it."""

    lead: str
    detail: str = ""
    question: str = ""
    how: str = ""
    severity: str = ""  # of a verdict
    numbers: Mapping[str, Any] = field(default_factory=dict)  # of which it tells

    @property
    def told(self) -> str:
        return f"{self.lead} {self.detail}".strip()

    def __str__(self) -> str:
        return f"{self.told} {self.how}".strip()


@dataclass(frozen=True)
class Headline:
    """What is said of the present model at once."""

    status: str  # the verdict, for programs
    discovery: Answer  # what was found, and what it changed
    # Verdict, what is wrong, where, when, what to do next, how sure that is, how good
    # the model is.
    answers: tuple[Answer, ...]
    caution: str = ""  # what else to know before anything is believed; "" for nothing

    @property
    def badge(self) -> str:
        """The verdict in a few words, as people read it."""
        return lowered(self.answers[0].lead.removesuffix("."))

    @property
    def sentence(self) -> str:
        return self.discovery.told

    @property
    def next_step(self) -> Answer:
        return next(one for one in self.answers if one.question == NEXT)


@dataclass(frozen=True)
class Check:
    """A check of the residuals or the fit: its subject, severity, and finding."""

    subject: str
    severity: str
    said: str

    @property
    def word(self) -> str:
        return SEVERITY_WORDS[self.severity]


@dataclass(frozen=True)
class ErrorStep:
    """The free-run errors of one step; ``held_out`` is None where nothing is."""

    label: str
    train: Number
    held_out: Number
    floor: Number
    bic: Number = None
    floor_ends: tuple[float, float] = (np.nan, np.nan)  # of its 95 % interval
    final: Number = None  # on the data of the final test

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
    """A parameter, its 95 % interval (None: not known), and what is odd about it."""

    name: str
    value: float
    std_error: float
    lower: Number
    upper: Number
    remark: str
    unit: str
    symbol: str = ""  # in the typeset equations, where that is not its name

    @property
    def interval(self) -> str:
        """The interval in words, and what is odd about it."""
        ends = ""
        if self.lower is not None and self.upper is not None:
            ends = f"{number(self.lower)} to {number(self.upper)}"
            if 0 < self.std_error < np.inf:
                both = (self.lower, self.upper)
                ends = said(as_exact_as(self.std_error, both, " to "))
        return ", ".join(filter(None, (ends, self.remark)))


@dataclass(frozen=True)
class Equations:
    """A model: ``heading``, its equations a line each, and its parameters."""

    heading: str
    lines: tuple[str, ...]
    parameters: tuple[ParameterRow, ...]
    typeset: tuple[str, ...] = ()  # the same as MathML, without numbers; (): too long

    @property
    def rows(self) -> list[Row]:
        rows = []
        for one in self.parameters:
            name = f"{one.symbol}: {one.name}" if one.symbol else one.name
            row = {"Parameter": name, "Value": with_error(one.value, one.std_error)}
            row |= {"95 % interval": one.interval, "Unit": typeset(one.unit)}
            rows.append(row)
        return rows


@dataclass(frozen=True, eq=False)
class Channel:
    """One measured channel along a run, (n,) values that are thinned for drawing."""

    name: str  # of the state
    unit: str
    noise: Number  # standard deviation of the measurements; None: not known
    t: np.ndarray
    measured: np.ndarray
    models: tuple[np.ndarray, ...]  # simulated by each model, as `StudyContent.names`
    errors: tuple[Number, ...]  # rms of the residual of each model, of all samples
    movement: float = 0.0  # standard deviation of all that was measured
    std: np.ndarray | None = None  # of what the models predict

    @property
    def title(self) -> str:
        """Such as "q (m)"."""
        return label(self.name, self.unit)

    @property
    def change(self) -> float:
        """How far the first and the last model, or model and data, are apart (rms)."""
        last = self.models[-1] if len(self.models) > 1 else self.measured
        apart = self.models[0] - last
        known = apart[np.isfinite(apart)]
        return rms(known) / self.movement if len(known) and self.movement else 0.0

    def share_off(self, model: int) -> float:
        """The error of a model over the movement."""
        return (self.errors[model] or 0.0) / self.movement if self.movement else 0.0


@dataclass(frozen=True, eq=False)
class Run:
    """One trajectory; ``origin`` is the moment of its time 0, where times are dates."""

    name: str
    part: str
    channels: tuple[Channel, ...]
    origin: dt.datetime | None = None

    @property
    def title(self) -> str:
        """Such as "run 3 (held out)"."""
        return f"{self.name} ({self.part})"

    def holds(self, t: float) -> bool:
        times = self.channels[0].t
        return bool(times[0] <= t <= times[-1])


# ---- what is missing -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ForceRun:
    """The missing force of one equation along one run, (n,) values each."""

    run: str
    part: str  # of the data
    equation: str  # that lacks the force, such as "the equation of p"
    quantity: str  # what it is, such as a force, a voltage or a heat flow
    unit: str  # of the force
    t: np.ndarray
    force: np.ndarray
    std: np.ndarray  # its standard deviation
    origin: dt.datetime | None = None  # of times that are dates

    def near(self, t: float) -> tuple[float, float]:
        """Force and standard deviation at the nearest time."""
        place = int(np.argmin(np.abs(self.t - t)))
        return float(self.force[place]), float(self.std[place])


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
    law: np.ndarray | None = None  # the force by the law that was found, (n,)


@dataclass(frozen=True, eq=False)
class Force:
    """The missing force of one equation, such as "the equation of p"."""

    equation: str
    quantity: str  # as of its runs
    runs: tuple[ForceRun, ...]  # along the training runs
    shown: int  # number of the run to show first
    follows: Follows  # against what predicts it best


@dataclass(frozen=True)
class Ranked:
    """A candidate effect."""

    effect: str  # its name, such as "coulomb friction on p"
    size: str  # with its standard error and unit, and its other parameters
    evidence: str  # for tables, such as "decisive, log evidence 95"
    # Of the squared error above the noise that it explains; None: not known.
    share: Number
    train: Number  # the training error with it
    held_out: Number  # on data held out
    confused_with: tuple[str, ...]  # effects that the data cannot tell from it
    lost: str  # why it is rejected; "" where it is accepted
    odds: str = ""  # how sure it is, in words; "" where it is rejected
    is_likely: bool = False  # by its evidence, more than a random disturbance
    words: str = ""  # the effect as people read it

    def row(self, unit: str) -> Row:
        """Of the table of the candidates; the error on data that judge, if known."""
        error = self.train if self.held_out is None else self.held_out
        words = "" if error is None else typeset(f"{number(error, 3)} {unit}".rstrip())
        if error is not None and self.held_out is None:
            words += " on training data"
        return {
            "Effect": proper_names(self.words or self.effect),
            "Size": typeset(self.size),
            "Evidence": typeset(self.evidence),
            "Explains": "" if self.share is None else f"{100 * self.share:.0f} %",
            "Error with it": words,
            "Confusable with": proper_names(some_of(self.confused_with, "no other")),
            "Result": said(self.lost or "accepted"),
        }


@dataclass(frozen=True)
class Diagnosed:
    """A diagnosis of one step's model."""

    heading: str  # which model it looks at
    answers: tuple[Answer, ...]  # as those of the diagnosis
    verdict: str  # for programs
    forces: tuple[Force, ...]  # the missing force of each equation that has a sure one
    ranking: tuple[Ranked, ...]  # the candidates, best first
    proposed: tuple[str, ...]  # the effects to add next; empty for none
    nearest: str  # the effect that comes nearest where none is named; "" for none
    averaged: int  # how many samples to average, where a force shakes; 0: none

    @property
    def listed(self) -> tuple[Ranked, ...]:
        return tuple(one for one in self.ranking if one.is_likely)[:12]

    def rows(self, unit: str) -> list[Row]:
        """Their table, with errors in a unit, without columns that say nothing."""
        rows = [one.row(unit) for one in self.listed]
        for name in list(rows[0]) if rows else ():
            if set(map(itemgetter(name), rows)) <= {"", "no other"}:
                for row in rows:
                    del row[name]
        return rows


# ---- all of it -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StudyContent:
    """A study as it stands, in the order in which it is read."""

    title: str  # such as "Study of q"
    subtitle: str  # what was measured, and when
    headline: Headline  # the verdict on the present model
    steps: tuple[ErrorStep, ...]  # the errors step by step, in ``unit``
    unit: str
    errors: str  # where they have got
    models: tuple[Equations, ...]  # base model and present model
    symbols: str  # what their letters are, where the names do not tell; "" for nothing
    time: Scale  # the unit of all times
    # Of the models whose free runs are shown; the last is the present one.
    names: tuple[str, ...]
    runs: tuple[Run, ...]  # measurements and free runs
    shown: int  # number of the first one to show: there the models differ most
    shown_channel: int  # in this channel
    runs_caption: str  # what to see, and which are left out
    # Of the present model along all runs; empty unless they were asked for.
    forces: tuple[ForceRun, ...]
    # Of the effects that were added; empty unless they were asked for.
    laws: tuple[Follows, ...]
    diagnoses: tuple[Diagnosed, ...]  # each of one step's model, the oldest first
    is_diagnosed: bool  # whether the last of these looks at the present model
    checks: tuple[Check, ...]  # of the residuals and the fit
    settings: tuple[Answer, ...]  # names and values that reproduce the study
    code: str  # the calls
    # The effects that the present model has beyond the base model.
    added: tuple[str, ...]
    stopped: str  # why the automatic study stopped; "" where it did not run
    # Which of the effects added no diagnosis established.
    unestablished: tuple[str, ...]
    hold: str | Mapping[str, str]  # what inputs do between samples

    @property
    def present(self) -> Diagnosed | None:
        """The diagnosis of the present model; None before there is one."""
        return self.diagnoses[-1] if self.is_diagnosed else None

    @property
    def where(self) -> str:
        """What the part is called that tells where the model fails, or failed."""
        if self.headline.status != "nothing missing":
            return "Where it fails"
        return "Where the base model failed" if self.added else "Diagnosis"

    @property
    def changed(self) -> tuple[str, ...]:
        """The typeset equations of the present model that the base model has not."""
        first, last = self.models[0], self.models[-1]
        return tuple(filterfalse(first.typeset.__contains__, last.typeset))

    @property
    def worst(self) -> tuple[int, int, float]:
        """Run and channel in which the present model is off most, and the time."""
        run_number, number = foremost(self.runs, lambda one: one.share_off(-1))
        channel = self.runs[run_number].channels[number]
        residual = np.abs(np.nan_to_num(channel.measured - channel.models[-1]))
        return run_number, number, float(channel.t[np.argmax(residual)])

    @property
    def error_rows(self) -> list[Row]:
        rows = []
        for k, step in enumerate(self.steps):
            row = {"Step": str(k), "Model": proper_names(step.label)}
            row["Training"] = number(step.train, 3)
            row["Held out"] = "none held out"
            if step.held_out is not None:
                row["Held out"] = number(step.held_out, 3)
            if self.steps[0].final is not None:
                row["Final test"] = "" if step.final is None else number(step.final, 3)
            row |= {"Noise floor": number(step.floor, 3), "BIC": number(step.bic, 6)}
            rows.append(row)
        return rows

    @property
    def run_rows(self) -> list[Row]:
        largest: dict[str, float] = {}
        for run in self.runs:
            for one in run.channels:
                known = filter(None, (largest.get(one.name), *one.errors))
                largest[one.name] = max(known, default=0.0)
        rows = []
        for run in self.runs:
            for one in run.channels:
                size, unit = scale_of_errors(one.unit, largest[one.name])
                row = {"Run": run.name, "Part": run.part}
                row["Channel"] = label(one.name, unit)
                errors = dict(zip(self.names, one.errors, strict=True))
                for name, error in {**errors, "Noise": one.noise}.items():
                    row[name] = number(error and size * error, 3)
                rows.append(row)
        return rows

    def forces_along(self, run: Run) -> list[ForceRun]:
        place = (run.name, run.part)
        return [one for one in self.forces if (one.run, one.part) == place]


def foremost(runs: Sequence[Run], size: Callable[[Channel], float]) -> tuple[int, int]:
    """Numbers of the run and the channel of the largest size."""
    sizes: dict[tuple[int, int], float] = {}
    for k, run in enumerate(runs):
        sizes |= {(k, c): size(one) for c, one in enumerate(run.channels)}
    return max(sizes, key=sizes.__getitem__)


def lines_of(answers: Sequence[Answer]) -> list[str]:
    """Answers as lines of a terminal."""
    return [f"{one.question}: {one}" for one in answers]


def verdict_words(status: str) -> str:
    """A verdict as people read it."""
    return VERDICT_WORDS.get(status, status)


def unestablished_words(names: Sequence[str]) -> str:
    """What was added that no diagnosis established; "" for nothing."""
    return f"added, but not established: {', '.join(names)}" if names else ""


def thinned(curves: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Samples to draw, (n_drawn,): first, last, and extremes of each bin."""
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
