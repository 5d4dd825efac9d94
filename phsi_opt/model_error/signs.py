"""Random signs from a fixed seed, by which traces of inverses are estimated.

For a random sign vector s, the mean of s'As is the trace of A (Hutchinson,
Communications in Statistics 19, 1990). The same signs everywhere make an estimate the
same every time, and smooth in what the matrix depends on.
"""

from functools import lru_cache

import numpy as np

SEED = 0
MOST_SETS = 4  # sets of signs; a search asks for the same ones at every step


@lru_cache(MOST_SETS)
def random_signs(lengths: tuple[int, ...], n: int) -> tuple[np.ndarray, ...]:
    """Signs, (n_values, n) for each of the lengths n_values, read-only."""
    rng = np.random.default_rng(SEED)
    drawn = []
    for length in lengths:
        signs = np.asfortranarray(rng.choice([-1.0, 1.0], (length, n)))
        signs.flags.writeable = False
        drawn.append(signs)
    return tuple(drawn)
