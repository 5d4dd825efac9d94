"""A free run that hardly moves beside measurements that do.

That is how a fit ends whose parameters began too far off: a motion that is out of step
with the measurements costs more than none, so that it dies out. Every criterion of the
solver is met there; what such a model lacks cannot be told.
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import FLAT_FIT_PERCENT, FLAT_NOISE, FLAT_SPREAD


def is_flat(measured: np.ndarray, shown: np.ndarray, noise: float) -> bool:
    """Whether what a run shows of a state hardly moves, and explains next to nothing.

    Args:
        measured: (n_values,) measured values of the state.
        shown: (n_values,) what the run shows at the same times.
        noise: standard deviation of the measurement noise.
    """
    spread = float(np.std(measured))
    moves = noise < FLAT_NOISE * spread
    rmse = float(np.sqrt(np.mean((measured - shown) ** 2)))
    explains = rmse < (1 - FLAT_FIT_PERCENT / 100) * spread
    return moves and not explains and float(np.std(shown)) < FLAT_SPREAD * spread


def flat_sentence(states: Sequence[str]) -> str:
    """What to do where the free run of ``states`` is flat; empty without any."""
    if not states:
        return ""
    names = " and ".join(states)
    return (
        f"The free run of {names} is flat: it hardly moves and explains next to "
        "nothing of what was measured. The parameters are probably those of a wrong "
        "optimum, and what the model lacks cannot be told from it. Give the parameters "
        "other values to start from."
    )
