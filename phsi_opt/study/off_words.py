"""How far a free run is off, by channel: beside what was measured, and beside noise.

Every channel is told on one scale, the share of its own movement, so that the error,
the noise and the channels can be compared with each other.
"""

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.numbers import number
from phsi_opt.statistics import TINY

MOST_CHANNELS = 3  # that are told, the worst first
# Errors over the noise floor: of training data that are fitted to the noise, and of
# data held out that are not foretold.
NEAR_FLOOR = 1.1
FAR_ABOVE_FLOOR = 2.0
PERCENT = 100.0  # of a whole


def off_words(judged: Comparison) -> list[str]:
    """Such as "q by 0.122 rad (6.7 % of its movement; noise alone 0.1 %)".

    Each of the channels that are farthest off, the worst first.
    """
    table = judged.table
    shares = PERCENT - table["fit_percent"].to_numpy(dtype=float)
    worst = np.argsort(-np.nan_to_num(shares), kind="stable")[:MOST_CHANNELS]
    return [_channel_words(table.iloc[k]) for k in worst.tolist()]


def _channel_words(row: pd.Series) -> str:
    rmse = float(row["rmse"])
    share = PERCENT - float(row["fit_percent"])
    noise = share * float(row["noise_floor"]) / max(rmse, TINY)
    size = f"{number(rmse, 3)}{spaced(str(row['unit']))}"
    beside = f"{number(share, 2)} % of its movement"
    if share >= PERCENT:
        beside = f"{number(share, 3)} % of its movement: a constant would do better"
    return f"{row['state']} by {size} ({beside}; noise alone {number(noise, 2)} %)"


def only_follows(trained: Comparison, judged: Comparison) -> bool:
    """Whether a model fits its training data to the noise, and no other data."""
    floor = judged.noise_floor
    is_fitted = trained.rmse < NEAR_FLOOR * floor
    return is_fitted and judged.rmse > FAR_ABOVE_FLOOR * floor


def judged_words(is_held_out: bool) -> str:
    """On which data an error is."""
    return "data not used for fitting" if is_held_out else "the training data"
