"""The measurements of the examples that the page opens at a press.

Both machines are integrated by SciPy, without the package, and have one thing in them
that the model of their study file does not know. The third example is the demonstration
(`friction_spring`). Run as a script, it writes the files.

    python -m problems.examples.page_examples
"""

from pathlib import Path

import numpy as np
import pandas as pd

from problems.examples.docs_data import SEED, solved

FOLDER = Path(__file__).parents[2] / "phsi_opt" / "study_file" / "examples"


def motor() -> pd.DataFrame:
    """Three runs of a motor under steps of voltage; its dry friction is hidden.

    dw/dt = (K u - b w - f sign(w)) / J, J = 0.05 kg m^2
    """
    gain = 2.4  # K/J, rad/s^2 per volt: K = 0.12 N m/V
    drag = 1.5  # b/J, 1/s: b = 0.075 N m s/rad
    friction = 3.0  # f/J, rad/s^2: f = 0.15 N m
    rng = np.random.default_rng(SEED)
    t = np.arange(0.0, 8.0, 0.04)  # s
    parts = []
    for number in range(1, 4):
        u = np.repeat(rng.uniform(-12.0, 12.0, size=8), 25)  # V, a step each second

        def rates(now: float, x: np.ndarray, u: np.ndarray = u) -> list[float]:
            push = gain * u[min(int(now / 0.04 + 1e-9), len(u) - 1)]
            return [push - drag * x[0] - friction * np.tanh(x[0] / 0.01)]

        w = solved(rates, t, [0.0], step=0.01)[:, 0] + 0.2 * rng.normal(size=len(t))
        columns = {"run": f"run {number}", "t_s": t, "voltage_V": u, "speed_rad_s": w}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True).round(3)


def house() -> pd.DataFrame:
    """Six days of a heated room; that its walls store heat is hidden.

    dT/dt = (Ta - T)/tau + g P + (W - T)/wall, dW/dt = (T - W)/storage
    """
    tau = 25.0  # h
    g = 1.2  # K per kWh
    wall = 4.0  # h
    storage = 15.0  # h
    rng = np.random.default_rng(SEED)
    t = np.arange(0.0, 144.0, 0.5)  # h
    outside = 4.0 + 3.0 * np.sin(2 * np.pi * (t - 9.0) / 24.0)
    outside = outside + 0.4 * np.cumsum(rng.normal(size=len(t)))  # the weather
    heater = np.repeat(rng.choice([0.0, 2.5], size=len(t) // 6), 6)  # kW, for 3 h

    def rates(now: float, x: np.ndarray) -> list[float]:
        air = np.interp(now, t, outside)
        power = heater[min(int(now / 0.5 + 1e-9), len(heater) - 1)]
        room = (air - x[0]) / tau + g * power + (x[1] - x[0]) / wall
        return [room, (x[0] - x[1]) / storage]

    inside = solved(rates, t, [19.0, 18.0], step=0.1)[:, 0]
    inside = inside + 0.05 * rng.normal(size=len(t))
    columns = {"t_h": t, "room_C": inside, "outside_C": outside, "heater_kW": heater}
    return pd.DataFrame(columns).round(3)


FILES = {"motor/motor.csv": motor, "house/house.csv": house}


if __name__ == "__main__":
    for name, table in FILES.items():
        table().to_csv(FOLDER / name, index=False)
        print(f"wrote {name}")
