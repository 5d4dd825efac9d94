"""The record of a diagnosis: where a model fails, the candidates, the verdict.

What it says is one list of answers, which terminal, notebook, ``--json``, Markdown,
report and page print. Their sentences stand in ``words.jinja``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from typing import TYPE_CHECKING, Any

from phsi_opt.comparison.compare import Comparison
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate, Finding, Grade, Verdict
from phsi_opt.diagnosis.data_causes import DataCause
from phsi_opt.diagnosis.experiments import Experiment, next_experiment
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import (
    ForceAnalysis,
    step_without_name,
    strength_words,
    when_answer,
    where_answer,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import effect_words, place_words
from phsi_opt.presentation.content import (
    BAD,
    GOOD,
    LOOK,
    NEXT,
    TRAINING,
    VERDICT,
    Answer,
    lines_of,
    verdict_words,
)
from phsi_opt.presentation.numbers import capitalised, enumerated, range_words
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.summary import (
    Part,
    Summarised,
    Summary,
    printed_table,
)
from phsi_opt.presentation.units import scale_of
from phsi_opt.statistics import TINY

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CANDIDATE_COLUMNS = [
    *("effect", "slot", "equation", "coefficient", "std_error", "unit", "log_bayes"),
    *("log_predictive", "probability", "grade", "force_left", "share", "train_rmse"),
    *("held_out_rmse", "confusable_with", "lost"),
]
# Those that are printed; all would make lines too long to read.
PRINTED = ("effect", "size", "log_evidence", "grade", "held_out_rmse")
N_PRINTED = 6  # candidates that are printed

HOW_TO_ADD = (
    "In Python, study.add or study.auto adds it; phsi-opt study --auto on the command "
    "line."
)


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Summarised):
    """The result of `diagnose`.

    Attributes:
        record: the fit along the training record, with its missing force.
        base: the free run of the fit on held-out data, or on the training data if there
            are none.
        ranking: the candidates with all their results, best first.
        verdict: one of four phrases, for programs; ``reason`` explains it in a
            sentence.
        findings: the established effects, each a single effect or a class; empty if
            none is established.
        proposed: the effects that a study adds next, the first of each finding; empty
            without findings. ``proposed_fit`` is the re-fit with them.
        data_cause: spoilt samples, or a run that differs from the others, where they
            explain most of the misfit; no effect is named then.
    """

    _between = "\n"
    record: Record
    base: Comparison
    ranking: tuple[Candidate, ...]
    verdict: Verdict
    reason: str
    findings: tuple[Finding, ...] = ()
    proposed: tuple[Effect, ...] = ()
    proposed_fit: Fit | None = None
    data_cause: DataCause | None = None

    @property
    def said(self) -> str:
        """The verdict as people read it, with its reason."""
        return f"{verdict_words(self.verdict)}: {self.reason}"

    def told(self, effect: Effect) -> str:
        """An effect as people read it."""
        return effect_words(effect, self.data.labels)

    @property
    def fit(self) -> Fit:
        """The fit that was diagnosed."""
        return self.record.fit

    @property
    def data(self) -> Measurements:
        """The training record."""
        return self.record.data

    @property
    def effects(self) -> list[Effect]:
        """The candidate effects, best first."""
        return [one.effect for one in self.ranking]

    @property
    def strong(self) -> tuple[Effect, ...]:
        """The most likely effect, if its evidence is strong and none is decisive."""
        if self.findings or self.data_cause:
            return ()
        first = self.ranking[:1]
        return tuple(one.effect for one in first if one.grade == Grade.STRONG)

    @property
    def established(self) -> list[Candidate]:
        """The candidates of the findings; without findings the first candidate."""
        named = list(chain(*(found.effects for found in self.findings)))
        found = [one for one in self.ranking if one.effect in named]
        return found or list(self.ranking[:1])

    @property
    def candidates(self) -> "pd.DataFrame":
        """The candidates, best first, a row per effect.

        Columns: effect; slot; equation; coefficient, std_error and unit of its size
        (unit is empty where it is not known); log_bayes (logarithm of the Bayes factor
        of the model with the effect over the one without, both with a random force, for
        the training data) and log_predictive (the gain for held-out data); probability
        (posterior, among all effects and no effect); grade (of both together: decisive,
        strong, weak or none); force_left (the random force with the effect over the
        force without it, root mean squares); share (of the squared error above the
        noise floor that it explains), train_rmse and held_out_rmse of its free run, if
        it was re-fitted; confusable_with; lost (why it is rejected). For effects that
        screening rejects, log_bayes is the expected gain.
        """
        rows = []
        for one in self.ranking:
            row = {name: getattr(one, name, "") for name in CANDIDATE_COLUMNS}
            row |= {"effect": one.effect.name, "slot": one.effect.slot}
            row |= {"equation": one.effect.equation, "grade": str(one.grade)}
            rows.append(row | {"confusable_with": ", ".join(one.confusable_with)})
        return printed_table(rows, columns=CANDIDATE_COLUMNS)

    @cached_property
    def missing_force(self) -> "pd.DataFrame":
        """The missing force along every trajectory.

        Columns: trajectory (its name), t (middle of the interval), then per equation
        the force and its standard deviation (``p`` and ``std_p``), in the unit of the
        state per unit of time.
        """
        record = self.analysis.record
        columns: dict[str, Any] = {
            "trajectory": [record.along.runs[number] for number in record.run],
            "t": record.t,
        }
        for force in self.analysis.forces:
            columns[force.equation] = force.w
            columns[f"std_{force.equation}"] = force.deviation
        return printed_table(columns)

    @cached_property
    def analysis(self) -> ForceAnalysis:
        """Where and when the missing force acts, and on what it depends."""
        return ForceAnalysis.of(self.record)

    @property
    def where(self) -> "pd.DataFrame":
        """Where the missing force is strong (see `ForceAnalysis.where`)."""
        return self.analysis.where

    @property
    def follows(self) -> "pd.DataFrame":
        """What the missing force depends on (see `ForceAnalysis.follows`)."""
        return self.analysis.follows

    @property
    def power(self) -> "pd.DataFrame":
        """Whether the missing force dissipates, stores or supplies energy.

        A row per equation (see `ForceAnalysis.energy`).
        """
        return self.analysis.energy

    @property
    def sentences(self) -> list[str]:
        """Where the model fails, by equation, strongest first."""
        return self.analysis.sentences

    @property
    def warning(self) -> str:
        """What to do where the free run is flat or far off, and no name explains it."""
        return "" if self.verdict == Verdict.NAMED else self.base.warning

    @cached_property
    def answers(self) -> tuple[Answer, ...]:
        """The verdict; what is wrong, where and when; what to do next.

        Reports, the page, the command line and what is printed have these sentences.
        """
        return _answers(self)

    @property
    def next_step(self) -> Answer:
        """The recommended next step.

        Add the named effect, or distinguish the effects of a class; if no effect is
        named, what to measure, to try or to check; use the model if nothing is missing.
        """
        return _next_step(self)

    @property
    def tied(self) -> dict[str, Fit]:
        """Two effects of a class that was found, as fits by name; empty without one."""
        fits = {one.name: one.fit for one in self.ranking if one.fit is not None}
        for finding in self.findings:
            names = [str(effect) for effect in finding.effects]
            fitted = [name for name in names if name in fits]
            if fitted[:1] == names[:1] and len(fitted) > 1:
                return {name: fits[name] for name in fitted[:2]}
        return {}

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the noise by measured state."""
        sigma = self.record.estimate.sigma.tolist()
        by_state = dict(zip(self.base.fit.model.states, sigma, strict=False))
        return {name: by_state[name] for name in self.data.measured}

    @cached_property
    def separation(self) -> Experiment | None:
        """An experiment that distinguishes two effects of a class.

        The effects are members of the class that was found; None without a class. Its
        inputs and states keep to their ranges in the data; for other limits see
        `Study.next_experiment`.

        Raises:
            SolveError: no experiment can be simulated with both models.
        """
        tied = self.tied
        return next_experiment(tied, self.data, self.noise) if tied else None

    def plot(self, ax: "Axes | None" = None, trajectory: str | int = 0) -> "Axes":
        """Draw the missing force along one trajectory, with two standard deviations.

        Args:
            ax: Axes to draw on; None: a new figure.
            trajectory: Name of the trajectory, or its number, counted from 0.

        Raises:
            DataError: There is no such trajectory.
        """
        from phsi_opt.force_analysis.pictures import force_runs
        from phsi_opt.presentation.charts import drawn, force_chart

        number = self.data.trajectory_number(trajectory)
        time = scale_of(self.data.units.get("t", ""))
        forces = self.analysis.forces
        runs = [force_runs(force, TRAINING, time)[number] for force in forces]
        title = "Significant where the band excludes zero"
        return drawn(force_chart(runs, time.unit), title, ax)

    def figure(self, equation: str | None = None) -> "Figure":
        """Missing force over time, and against what it follows.

        Args:
            equation: state in whose equation the force acts; default: the one whose
                missing force is strongest.

        Raises:
            ModelError: no force was estimated in that equation.
        """
        from phsi_opt.force_analysis.pictures import plot_where

        return plot_where(self.analysis, equation)

    def _summary(self) -> Summary:
        told = lines_of(self.answers[1:])
        rows = []
        for one in self.ranking[:N_PRINTED]:
            size = str(one.size).replace(" ", "\N{NO-BREAK SPACE}")
            evidence = one.log_evidence if one.was_weighed else float("nan")
            rows.append((one.name, size, evidence, one.grade, one.held_out_rmse))
        best = printed_table(rows, columns=list(PRINTED))
        return Summary(
            self.said,
            (
                Part(text="\n".join(filter(None, (self.warning, *told)))),
                Part("where it fails", table=self.where),
                Part("candidates, best first", table=best),
            ),
        )


