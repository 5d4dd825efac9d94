"""Evidence for a larger model: the fall of an error is judged against its floor."""

from types import SimpleNamespace

import numpy as np

from phsi_opt.comparison.model_selection import falls_or_explains_most


class _Errors:
    """As much of a comparison as the test of a fall looks at."""

    def __init__(self, residuals: np.ndarray, floor: float) -> None:
        self.residuals, self.weights, self.noise_floor = (
            (residuals[:, None],),
            np.ones(1),
            floor,
        )
        self.data = SimpleNamespace(
            trajectories=(SimpleNamespace(x=residuals[:, None]),)
        )
        self.squares, self.rmse = residuals**2, float(np.sqrt(np.mean(residuals**2)))


def test_most_of_an_error_at_the_noise_floor_is_nothing() -> None:
    rng = np.random.default_rng(1)
    accepted = 0
    for _ in range(200):
        old = rng.normal(size=200)
        new = old + 0.03 * rng.normal(size=200)
        floor = 0.999 * float(np.sqrt(np.mean(old**2)))
        accepted += falls_or_explains_most(_Errors(old, floor), _Errors(new, floor))  # type: ignore[arg-type]
    assert accepted < 20  # 5 % are asked for
    large, half = 3 * rng.normal(size=12), rng.normal(size=12)
    assert falls_or_explains_most(_Errors(large, 0.1), _Errors(half, 0.1))  # type: ignore[arg-type]
