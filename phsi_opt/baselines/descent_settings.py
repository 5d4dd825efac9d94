"""Settings of `gradient_descent`: how it descends, and the force trained beside it.

The descents of `ssinn` and `phnn` have settings of their own, in their files.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, pi
from types import MappingProxyType
from typing import Any

from phsi_opt.baselines.setting_checks import (
    check_descent,
    is_count,
    is_size,
    require,
    require_choice,
    require_count,
    require_positive,
    require_size,
)
from phsi_opt.transcription.losses import l1_weights

STARTS = ("thesis", "normal", "model")
DECAYS = ("none", "cosine")
PRUNED_SLOTS = ("H", "R", "F")


@dataclass(frozen=True)
class Descent:
    """How to descend (thesis Algorithm 6 and appendix B).

    Args:
        learning_rate: of Adam.
        epochs: passes over the data.
        batch: samples per step.
        decay: "none", or "cosine": the learning rate falls along half a cosine to
            (almost) zero in the last epoch.
        force_rate: learning rate of the weights of a neural force; None takes
            ``learning_rate``.
        prune_every: after every so many epochs, coefficients below ``threshold`` in
            size, of ``prune_slots``, become zero for good; None never prunes.
        prune_from: epoch before which nothing is pruned (the thesis' code: twice
            ``prune_every``); None begins with the first ``prune_every``.
        threshold: least magnitude of a coefficient that stays.
        prune_slots: slots in which terms are pruned.
        weight_decay: added to the gradient as weight_decay * parameter, as Adam of
            torch does.
        l1: lambda of ``|xi|`` per slot, such as {"H": 0.1, "F": 0.01}.
        l1_off_after: share of the epochs after which that of H is off (the thesis'
            code: half); None keeps it.
        integrator: a name in ``phsi_opt.transcription.integrators``.
        start: "thesis" (0.2 for polynomials, 1 for other functions and their
            frequencies, 0 for damping: appendix B and the thesis' code), "normal" (N(0,
            0.5^2), thesis Section 5.1) or "model" (the values of the model, zero where
            it has none). Values that a model gives to formulas and to inner parameters
            are kept.
        dtype: "float64", or "float32" as the thesis has it.
        keep_damping_positive: keep the bounds of R; the thesis lets it go negative.
            Other bounds are always kept, by projection after each step.
        significance: from half of the epochs on, terms go as well while the data do not
            contradict that they are zero: the test of `phsi_opt.Pruning`, with the
            standard errors of the PHSI loss, at every pruning. What L1 still shrinks is
            tested as it is. None: size alone, as the thesis has it.

    Raises:
        ModelError: if a setting is not possible.
    """

    learning_rate: float = 3e-3
    epochs: int = 60
    batch: int = 32
    decay: str = "none"
    force_rate: float | None = None
    prune_every: int | None = 5
    prune_from: int | None = None
    threshold: float = 0.05
    prune_slots: tuple[str, ...] = ("H", "F")
    weight_decay: float = 0.0
    l1: Mapping[str, float] = field(default_factory=dict)
    l1_off_after: float | None = 0.5
    integrator: str = "srk4"
    start: str = "thesis"
    dtype: str = "float64"
    keep_damping_positive: bool = False
    significance: float | None = None

    def __post_init__(self) -> None:
        check_descent(self)
        require_count("prune_every", self.prune_every, or_none=True)
        require_count("prune_from", self.prune_from, or_none=True)
        require_positive("force_rate", self.force_rate, or_none=True)
        require_choice("decay", self.decay, DECAYS)
        require_size("threshold", self.threshold)
        self._check_slots()
        self._check_share()
        self._check_significance()
        require_choice("start", self.start, STARTS)
        object.__setattr__(self, "l1", MappingProxyType(l1_weights(self.l1)))
        object.__setattr__(self, "prune_slots", tuple(self.prune_slots))

    def _check_slots(self) -> None:
        expected = "slots among 'H', 'R' and 'F'"
        for slot in self.prune_slots:
            require(slot in PRUNED_SLOTS, "prune_slots", self.prune_slots, expected)

    def _check_share(self) -> None:
        share = self.l1_off_after
        fine = share is None or (is_size(share) and share <= 1)
        expected = "a share of the epochs between 0 and 1, or None"
        require(fine, "l1_off_after", share, expected)

    def _check_significance(self) -> None:
        chance = self.significance
        fine = chance is None or (is_size(chance, positive=True) and chance < 1)
        expected = "a number between 0 and 1, such as 0.01, or None"
        require(fine, "significance", chance, expected)

    def rate(self, epoch: int) -> float:
        """Learning rate in an epoch, counted from 1."""
        if self.decay == "none":
            return self.learning_rate
        share = (epoch - 1) / self.epochs
        return self.learning_rate * ((1 + cos(pi * share)) / 2)

    def __reduce__(self) -> tuple[Any, ...]:  # a mappingproxy cannot be pickled
        return _descent, ({**vars(self), "l1": dict(self.l1)},)


def _descent(parts: dict[str, Any]) -> Descent:
    return Descent(**parts)


@dataclass(frozen=True)
class JointForce:
    """A force by a network beside the dictionary (the thesis' hybrid, Section 6.4).

    In the equation of each state i among ``equations``, F_i = net_i(variables).

    Args:
        equations: states in whose equations it acts.
        variables: states, inputs or "t" that it depends on.
        hidden: widths of the hidden layers, with ReLU.
        penalty: weight of the mean of ``|F|`` over the batch.
        first: function of the first hidden layer, "relu" (the text of the thesis) or
            "tanh" (its code, which has two hidden layers); with a large learning rate,
            a narrow input and only ReLU, units die.

    Raises:
        ModelError: if a setting is not possible.
    """

    equations: tuple[str, ...]
    variables: tuple[str, ...]
    hidden: tuple[int, ...] = (100, 100, 100)
    penalty: float = 0.0
    first: str = "relu"

    def __post_init__(self) -> None:
        require(self.first in ("relu", "tanh"), "first", self.first, "'relu' or 'tanh'")
        for name in ("equations", "variables"):
            given = getattr(self, name)
            listed = (given,) if isinstance(given, str) else tuple(given)
            distinct = len(set(listed)) == len(listed) > 0
            require(distinct, name, given, "at least one name, and each only once")
            object.__setattr__(self, name, listed)
        possible = all(is_count(width) for width in self.hidden)
        require(possible, "hidden", self.hidden, "widths of at least 1")
        object.__setattr__(self, "hidden", tuple(self.hidden))
        require_size("penalty", self.penalty)