# ---- what it says --------------------------------------------------------------------


def _answers(diagnosis: Diagnosis) -> tuple[Answer, ...]:
    """The verdict; what is wrong with the model, where and when; what to do next."""
    answers = {VERDICT: _verdict(diagnosis)}
    if diagnosis.verdict != Verdict.NOTHING_MISSING:
        force = diagnosis.analysis.force_in()
        answers["What is wrong"] = _wrong(diagnosis)
        answers["Where"] = _where(diagnosis)
        answers["When"] = when_answer(force)
    answers[NEXT] = _next_step(diagnosis)
    return tuple(replace(one, question=name) for name, one in answers.items())


def _verdict(diagnosis: Diagnosis) -> Answer:
    """The verdict in the words of people, with its reason."""
    remark = " (fast disturbance)" if is_disturbance(diagnosis) else ""
    severities = {Verdict.NOTHING_MISSING: GOOD, Verdict.UNEXPLAINED: BAD}
    judged = diagnosis.base
    numbers = {
        "error": judged.rmse,
        "noise_floor": judged.noise_floor,
        "unit": judged.error_unit,
    }
    return Answer(
        f"{capitalised(verdict_words(diagnosis.verdict))}{remark}.",
        f"{capitalised(diagnosis.reason)}.",
        severity=severities.get(diagnosis.verdict, LOOK),
        numbers=numbers,
    )


