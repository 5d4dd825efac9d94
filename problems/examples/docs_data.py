"""The small files of measurements that the pages in docs/ read, and those of the
examples that the page opens at a press.

Each machine is integrated by SciPy, without the package, and has one thing in it that
the model on its page does not know. Run as a script, it writes the files.

    python -m problems.examples.docs_data
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from problems.examples import friction_spring
from problems.tools.simulation import integrated

FOLDER = Path(__file__).parents[2] / "docs" / "data"
PAGE_FOLDER = Path(__file__).parents[2] / "phsi_opt" / "study_file" / "examples"
SEED = 1

Rates = Callable[[float, np.ndarray], list[float]]


def solved(rates: Rates, t: np.ndarray, start: list[float], step: float) -> np.ndarray:
    """States (n_samples, n_states) at the times; no step is longer than ``step``."""
    options = {"max_step": step, "rtol": 1e-8, "atol": 1e-10}
    return integrated(rates, t, start, "LSODA", **options)


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


def winter(
    rng: np.random.Generator, t: np.ndarray, power: float
) -> tuple[np.ndarray, np.ndarray]:
    """The temperature outside (degC), and a heater (kW) that is on or off for 3 h."""
    outside = 4.0 + 3.0 * np.sin(2 * np.pi * (t - 9.0) / 24.0)
    outside = outside + 0.4 * np.cumsum(rng.normal(size=len(t)))  # the weather
    return outside, np.repeat(rng.choice([0.0, power], size=len(t) // 6), 6)


def house() -> pd.DataFrame:
    """A room with a heater; the page forgets the sun through its window at first.

    dT/dt = (Ta - T)/tau + g P + a I
    """
    tau = 20.0  # h
    g = 0.9  # K per kWh
    a = 0.8  # K m2 per kWh
    rng = np.random.default_rng(SEED)
    t = np.arange(0.0, 144.0, 0.5)  # h, six days
    outside, heater = winter(rng, t, power=1.5)
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


def drive() -> pd.DataFrame:
    """A motor that turns a load through a flexible shaft; the dry friction is hidden.

    L di/dt = u - R i - K w1, J1 dw1/dt = K i - T, J2 dw2/dt = T - b w2 - f sign(w2)
    with the torque T = k (phi1 - phi2) + d (w1 - w2) of the shaft
    """
    R = 1.0  # Ohm
    L = 0.02  # H
    K = 0.3  # V s/rad
    J1 = 0.01  # kg m2
    J2 = 0.03  # kg m2
    k = 15.0  # N m/rad
    d = 0.02  # N m s/rad
    b = 0.02  # N m s/rad
    f = 0.2  # N m
    rng = np.random.default_rng(SEED)
    t = np.linspace(0.0, 4.0, 401)  # s
    u = np.repeat(rng.uniform(-6.0, 6.0, size=20), 20)
    u = np.append(u, u[-1]).round(2)  # V, a new one every 0.2 s

    def rates(now: float, x: np.ndarray) -> list[float]:
        i, phi1, w1, phi2, w2 = x
        voltage = u[min(int(now / 0.01 + 1e-9), len(u) - 1)]
        shaft = k * (phi1 - phi2) + d * (w1 - w2)
        friction = b * w2 + f * np.tanh(w2 / 0.01)
        electrical = (voltage - R * i - K * w1) / L
        return [electrical, w1, (K * i - shaft) / J1, w2, (shaft - friction) / J2]

    x = solved(rates, t, [0.0] * 5, step=0.001)
    angles = x[:, [1, 3]] + 0.002 * rng.normal(size=(len(t), 2))
    columns = {"t_s": t, "voltage_V": u}
    columns |= {"motor_rad": angles[:, 0], "load_rad": angles[:, 1]}
    return pd.DataFrame(columns).round(4)


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


# --- the examples of the page; the third one is the demonstration (`friction_spring`)


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


def heated_room() -> pd.DataFrame:
    """Six days of a heated room; that its walls store heat is hidden.

    dT/dt = (Ta - T)/tau + g P + (W - T)/wall, dW/dt = (T - W)/storage
    """
    tau = 25.0  # h
    g = 1.2  # K per kWh
    wall = 4.0  # h
    storage = 15.0  # h
    rng = np.random.default_rng(SEED)
    t = np.arange(0.0, 144.0, 0.5)  # h
    outside, heater = winter(rng, t, power=2.5)

    def rates(now: float, x: np.ndarray) -> list[float]:
        air = np.interp(now, t, outside)
        power = heater[min(int(now / 0.5 + 1e-9), len(heater) - 1)]
        room = (air - x[0]) / tau + g * power + (x[1] - x[0]) / wall
        return [room, (x[0] - x[1]) / storage]

    inside = solved(rates, t, [19.0, 18.0], step=0.1)[:, 0]
    inside = inside + 0.05 * rng.normal(size=len(t))
    columns = {"t_h": t, "room_C": inside, "outside_C": outside, "heater_kW": heater}
    return pd.DataFrame(columns).round(3)


FILES = {
    "spring.csv": spring,
    "cart.csv": cart,
    "tanks.csv": tanks,
    "house.csv": house,
    "servo.csv": servo,
    "drive.csv": drive,
}
PAGE_FILES = {"motor/motor.csv": motor, "house/house.csv": heated_room}


if __name__ == "__main__":
    for folder, files in ((FOLDER, FILES), (PAGE_FOLDER, PAGE_FILES)):
        for name, table in files.items():
            table().to_csv(folder / name, index=False)
            print(f"wrote {name}")
