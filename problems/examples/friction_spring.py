"""A damped spring with a hidden Coulomb friction: the truth of the demonstration, and
its measurements.

    dq/dt = p/m
    dp/dt = -k q - c p/m - f sign(p)

Run as a script, it writes the CSV file that `demo.py` reads: only the position, with
noise of 2 % of its range.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

TRUTH = {"k": 40.0, "m": 2.5, "c": 0.8, "f": 2.0}  # N/m, kg, N s/m, N
STARTS = [
    (0.05, 8.0),
    (-0.9, 0.0),
    (0.6, 5.0),
    (0.9, -4.0),
    (0.3, 9.0),
    (-1.0, -2.0),
    (1.1, 0.0),
    (-0.7, 6.0),
]  # m, kg m/s
TIMES = np.linspace(0.0, 5.0, 201)  # s
NOISE = 0.02  # of the range of the position
CSV = Path(__file__).parent / "data" / "friction_spring.csv"


def simulated(
    friction: float = TRUTH["f"], starts: list[tuple[float, float]] = STARTS
) -> list[np.ndarray]:
    """True states (n_samples, 2) of every run; the friction is sharp to a thousandth of
    a metre per second.
    """

    def f(t: float, x: np.ndarray) -> list[float]:
        v = x[1] / TRUTH["m"]
        return [v, -TRUTH["k"] * x[0] - TRUTH["c"] * v - friction * np.tanh(v / 1e-3)]

    options = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-10, "max_step": 0.01}
    return [
        solve_ivp(f, (TIMES[0], TIMES[-1]), start, t_eval=TIMES, **options).y.T
        for start in starts
    ]


def table(
    seed: int, friction: float = TRUTH["f"], noise: float = NOISE
) -> pd.DataFrame:
    """The measurements as a table: run, t_s, position_m."""
    rng = np.random.default_rng(seed)
    runs = simulated(friction)
    deviation = noise * np.ptp(np.concatenate([x[:, 0] for x in runs]))
    parts = [
        pd.DataFrame(
            {
                "run": f"run {i + 1}",
                "t_s": TIMES,
                "position_m": x[:, 0] + deviation * rng.normal(size=len(x)),
            }
        )
        for i, x in enumerate(runs)
    ]
    return pd.concat(parts, ignore_index=True)


if __name__ == "__main__":
    CSV.parent.mkdir(exist_ok=True)
    table(seed=0).round(6).to_csv(CSV, index=False)
    print(f"wrote {CSV.name}")
