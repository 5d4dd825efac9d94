"""Intervals of 95 %: of an estimate, and of a share that was counted."""

from scipy.stats import binomtest

HALF_WIDTH = 1.959964  # of a normal 95 % interval, in standard errors


def share(count: int, n: int) -> str:
    """A share with its 95 % interval (Wilson)."""
    if n == 0:
        return "-"
    interval = binomtest(count, n).proportion_ci(method="wilson")
    return f"{count / n:.0%} ({interval.low:.0%} to {interval.high:.0%})"
