"""Settings of `gradient_descent`, and the checks that other descents share.

Nothing here needs torch.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, pi
from typing import Any

from phsi_opt.arguments import (
    is_size,
    require,
    require_choice,
    require_count,
    require_positive,
    require_size,
)
from phsi_opt.transcription.integrators import integrator
from phsi_opt.transcription.losses import l1_weights

STARTS = ("thesis", "normal", "model")
DECAYS = ("none", "cosine")
PRUNED_SLOTS = ("H", "R", "F")
DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class Descent:
    """How to descend (thesis Algorithm 6 and appendix B).

    Args:
        learning_rate: of Adam.
        epochs: passes over the data.
        batch: samples per step.
        decay: "none", or "cosine": the learning rate falls along half a cosine to
            (almost) zero in the last epoch.
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

    Raises:
        ModelError: if a setting is not possible.
    """

    learning_rate: float = 3e-3
    epochs: int = 60
    batch: int = 32
    decay: str = "none"
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

    def __post_init__(self) -> None:
        check_descent(self)
        integrator(self.integrator)
        require_count("prune_every", self.prune_every, or_none=True)
        require_count("prune_from", self.prune_from, or_none=True)
        require_choice("decay", self.decay, DECAYS)
        require_choice("start", self.start, STARTS)
        require_size("threshold", self.threshold)
        known = set(self.prune_slots) <= set(PRUNED_SLOTS)
        expected = "slots among 'H', 'R' and 'F'"
        require(known, "prune_slots", self.prune_slots, expected)
        share = self.l1_off_after
        fine = share is None or (is_size(share) and share <= 1)
        expected = "a share of the epochs between 0 and 1, or None"
        require(fine, "l1_off_after", share, expected)
        object.__setattr__(self, "l1", l1_weights(self.l1))
        object.__setattr__(self, "prune_slots", tuple(self.prune_slots))

    def rate(self, epoch: int) -> float:
        """Learning rate in an epoch, counted from 1."""
        if self.decay == "none":
            return self.learning_rate
        share = (epoch - 1) / self.epochs
        return self.learning_rate * ((1 + cos(pi * share)) / 2)


def check_descent(settings: Any) -> None:
    """Check learning_rate, epochs, batch, weight_decay and dtype of any descent.

    Raises:
        ModelError: if one of them is not possible.
    """
    require_positive("learning_rate", settings.learning_rate)
    require_count("epochs", settings.epochs)
    require_count("batch", settings.batch)
    require_size("weight_decay", settings.weight_decay)
    require_choice("dtype", settings.dtype, DTYPES)
