"""What a model may lack, what is known of it, and what is established."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import DECISIVE_EVIDENCE, STRONG_EVIDENCE
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import effect_words, parameter_words
from phsi_opt.model.model import Model
from phsi_opt.screening.effect_size import Size

MOST_FAMILIES = 2  # of effects, that the name of a class joins

LOSS = "a loss of energy whose law the data do not determine"
LOSS_SOMEWHERE = "a loss of energy whose equation and law the data do not determine"
AT_LIMIT = "the data do not determine it: {} ends at a limit of its range"


def at_limit(
    model: Model,
    names: Sequence[str],
    at_bounds: Sequence[str],
    labels: Mapping[str, str],
) -> str:
    """Why an effect is rejected of whose parameters one is at a bound; "": none is."""
    found = [name for name in names if name in at_bounds]
    return AT_LIMIT.format(parameter_words(model, found[0], labels)) if found else ""


class Verdict(StrEnum):
    """The verdict of a diagnosis."""

    NOTHING_MISSING = "nothing missing"
    NAMED = "missing: named"
    PARTLY_NAMED = "missing: partly named"
    UNEXPLAINED = "missing: unexplained"


class Grade(StrEnum):
    """How clearly an effect is there, by the logarithm of its Bayes factor."""

    DECISIVE = "decisive"
    STRONG = "strong"
    WEAK = "weak"
    NONE = "none"

    @classmethod
    def of(cls, log_bayes: float) -> "Grade":
        """Of a logarithm of a Bayes factor; not a number counts as none."""
        if log_bayes >= DECISIVE_EVIDENCE:
            return cls.DECISIVE
        if log_bayes >= STRONG_EVIDENCE:
            return cls.STRONG
        return cls.WEAK if log_bayes > 0 else cls.NONE


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate effect: its expected gain, its evidence, and its re-fit.

    Attributes:
        effect: what may be missing.
        coefficient: its size in ``unit``: from the re-fit if the effect is named,
            otherwise from the evidence step with a random force, otherwise as expected
            by screening.
        std_error: of the coefficient.
        values: of the model's parameters, from which a re-fit starts.
        states: (n_nodes, n_states) along the training record, likewise.
        log_bayes: logarithm of the Bayes factor of the model with the effect over the
            model without it, both with a random force, for the training data; without
            computed evidence the value that screening expects.
        log_predictive: gain of the log predictive density of the held-out data; NaN if
            there are none, or if the evidence was not computed.
        was_weighed: whether the evidence was computed, and not only expected.
        probability: posterior probability, if all effects with computed evidence and
            "no effect" were equally likely before.
        force_left: root mean square of the random force with the effect over that
            without it.
        confusable_with: names of the effects that the data cannot distinguish from it.
        train_rmse: free-run error on the training data; NaN without a re-fit.
        held_out_rmse: the same on the data held out; NaN where there are none.
        share: share of the squared error above the noise floor that it explains, on
            held-out data if there are any.
        lost: why it is rejected; empty if it is named.
        unit: of the coefficient; "" where it is not known.
        fit: the re-fit; ``trained`` and ``comparison``: its free runs on the training
            record and on the held-out one (if any). None if it was not re-fitted.
    """

    effect: Effect
    coefficient: float
    std_error: float
    values: dict[str, float] = field(default_factory=dict)
    states: np.ndarray | None = None
    log_bayes: float = np.nan
    log_predictive: float = np.nan
    was_weighed: bool = False
    probability: float = np.nan
    force_left: float = np.nan
    confusable_with: tuple[str, ...] = ()
    train_rmse: float = np.nan
    held_out_rmse: float = np.nan
    share: float = np.nan
    lost: str = ""
    unit: str = ""
    fit: Fit | None = None
    trained: Comparison | None = None
    comparison: Comparison | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, lost={self.lost!r})"

    @property
    def name(self) -> str:
        """The effect in words."""
        return str(self.effect)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effect, as a model of a search has several."""
        return (self.effect,)

    @property
    def size(self) -> Size:
        """The coefficient with its standard error and unit."""
        return Size(self.coefficient, self.std_error, self.unit)

    @property
    def log_evidence(self) -> float:
        """Gain of the log evidence by all data, those held out included."""
        held_out = 0.0 if np.isnan(self.log_predictive) else self.log_predictive
        return self.log_bayes + held_out

    @property
    def grade(self) -> Grade:
        """The grade of its evidence."""
        return Grade.of(self.log_evidence) if self.was_weighed else Grade.NONE


@dataclass(frozen=True, eq=False)
class Finding:
    """An established effect, or a class of effects that the data cannot distinguish.

    Attributes:
        effects: a single effect is a name; several are a class that the data cannot
            distinguish, with the re-fitted effect first.
        family: the class in words, such as "a loss that grows with speed".
        coefficient: of the first one, in ``unit``.
        std_error: of the coefficient; it accounts for model error.
        share: share of the squared error above the noise floor that all findings
            together remove.
        unit: of the coefficient; "" where it is not known.
    """

    effects: tuple[Effect, ...]
    family: str
    coefficient: float
    std_error: float
    share: float
    unit: str = ""

    @property
    def is_name(self) -> bool:
        """Whether it is a single effect and not a class."""
        return len(self.effects) == 1

    @property
    def size(self) -> Size:
        """The coefficient with its standard error and unit."""
        return Size(self.coefficient, self.std_error, self.unit)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __str__(self) -> str:
        return self.words({})

    def words(self, labels: Mapping[str, str]) -> str:
        """It in a sentence, with the labels of channels."""
        first = self.effects[0]
        size = self.size.words(first)
        name, *others = map(partial(effect_words, labels=labels), self.effects)
        if not others:
            return f"{name} ({size})"
        return (
            f"{self.family}: {name} ({size}), which the data cannot distinguish from "
            f"{', '.join(others)}"
        )


def class_of(effects: Sequence[Effect]) -> str:
    """The name of a class of effects: their families, or a loss where these are many.

    A loss takes energy from the motion by any law.
    """
    families = list(dict.fromkeys(effect.family for effect in effects))
    are_losses = all(one.slot == "R" or one.family == "hysteresis" for one in effects)
    if len(families) > MOST_FAMILIES and are_losses:
        places = {effect.equation for effect in effects}
        return LOSS if len(places) == 1 else LOSS_SOMEWHERE
    return " or ".join(families)