def is_disturbance(diagnosis: Diagnosis) -> bool:
    """Whether nothing explains a missing force that shakes."""
    force = diagnosis.analysis.force_in()
    is_open = not (diagnosis.findings or diagnosis.data_cause or force.is_uncertain)
    is_missing = diagnosis.verdict != Verdict.NOTHING_MISSING
    return is_missing and is_open and force.pace.is_vibration


def _wrong(diagnosis: Diagnosis) -> Answer:
    """How far the channels are off that are farthest off, and what force is missing."""
    off = _off_channels(diagnosis.base)
    is_held_out = diagnosis.base.record is not diagnosis.record
    force = diagnosis.analysis.force_in()
    return say(
        __package__,
        "wrong",
        {"channels": off.to_dict("records"), "force": force.where},
        labels=diagnosis.data.labels,
        judged="data not used for fitting" if is_held_out else "the training data",
        strength=strength_words(force),
    )


def _off_channels(judged: Comparison) -> "pd.DataFrame":
    """The three channels that are farthest off, the worst first.

    Error and noise also in percent of the standard deviation, ``off`` and ``noise``.
    """
    table = judged.table[["state", "unit", "rmse", "noise_floor"]]
    off: pd.Series = 100 - judged.table["fit_percent"]
    ratio: pd.Series = table["noise_floor"] / table["rmse"].clip(lower=TINY)
    table = table.assign(off=off, noise=off * ratio)
    return table.sort_values("off", ascending=False, kind="stable")[:3]


def _where(diagnosis: Diagnosis) -> Answer:
    """Where what was found acts, each place once; else where a force appears."""
    # What it looks like is what the other parameters leave of it.
    effects = chain(*(finding.effects for finding in diagnosis.findings))
    labels = diagnosis.data.labels
    places = dict.fromkeys(map(partial(_acts, labels=labels), effects))
    if places:
        return Answer(f"{capitalised(' or '.join(places))}.")
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return Answer("No particular equation, time or region stands out.")
    return where_answer(force)


def _acts(effect: Effect, labels: Mapping[str, str]) -> str:
    place = place_words(effect, labels).strip()
    return f"at the sensor {place}" if effect.slot == "sensor" else place


def _next_step(diagnosis: Diagnosis) -> Answer:
    """What to add, to distinguish, to measure, to try or to check."""
    if diagnosis.data_cause is not None:
        advice = f"{capitalised(diagnosis.data_cause.advice)}."
        return Answer(advice, "Then diagnose again.")
    if diagnosis.verdict == Verdict.NOTHING_MISSING:
        covered = ", ".join(_ranges(diagnosis))
        again = "measure again before you rely on it outside"
        return Answer("Use the model.", f"The data cover {covered}; {again}.")
    if not diagnosis.findings:
        return step_without_name(diagnosis.analysis)
    firsts = enumerated(diagnosis.told(one.effects[0]) for one in diagnosis.findings)
    is_part = diagnosis.verdict == Verdict.PARTLY_NAMED
    again = ", then diagnose again" if is_part else ""
    apart = []
    for finding in diagnosis.findings:
        first, *others = map(diagnosis.told, finding.effects)
        if others:
            apart.append(f"{first} from {', '.join(others)}")
    if not apart:
        return Answer(f"Add {firsts}{again}.", how=HOW_TO_ADD)
    return Answer(
        f"Distinguish {'; '.join(apart)} by an experiment.",
        f"Until then, you may use {firsts} in the model{again}.",
        how="phsi-opt experiment, or study.next_experiment, designs it.",
    )


def _ranges(diagnosis: Diagnosis) -> list[str]:
    """What the data cover, such as "q from -1 to 2 m", of at most four channels."""
    found: dict[tuple[str, str], list[float]] = {}
    for data in (diagnosis.data, diagnosis.base.data):
        for one in data.look.channels:
            found.setdefault((one.called, one.unit), []).extend(one.values[one.known])
    covered = [(*key, values) for key, values in found.items() if values]
    return [
        f"{name} from {range_words(min(values), max(values), unit)}"
        for name, unit, values in covered[:4]
    ]
