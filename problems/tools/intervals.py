"""Intervals of 95 %: of an estimate, and of a share that was counted."""

from scipy.stats import binomtest

HALF_WIDTH = 1.959964  # of a normal 95 % interval, in standard errors


def wilson(count: int, n: int) -> tuple[float, float]:
    """Limits of a share that was counted (Wilson)."""
    interval = binomtest(count, n).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def share(count: int, n: int) -> str:
    """A count, its share and the 95 % interval of that (Wilson)."""
    if n == 0:
        return "-"
    lower, upper = wilson(count, n)
    return f"{count} of {n}, {count / n:.0%} ({lower:.0%} to {upper:.0%})"
