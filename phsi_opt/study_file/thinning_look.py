"""How many neighbouring samples of a long record could become their mean.

Means must keep what the states do: of measured records with some 10,000 lines, means
down to 2,000 kept 0.98 of the variance and more; of a fast oscillator (Silverbox,
131,072 lines) they kept 0.005.
"""

import numpy as np

MANY_LINES = 5000  # of a run, from which a study takes long
FEW_LINES = 2000  # of a run, as many or a little more, that thinning leaves then
VARIANCE_KEPT = 0.95  # share of a state's variance that must be left in the means


def is_long(n_lines: int, n_runs: int) -> bool:
    """Whether the runs of a table have many lines."""
    return n_lines / n_runs > MANY_LINES


def thinning_of(states: list[np.ndarray], n_lines: int, n_runs: int) -> int:
    """How many samples could become one; 1 where runs are short, or means lose much.

    Args:
        states: the values of each, (n_lines,), NaN where missing.
        n_lines: of the table.
        n_runs: of equal length, as it is taken.
    """
    if not is_long(n_lines, n_runs):
        return 1
    n = n_lines // n_runs // FEW_LINES
    while n > 1 and not all(_is_kept(values, n) for values in states):
        n //= 2
    return n


def _is_kept(values: np.ndarray, n: int) -> bool:
    """Whether means of n neighbours have nearly the variance of the samples."""
    known = values[np.isfinite(values)]
    n_groups = len(known) // n
    if n_groups < 2:
        return False
    means = known[: n_groups * n].reshape(n_groups, n).mean(axis=1)
    return bool(np.var(means) >= VARIANCE_KEPT * np.var(known))
