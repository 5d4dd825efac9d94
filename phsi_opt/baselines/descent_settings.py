"""Settings of the baselines that descend, and the checks they share."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, pi
from types import MappingProxyType
from typing import Any

import numpy as np

try:
    import torch
except ModuleNotFoundError as error:  # pragma: no cover
    raise ModuleNotFoundError(
        "torch is missing; install the extra: pip install 'phsi_opt[baselines]'."
    ) from error

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.transcription.integrators import integrator
from phsi_opt.transcription.losses import l1_weights

DTYPES = {"float32": torch.float32, "float64": torch.float64}
STARTS = ("thesis", "normal", "model")
DECAYS = ("none", "cosine")


@dataclass(frozen=True)
class Descent:
    """How to descend (thesis Algorithm 6 and appendix B).

    Args:
        learning_rate: of Adam. epochs: passes over the data. batch: samples per step.
        decay: "none", or "cosine": the learning rate falls along half a cosine to
            (almost) zero in the last epoch.
        force_rate: learning rate of the weights of a neural force; None takes
            ``learning_rate``.
        prune_every: after every so many epochs, coefficients with |xi| < ``threshold``
            in ``prune_slots`` become zero for good; None never prunes. prune_from:
            epoch before which nothing is pruned (the thesis' code: twice
            ``prune_every``); None begins with the first ``prune_every``.
        weight_decay: added to the gradient as weight_decay * parameter, as Adam of
            torch does.
        l1: lambda of |xi| per slot, such as {"H": 0.1, "F": 0.01}; that of H is off
            after the share ``l1_off_after`` of the epochs (the thesis' code: half),
            None keeps it.
        integrator: a name in `phsi_opt.integrators`.
        start: "thesis" (0.2 for polynomials, 1 for other functions and their
            frequencies, 0 for damping: appendix B and the thesis' code), "normal" (N(0,
            0.5^2), thesis Section 5.1) or "model" (the values of the model, zero where
            it has none). Values that a model gives to formulas and to inner parameters
            are kept.
        dtype: "float64", or "float32" as the thesis has it.
        keep_damping_positive: keep the bounds of R; the thesis lets it go negative.
            Other bounds are always kept, by projection after each step.
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

    def __post_init__(self) -> None:
        check_descent(self)
        if self.prune_every is not None:
            require(
                is_count(self.prune_every),
                "prune_every",
                self.prune_every,
                "a whole number of at least 1, or None",
            )
        if self.prune_from is not None:
            require(
                is_count(self.prune_from),
                "prune_from",
                self.prune_from,
                "a whole number of at least 1, or None",
            )
        if self.force_rate is not None:
            require(
                is_size(self.force_rate, positive=True),
                "force_rate",
                self.force_rate,
                "a number above 0, or None",
            )
        require(
            self.decay in DECAYS,
            "decay",
            self.decay,
            f"one of {', '.join(DECAYS)}",
            did_you_mean(self.decay, DECAYS),
        )
        require(
            is_size(self.threshold),
            "threshold",
            self.threshold,
            "a finite number of at least 0",
        )
        for slot in self.prune_slots:
            require(
                slot in ("H", "R", "F"),
                "prune_slots",
                self.prune_slots,
                "slots among 'H', 'R' and 'F'",
            )
        if self.l1_off_after is not None:
            share = is_size(self.l1_off_after) and self.l1_off_after <= 1
            require(
                share,
                "l1_off_after",
                self.l1_off_after,
                "a share of the epochs between 0 and 1, or None",
            )
        require(
            self.start in STARTS,
            "start",
            self.start,
            f"one of {', '.join(STARTS)}",
            did_you_mean(self.start, STARTS),
        )
        object.__setattr__(self, "l1", MappingProxyType(l1_weights(self.l1)))
        object.__setattr__(self, "prune_slots", tuple(self.prune_slots))

    def rate(self, epoch: int) -> float:
        """Learning rate in an epoch, counted from 1."""
        share = (epoch - 1) / self.epochs
        return self.learning_rate * (
            1.0 if self.decay == "none" else (1 + cos(pi * share)) / 2
        )

    def __reduce__(self) -> tuple[Any, ...]:  # a mappingproxy cannot be pickled
        return _descent, ({**vars(self), "l1": dict(self.l1)},)


def _descent(parts: dict[str, Any]) -> Descent:
    return Descent(**parts)


@dataclass(frozen=True)
class JointForce:
    """A force by a network beside the dictionary (the thesis' hybrid, Section 6.4): F_i
    = net(variables).

    Args:
        equations: states in whose equations it acts. variables: states, inputs or "t"
            that it sees.
        hidden: widths of the hidden layers, with ReLU. penalty: weight of the mean of
            |F| over the batch.
        first: function of the first hidden layer, "relu" (the text of the thesis) or
            "tanh" (its code, which has two hidden layers); with a large learning rate,
            a narrow input and only ReLU, units die.
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
            require(
                len(set(listed)) == len(listed) > 0,
                name,
                given,
                "at least one name, and each only once",
            )
            object.__setattr__(self, name, listed)
        require(
            all(is_count(width) for width in self.hidden),
            "hidden",
            self.hidden,
            "widths of at least 1",
        )
        object.__setattr__(self, "hidden", tuple(self.hidden))
        require(
            is_size(self.penalty),
            "penalty",
            self.penalty,
            "a finite number of at least 0",
        )


def check_descent(settings: Any) -> None:
    """Check what all descents have in common; raises `ModelError`."""
    require(
        is_size(settings.learning_rate, positive=True),
        "learning_rate",
        settings.learning_rate,
        "a number above 0",
    )
    for name in ("epochs", "batch"):
        require(
            is_count(getattr(settings, name)),
            name,
            getattr(settings, name),
            "a whole number of at least 1",
        )
    require(
        is_size(settings.weight_decay),
        "weight_decay",
        settings.weight_decay,
        "a finite number of at least 0",
    )
    require(
        settings.dtype in DTYPES, "dtype", settings.dtype, f"one of {', '.join(DTYPES)}"
    )
    if hasattr(settings, "integrator"):
        integrator(settings.integrator)


def require(fine: bool, name: str, value: Any, expected: str, hint: str = "") -> None:
    """Raise `ModelError` that names the setting, its value and what is expected."""
    if not fine:
        raise ModelError(
            f"{name}={value!r} is not possible; expected {expected}.{hint}"
        )


def is_count(value: Any) -> bool:
    """Whether the value is a whole number of at least 1."""
    return (
        isinstance(value, int | np.integer)
        and not isinstance(value, bool)
        and bool(value >= 1)
    )


def is_size(value: Any, positive: bool = False) -> bool:
    """Whether the value is a finite number of at least (or above) zero."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return bool(np.isfinite(value) and (value > 0 if positive else value >= 0))
