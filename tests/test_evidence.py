"""Whether a model fails, and whether a larger one leaves noise alone."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from phsi_opt import criteria
from phsi_opt.comparison import compare as evidence


def fit(deviance: float, n_names: int, n_values: int = 400) -> Any:
    """As much of a fit as evidence looks at."""
    bic = deviance + n_names * np.log(n_values)
    return SimpleNamespace(names=("a",) * n_names, n_values=n_values, bic=bic)


def test_the_deviance_is_bic_without_its_price() -> None:
    assert evidence.deviance(fit(-100.0, 2)) == pytest.approx(-100.0)


def judged(rmse: float, floor: float, whiteness: tuple[float, ...] = (0.5,)) -> Any:
    return SimpleNamespace(
        rmse=rmse,
        noise_floor=floor,
        table=pd.DataFrame({"whiteness": whiteness}),
        record=SimpleNamespace(
            has_correlated_noise=False, shows_correlated_noise=False
        ),
    )


def test_the_share_explained_is_of_the_square_above_the_floor() -> None:
    assert evidence.explained_share(judged(5, 3), judged(4, 3)) == pytest.approx(9 / 16)
    assert evidence.explained_share(judged(5, 3), judged(3, 3)) == pytest.approx(1.0)
    assert evidence.explained_share(judged(3, 3), judged(4, 3)) < -1e6


def test_a_run_fails_beyond_a_share_of_its_floor() -> None:
    limit = criteria.FAILING_ERROR * 2.0
    assert not evidence.is_failing(judged(limit, 2.0))
    assert evidence.is_failing(judged(limit * 1.001, 2.0))


def test_noise_is_small_and_white_in_all_channels_together() -> None:
    small = criteria.WHITE_ERROR * 2.0 * 0.999
    level = criteria.SURE_LEVEL
    assert evidence.is_like_noise(judged(small, 2.0))
    assert not evidence.is_like_noise(judged(small * 1.002, 2.0))
    assert evidence.is_like_noise(judged(small, 2.0, (level / 2 * 1.01, 0.5)))
    assert not evidence.is_like_noise(judged(small, 2.0, (level / 2 * 0.99, 0.5)))
    lasting = judged(small, 2.0, (1e-9, np.nan))
    assert not evidence.is_like_noise(lasting)
    lasting.record.has_correlated_noise = True
    assert evidence.is_like_noise(lasting)
    # What an effect leaves lasts as noise only where noise did so before.
    before = judged(9.0, 1.0)
    assert not evidence.is_white_noise(lasting)
    assert not evidence.is_explained(before, lasting, judged(5.0, 1.0))
    before.record.shows_correlated_noise = True
    assert evidence.is_explained(before, lasting, judged(5.0, 1.0))
    assert evidence.is_white_noise(judged(small, 2.0))
    assert not evidence.is_white_noise(judged(small * 1.002, 2.0))


def test_what_is_left_is_like_noise_or_small_and_most_of_it_explained() -> None:
    white, coloured = judged(1.0, 1.0), judged(1.0, 1.0, (1e-9,))
    base = judged(3.0, 1.0)
    limit = criteria.FAILING_ERROR
    assert evidence.is_explained(base, white, judged(2.9, 1.0))
    assert evidence.is_explained(base, coloured, judged(1.0, 1.0))
    assert not evidence.is_explained(base, coloured, judged(1.01 * limit, 1.0))
    off = judged(1.01 * limit, 1.0, (1e-9,))
    assert not evidence.is_explained(base, off, judged(1.0, 1.0))
    near = judged(0.999 * limit, 1.0)
    assert not evidence.is_explained(near, coloured, judged(0.998 * limit, 1.0))
