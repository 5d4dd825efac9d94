"""The small files of measurements that the pages in docs/ read.

Each machine is integrated by SciPy, without the package, and has one thing in it that
the model on its page does not know. Run as a script, it writes the files.

    python -m problems.examples.docs_data
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

from problems.examples import friction_spring

FOLDER = Path(__file__).parents[2] / "docs" / "data"
SEED = 1
RIGHT = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-10}

Rates = Callable[[float, np.ndarray], list[float]]


def solved(rates: Rates, t: np.ndarray, start: list[float], step: float) -> np.ndarray:
    """States (n_samples, n_states) at the times; no step is longer than ``step``."""
    found = solve_ivp(rates, t[[0, -1]], start, t_eval=t, max_step=step, **RIGHT)
    return np.asarray(found.y.T)


def spring() -> pd.DataFrame:
    """Three runs of the demonstration, every second sample: a hidden dry friction."""
    runs = friction_spring.table(seed=0)
    few = runs[runs["run"].isin(["run 1", "run 2", "run 3"])]
    return few.iloc[::2].round(4)


def cart() -> pd.DataFrame:
    """A cart on a spring, pushed by a measured force; its air drag is hidden.

    dq/dt = p/m, dp/dt = -k q - c v - b |v| v + u
    """
    m = 2.0  # kg
    k = 30.0  # N/m
    c = 0.5  # N s/m
    b = 1.5  # N s2/m2
    rng = np.random.default_rng(SEED)
    t = np.linspace(0.0, 12.0, 241)  # s
    u = 12.0 * np.sin(0.25 * t**2 + 2.0 * t)  # N, faster and faster

    def rates(now: float, x: np.ndarray) -> list[float]:
        v = x[1] / m
        push = np.interp(now, t, u)
        return [v, push - k * x[0] - c * v - b * abs(v) * v]

    q = solved(rates, t, [0.0, 0.0], step=0.01)[:, 0]
    measured = q + 0.01 * rng.normal(size=len(t))
    columns = {"t_s": t, "position_m": measured, "force_N": u}
    return pd.DataFrame(columns).round(4)


def tanks() -> pd.DataFrame:
    """Two tanks under a pump; that the upper one overflows is hidden.

    dh1/dt = u - a sqrt(h1) - c max(h1 - limit, 0), dh2/dt = a sqrt(h1) - b sqrt(h2)
    """
    a = 0.35  # dm^0.5 per minute
    b = 0.30
    c = 0.8  # per minute
    limit = 3.0  # dm
    rng = np.random.default_rng(SEED)
    t = np.linspace(0.0, 120.0, 241)  # min
    levels = rng.uniform(0.1, 1.0, size=12)
    u = np.repeat(levels, 20)
    u = np.append(u, levels[-1])  # dm per minute, a new level every ten minutes

    def rates(now: float, x: np.ndarray) -> list[float]:
        pumped = u[min(int(now / 0.5), len(u) - 1)]
        out = a * np.sqrt(max(x[0], 0.0))
        spilled = c * max(x[0] - limit, 0.0)
        return [pumped - out - spilled, out - b * np.sqrt(max(x[1], 0.0))]

    h = solved(rates, t, [1.0, 1.5], step=0.05)
    h = h + 0.02 * rng.normal(size=h.shape)
    columns = {"t_min": t, "h1_dm": h[:, 0], "h2_dm": h[:, 1], "pump_dm_min": u}
    return pd.DataFrame(columns).round(4)


def house() -> pd.DataFrame:
    """A room with a heater; the page forgets the sun through its window at first.

    dT/dt = (Ta - T)/tau + g P + a I
    """
    tau = 20.0  # h
    g = 0.9  # K per kWh
    a = 0.8  # K m2 per kWh
    rng = np.random.default_rng(SEED)
    t = np.arange(0.0, 144.0, 0.5)  # h, six days
    outside = 4.0 + 3.0 * np.sin(2 * np.pi * (t - 9.0) / 24.0)
    outside = outside + 0.4 * np.cumsum(rng.normal(size=len(t)))  # the weather
    heater = np.repeat(rng.choice([0.0, 1.5], size=len(t) // 6), 6)  # kW, for 3 h
    clear_sky = np.maximum(np.sin(2 * np.pi * (t - 6.0) / 24.0), 0.0)
    clouds = np.repeat(rng.uniform(0.2, 1.0, size=len(t) // 4), 4)
    sun = 0.6 * clear_sky * clouds  # kW/m2

    def rates(now: float, x: np.ndarray) -> list[float]:
        air = np.interp(now, t, outside)
        power = np.interp(now, t, heater)
        return [(air - x[0]) / tau + g * power + a * np.interp(now, t, sun)]

    inside = solved(rates, t, [19.0], step=0.1)[:, 0]
    inside = inside + 0.05 * rng.normal(size=len(t))
    columns = {
        "t_h": t,
        "room_C": inside,
        "outside_C": outside,
        "heater_kW": heater,
        "sun_kW_m2": sun,
    }
    return pd.DataFrame(columns).round(3)


def servo() -> pd.DataFrame:
    """A slide under a position controller; its dry friction is hidden.

    m dv/dt = u - c v - f sign(v), u = K (r - q) - D v + a test signal
    """
    m = 4.0  # kg
    c = 6.0  # N s/m
    f = 3.0  # N
    rng = np.random.default_rng(SEED)
    t = np.linspace(0.0, 10.0, 401)  # s
    wanted = np.repeat(rng.uniform(-0.3, 0.3, size=10), 40)
    wanted = np.append(wanted, wanted[-1])
    test = np.repeat(rng.choice([-8.0, 8.0], size=100), 4)
    test = np.append(test, test[-1])
    sensor = 5e-4 * rng.normal(size=len(t))  # m
    state = np.zeros(2)
    q = np.zeros(len(t))
    u = np.zeros(len(t))
    for i in range(len(t)):
        q[i] = state[0] + sensor[i]
        u[i] = 200.0 * (wanted[i] - q[i]) - 20.0 * state[1] + test[i]
        push = u[i]

        def rates(now: float, x: np.ndarray, push: float = push) -> list[float]:
            return [x[1], (push - c * x[1] - f * np.tanh(x[1] / 1e-3)) / m]

        if i + 1 < len(t):
            state = solved(rates, t[i : i + 2], list(state), step=0.005)[-1]
    columns = {"t_s": t, "position_m": q, "setpoint_m": wanted, "drive_N": u}
    return pd.DataFrame(columns).round(5)


FILES = {
    "spring.csv": spring,
    "cart.csv": cart,
    "tanks.csv": tanks,
    "house.csv": house,
    "servo.csv": servo,
}


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, table in FILES.items():
        table().to_csv(FOLDER / name, index=False)
        print(f"wrote {name}")
