"""Parameters: the numbers of a model, with bounds and a way to find their start.

A parameter that has no value yet may carry a *guess*: a recipe by which its start is
found in the data (a scan of frequencies, a share of a typical size, several values of
which the best is kept). The recipes are only stated here; ``initialization`` follows
them.
"""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.arguments import typed
from phsi_opt.errors import ModelError
from phsi_opt.presentation.numbers import short_repr


@dataclass(frozen=True)
class Scan:
    """Start by scanning frequencies: that whose sine and cosine explain the data best.

    Args:
        variable: what the wave runs along; the frequency is in rad per unit of it.
    """

    variable: str = "t"


@dataclass(frozen=True)
class Share:
    """Start at a share of the root mean square of an expression over the data.

    Args:
        of: the expression, such as the velocity ``"dH_dp"``.
        share: the start in units of that root mean square.
        sharper: factors by which a fit makes a guessed width smaller, one after the
            other, while that fits better.
    """

    of: str
    share: float
    sharper: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "sharper", tuple(map(float, self.sharper)))


@dataclass(frozen=True)
class Tried:
    """Start by trying several values and keeping the best.

    Args:
        of: an expression; the values are shares of its largest absolute value in the
            data. Of ``"t"`` they are shares of the duration of a record, of ``"dt"``
            multiples of the time between samples.
        shares: the values to try.
        most: upper bound, as a share too; a rim above every level has no slope by which
            a solver finds back.
    """

    of: str
    shares: tuple[float, ...]
    most: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "shares", tuple(map(float, self.shares)))
        object.__setattr__(self, "most", float(self.most))


@typed
@dataclass(frozen=True)
class Parameter:
    """A named number of the model.

    Args:
        value: the starting value, or the value itself if ``fixed``; None: the starting
            value comes from the data (by ``guess``) or is zero.
        lower: lower bound, which the solver respects.
        upper: upper bound.
        unit: of its numbers, such as ``"N/m"``; one that contradicts the units of the
            data is refused.
        fixed: whether the value is known and not estimated.
        guess: rule that takes the starting value from the data.
        per_trajectory: whether every trajectory has its own value, such as a load that
            changes between runs. On runs that were not fitted, the value is estimated
            like the starting states (see ``compare``).
        prior: mean and standard deviation of what is known of it, such as from a data
            sheet; it counts as one more measurement, ((value - mean)/deviation)^2 in
            the deviance. The start is its mean where no value is given.

    Raises:
        ModelError: a value that is not finite or outside the bounds, crossed bounds, a
            prior whose mean is outside the bounds or whose deviation is not positive,
            or choices that contradict each other.

    Examples:
        >>> ph.Parameter(40.0, lower=0, unit="N/m")
        Parameter(value=40.0, lower=0.0, unit='N/m')
    """

    value: float | None = None
    lower: float = -np.inf
    upper: float = np.inf
    unit: str = ""
    fixed: bool = False
    guess: Scan | Share | Tried | None = None
    per_trajectory: bool = False
    prior: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "value"):
            given = getattr(self, name)
            if given is not None:
                number = float(given)
                if np.isnan(number) or (name == "value" and np.isinf(number)):
                    raise ModelError(f"parameter {name}={number} is not finite.")
                object.__setattr__(self, name, number)
        if not self.lower <= self.upper:
            raise ModelError(
                f"parameter bounds are crossed: lower={self.lower:g} is above "
                f"upper={self.upper:g}; swap them."
            )
        if self.prior is not None:
            given = tuple(map(float, self.prior))
            mean, deviation = given if len(given) == 2 else (np.nan, np.nan)
            is_fine = self.lower <= mean <= self.upper and 0 < deviation < np.inf
            if not (is_fine and np.isfinite(mean)):
                raise ModelError(
                    f"parameter prior={self.prior!r} is none; expected its mean, "
                    f"finite and within [{self.lower:g}, {self.upper:g}], and a "
                    "standard deviation above zero."
                )
            object.__setattr__(self, "prior", (mean, deviation))
            if self.value is None and self.guess is None:
                object.__setattr__(self, "value", mean)
        if self.value is not None and not self.lower <= self.value <= self.upper:
            raise ModelError(
                f"parameter value {self.value:g} lies outside its bounds "
                f"[{self.lower:g}, {self.upper:g}]; move the value or widen the bounds."
            )
        if self.fixed and self.per_trajectory:
            raise ModelError(
                "a parameter per trajectory is estimated; it cannot be fixed."
            )
        if self.per_trajectory and isinstance(self.guess, Scan):
            raise ModelError(
                "a scanned frequency is common to all trajectories; with "
                "per_trajectory=True give a starting value instead of Scan."
            )
        if self.fixed and self.value is None and self.guess is None:
            raise ModelError(
                "a fixed parameter needs a value: Parameter(2.5, fixed=True)."
            )

    def __repr__(self) -> str:
        return short_repr(self)

    def nearest_bound(self, value: float) -> float:
        """The bound at which an estimate ended; a solver stops slightly inside it."""
        bounds = [one for one in (self.lower, self.upper) if np.isfinite(one)]
        return min(bounds, key=lambda bound: abs(value - bound), default=value)

    @property
    def start(self) -> float:
        """Starting value, the given one or else the point nearest to zero."""
        if self.value is not None:
            return self.value
        return float(np.clip(0.0, self.lower, self.upper))


def with_value(parameter: Parameter, value: float) -> Parameter:
    """The parameter at the value, or at the bound nearest to it."""
    # A solver may stop a rounding error outside a bound; the record must satisfy its
    # own bounds.
    within = float(np.clip(value, parameter.lower, parameter.upper))
    return replace(parameter, value=within)
