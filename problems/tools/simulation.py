"""True motions by SciPy, without the package."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


def integrated(
    rates: Callable[[float, Any], Any],
    t: np.ndarray,
    start: Sequence[float] | np.ndarray,
    method: str = "DOP853",
    **options: Any,
) -> np.ndarray:
    """States (n_samples, n_states) at the times; fewer samples where it ends early.

    ``options``: of `solve_ivp`, such as the tolerances.
    """
    return solve_ivp(rates, (t[0], t[-1]), start, method, t, **options).y.T
