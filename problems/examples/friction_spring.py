"""A damped spring with a hidden Coulomb friction: the truth of the demonstration, and
its measurements.

    dq/dt = p/m
    dp/dt = -k q - c p/m - f sign(p)

Run as a script, it writes the CSV file that the demonstration reads: only the position,
with noise of 2 % of its range.

    python -m problems.examples.friction_spring
"""

from pathlib import Path

import numpy as np
import pandas as pd

from problems.tools.simulation import integrated

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
SHARPNESS = 1e-3  # m/s, over which the friction turns
CSV = Path(__file__).parent / "data" / "friction_spring.csv"


def simulated(
    friction: float = TRUTH["f"], starts: list[tuple[float, float]] = STARTS
) -> list[np.ndarray]:
    """True states (n_samples, 2) of every run.

    The friction is sharp to a thousandth of a metre per second.
    """

    def rates(t: float, x: np.ndarray) -> list[float]:
        v = x[1] / TRUTH["m"]
        force = -TRUTH["k"] * x[0] - TRUTH["c"] * v - friction * np.tanh(v / SHARPNESS)
        return [v, force]

    options = {"rtol": 1e-8, "atol": 1e-10, "max_step": 0.01}
    return [integrated(rates, TIMES, start, "LSODA", **options) for start in starts]


def table(seed: int, friction: float = TRUTH["f"]) -> pd.DataFrame:
    """The measurements as a table: run, t_s, position_m."""
    rng = np.random.default_rng(seed)
    runs = simulated(friction)
    positions = [x[:, 0] for x in runs]
    deviation = NOISE * np.ptp(np.concatenate(positions))
    parts = []
    for number, q in enumerate(positions, start=1):
        measured = q + deviation * rng.normal(size=len(q))
        columns = {"run": f"run {number}", "t_s": TIMES, "position_m": measured}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


if __name__ == "__main__":
    CSV.parent.mkdir(exist_ok=True)
    table(seed=0).round(6).to_csv(CSV, index=False)
    print(f"wrote {CSV.name}")
