"""What a report says: plain numbers and words, apart from how they are drawn.

Numbers that are not known are None. Nothing here knows of fits or diagnoses, so that a
page or another kind of report can take the same content.
"""

from dataclasses import dataclass

Number = float | None
Numbers = list[Number]

# Severities of a check, each with a word that is printed beside its colour.
GOOD = "good"
LOOK = "look"
BAD = "bad"
SEVERITY_WORDS = {GOOD: "In order", LOOK: "Worth a look", BAD: "Not in order"}


@dataclass(frozen=True)
class Answer:
    """What is to be understood at once, and what stands behind it; "" for nothing."""

    lead: str
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.lead} {self.detail}".strip()


@dataclass(frozen=True)
class Fact:
    """An answer to one question of the first screen.

    Attributes:
        question: such as "Since when".
        answer: in a few words.
        detail: what stands behind it; "" for nothing.
    """

    question: str
    answer: str
    detail: str = ""


@dataclass(frozen=True)
class Headline:
    """The verdict.

    Attributes:
        status: the verdict in a phrase; ``severity``: how bad that is.
        sentence: what was found and what it changed.
        facts: what is wrong, where, since when, what to add.
        beside: what stands beside the status, such as "fast disturbance"; "": nothing.
        certainty: how sure it is that something is missing, and whether why is known.
        caution: what else to know before anything is believed; "" for nothing.
    """

    status: str
    severity: str
    sentence: str
    facts: tuple[Fact, ...]
    beside: str = ""
    certainty: str = ""
    caution: str = ""


@dataclass(frozen=True)
class ErrorStep:
    """The errors of one step: ``label``, training, held out, noise floor, BIC."""

    label: str
    train: Number
    held_out: Number
    floor: Number
    bic: Number


@dataclass(frozen=True)
class Staircase:
    """The errors step by step, in ``unit``; ``sentence`` says where they have got."""

    steps: tuple[ErrorStep, ...]
    unit: str
    sentence: str

    @property
    def has_held_out(self) -> bool:
        """Whether errors on data held out are known."""
        return any(step.held_out is not None for step in self.steps)


@dataclass(frozen=True)
class ParameterRow:
    """A parameter: value, unit, and 95 % interval or why there is none."""

    name: str
    value: str
    interval: str
    unit: str


@dataclass(frozen=True)
class Equations:
    """A model: ``heading``, its equations a line each, and its parameters."""

    heading: str
    lines: tuple[str, ...]
    parameters: tuple[ParameterRow, ...]


@dataclass(frozen=True)
class ChannelRun:
    """One channel along one trajectory, thinned for drawing.

    Attributes:
        t: times; ``measured``: values.
        models: what each model shows, in the order of ``Runs.models``.
        residuals: measured less shown, for each model.
        errors: root mean square of the residual, for each model.
    """

    t: Numbers
    measured: Numbers
    models: list[Numbers]
    residuals: list[Numbers]
    errors: Numbers


@dataclass(frozen=True)
class Run:
    """One trajectory: its name, its part of the data, its channels.

    ``since`` is the date at which its time is 0, in words; "" where times are no dates.
    """

    name: str
    part: str
    channels: list[ChannelRun]
    since: str = ""


@dataclass(frozen=True)
class Channel:
    """A measured channel with its unit and the standard deviation of its noise."""

    name: str
    unit: str
    noise: Number


@dataclass(frozen=True)
class Runs:
    """Measurements beside the free runs of one or more models.

    Attributes:
        unit_of_time: of all times.
        channels: that are measured.
        models: what the models are called; the last is the present one.
        runs: trajectories.
        shown: number of the trajectory that is shown first.
        sentence: what to see.
        left_out: which trajectories are not drawn; "" where all are.
    """

    unit_of_time: str
    channels: tuple[Channel, ...]
    models: tuple[str, ...]
    runs: list[Run]
    shown: int
    sentence: str
    left_out: str = ""


@dataclass(frozen=True)
class ForceRun:
    """The missing force along one trajectory with its standard deviation.

    ``since`` is the date at which its time is 0, in words; "" where times are no dates.
    """

    name: str
    t: Numbers
    force: Numbers
    std: Numbers
    since: str = ""


@dataclass(frozen=True)
class ForceMap:
    """Mean force over two variables: middles of the cells and a row per ``y``."""

    x_label: str
    y_label: str
    x: Numbers
    y: Numbers
    force: list[Numbers]
    sentence: str


@dataclass(frozen=True)
class Follows:
    """The force against a variable: dots, and mean and spread in bins."""

    label: str
    x: Numbers
    force: Numbers
    centre: Numbers
    mean: Numbers
    std: Numbers
    sentence: str


@dataclass(frozen=True)
class Force:
    """The missing force of one equation.

    Attributes:
        equation: such as "dp/dt"; ``label``: of the axis, with the unit.
        sentence: what is said of the force.
        t_label: of the axis of time.
        runs: along the trajectories; ``shown``: number of the one that is shown first.
        map: over the states; None where there is only one.
        follows: against what predicts it best; None where nothing was compared.
    """

    equation: str
    label: str
    t_label: str
    sentence: str
    runs: list[ForceRun]
    shown: int
    map: ForceMap | None
    follows: Follows | None


@dataclass(frozen=True)
class Glance:
    """Where it shows: one channel of one run, and the force that is missing there.

    Attributes:
        run: number of the trajectory in `Runs.runs`; ``channel``: of its channel.
        sentence: what to see.
        force: the force along that trajectory; None where it was not estimated there.
        window: from when to when the force is strongest; None: at no time.
        label: of the force's axis.
    """

    run: int
    channel: int
    sentence: str
    force: ForceRun | None = None
    window: tuple[float, float] | None = None
    label: str = ""


@dataclass(frozen=True)
class Law:
    """The force that is missing without an effect; ``label`` is that of the force."""

    heading: str
    label: str
    follows: Follows


@dataclass(frozen=True)
class Ranked:
    """A candidate effect: how clearly it is there, what it explains, why it lost."""

    name: str
    size: str
    evidence: str
    explains: str
    share: Number
    error: str
    confused_with: str
    lost: str


@dataclass(frozen=True)
class Failure:
    """A diagnosis of one step's model.

    Attributes:
        heading: which model it looks at.
        told: all of it in a paragraph, as an engineer would write it.
        verdict: in a phrase; ``reason``: in a sentence.
        sentences: where the model fails, in words.
        forces: the missing force of each equation that has a sure one.
        ranking: the candidates, best first.
        n_more: candidates that are not listed.
    """

    heading: str
    told: str
    verdict: str
    reason: str
    sentences: tuple[str, ...]
    forces: tuple[Force, ...]
    ranking: tuple[Ranked, ...]
    n_more: int


@dataclass(frozen=True)
class Check:
    """A check of what remains: ``subject``, ``severity``, and what is said of it."""

    subject: str
    severity: str
    said: str

    @property
    def word(self) -> str:
        """The severity in words."""
        return SEVERITY_WORDS[self.severity]


@dataclass(frozen=True)
class Report:
    """A whole report, in the order in which it is read.

    ``settings`` are names and values that reproduce the study.
    """

    title: str
    headline: Headline
    staircase: Staircase
    glance: Glance | None
    equations: tuple[Equations, ...]
    runs: Runs
    laws: tuple[Law, ...]
    failures: tuple[Failure, ...]
    checks: tuple[Check, ...]
    settings: tuple[Fact, ...]
    code: str
