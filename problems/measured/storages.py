"""Measured storages of water, heat and charge: loaders and models.

As in `machines`: a loader and a base model each; states that nobody measured are NaN.
"""

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.measured.machines import positive, with_unmeasured
from problems.tools.data_paths import folder

# --- the cascaded tanks

FULL = 10.0  # V, what the sensor shows at most
TANKS_SHARE = 0.7  # of the fit record, which is fitted in the study


def tanks(record: str = "Est", most: float = FULL) -> ph.Measurements:
    """Pump voltage u and level h2 of the lower tank (V), every 4 s, 1024 samples;
    record "Val" tests. Nobody measured h1; samples from ``most`` on are missing.
    """
    path = folder("cascaded_tanks") / "dataBenchmark.csv"
    table = np.genfromtxt(path, delimiter=",", names=True)
    y = table[f"y{record}"].copy()
    y[y >= most - 1e-3] = np.nan
    return ph.Measurements.from_arrays(
        4.0 * np.arange(len(y)),
        np.column_stack([np.full(len(y), np.nan), y]),
        table[f"u{record}"][:, None],
        states=["h1", "h2"],
        inputs=["u"],
        hold="zero",
        units={"h1": "V", "h2": "V", "u": "V", "t": "s"},
    )


def textbook_tanks() -> ph.FirstOrder:
    """Pump, two square-root outflows, no overflow."""
    k1, k3, k4 = (ph.Parameter(k, lower=0, upper=1) for k in (0.046, 0.03, 0.024))
    out1 = f"k1*{_root('h1')}"
    rates = {
        "h1": ph.formula(f"k4*u - {out1}", k1=k1, k4=k4),
        "h2": ph.formula(f"{out1} - k3*{_root('h2')}", k1=k1, k3=k3),
    }
    return ph.FirstOrder(["h1", "h2"], rates, inputs=["u"])


def _root(level: str) -> str:
    """A square root of a level, rounded at zero."""
    return f"{level}*({level}**2 + 0.01)**(-0.25)"


# --- two heaters on a board

HEATERS_STATES = ("S1", "S2", "T1", "T2")


def heaters() -> ph.Measurements:
    """Heaters Q1, Q2 (%) and the temperatures S1, S2 (degC) that two sensors show, 1 s,
    ten minutes; the heaters' own temperatures T1, T2 are measured by nobody.
    """
    path = folder("heaters") / "tclab.txt"
    t, Q1, Q2, S1, S2 = np.genfromtxt(
        path, delimiter=",", skip_header=1, usecols=range(5)
    ).T
    return ph.Measurements.from_arrays(
        t,
        with_unmeasured(S1, S2, n=2),
        np.column_stack([Q1, Q2]),
        states=HEATERS_STATES,
        inputs=["Q1", "Q2"],
        hold="zero",
        units=dict.fromkeys(HEATERS_STATES, "degC") | {"t": "s"},
    )


def heaters_model() -> ph.FirstOrder:
    """Two heaters that lose heat to the room (Ta) and to each other, two sensors.

    dT1/dt = loss (Ta - T1) + coupling (T2 - T1) + a1 Q1,   dS1/dt = (T1 - S1)/lag
    """
    shared = {
        "loss": positive(0.006, "1/s"),
        "coupling": positive(0.002, "1/s"),
        "Ta": ph.Parameter(20.0, unit="degC"),
    }
    lag = positive(20.0, "s", 1)
    heater1 = "loss*(Ta - T1) + coupling*(T2 - T1) + a1*Q1"
    heater2 = "loss*(Ta - T2) + coupling*(T1 - T2) + a2*Q2"
    rates = {
        "S1": ph.formula("(T1 - S1)/lag", lag=lag),
        "S2": ph.formula("(T2 - S2)/lag", lag=lag),
        "T1": ph.formula(heater1, a1=positive(0.004, "degC/s"), **shared),
        "T2": ph.formula(heater2, a2=positive(0.002, "degC/s"), **shared),
    }
    return ph.FirstOrder(HEATERS_STATES, rates, inputs=["Q1", "Q2"])


# --- a heated house

HOUSE_INPUTS = ("Ta", "Ps", "Q")


def house() -> ph.Measurements:
    """Indoor temperature Ti and outdoor temperature Ta (degC), solar gain Ps and heat
    delivered Q, every 15 min, six weeks of a winter.

    Time is in hours and heat in the unit of Q, which the set does not tell.
    """
    table = pd.read_csv(folder("building") / "blg_1.csv", sep=";")
    return ph.Measurements.from_arrays(
        0.25 * np.arange(len(table)),
        table[["yTi"]].to_numpy(),
        table[["Ta", "Ps", "Thm"]].to_numpy(),
        states=["Ti"],
        inputs=HOUSE_INPUTS,
        hold="zero",
        units={"Ti": "degC", "Ta": "degC", "t": "h"},
    )


def house_model() -> ph.FirstOrder:
    """Air, furniture and walls as one heat capacity.

    C dTi/dt = (Ta - Ti)/R + A Ps + Q
    """
    parameters = {
        "C": positive(40.0, lower=1e-3),
        "R": positive(1.0, "degC/Q", 1e-3),
        "A": positive(10.0, lower=1e-3),
    }
    rates = {"Ti": ph.formula("((Ta - Ti)/R + A*Ps + Q)/C", **parameters)}
    return ph.FirstOrder(["Ti"], rates, inputs=HOUSE_INPUTS)


# --- a battery cell

CELL_FILE = "hppc_25c.csv"
CELL_STATES = ("v", "v1")
PULSE = 6  # the number of the step by which a cycle begins
DISCHARGE = 9
CYCLES = slice(1, 7)  # of ten; the voltage at rest bends most above and below
THIN = 10  # samples of the discharge, which is sampled each second
N_REST = 5  # samples of the rest before a cycle
RAMP = 1e-3  # s, over which a jump of the current is drawn
JUMP = 1.0  # A, from which a change between two samples is a jump


def cell() -> ph.Measurements:
    """Current I (A, positive while charging) and voltage (V) of one cell, in cycles at
    falling charge: a pulse of -30 A, a short rest, a pulse of 22.5 A, 18 min of
    discharge at 10 A, an hour of rest.

    Used are the `CYCLES` in the middle of the charge, each a trajectory that begins in
    the rest before it. The record tells the current that flowed until a sample, so each
    jump is put right after the sample before it, at a point without a voltage.
    """
    table = pd.read_csv(folder("battery_cell") / CELL_FILE, index_col=False)
    step = table["Step"].to_numpy()
    columns = table[["Time(s)", "Voltage(V)", "Current(A)"]].to_numpy()
    begins = np.flatnonzero((step[1:] == PULSE) & (step[:-1] != PULSE)) + 1
    ends = np.append(begins[1:], len(step))
    cycles = []
    for begin, end in zip(begins[CYCLES], ends[CYCLES], strict=True):
        rows = np.arange(begin - N_REST, end)
        is_jump = np.abs(np.diff(columns[rows, 2])) > JUMP
        at_jump = np.append(is_jump, False) | np.append(False, is_jump)
        is_every = np.arange(len(rows)) % THIN == 0
        rows = rows[(step[rows] != DISCHARGE) | is_every | at_jump]
        samples = columns[rows]
        before = np.flatnonzero(np.abs(np.diff(samples[:, 2])) > JUMP)
        after = with_unmeasured(samples[before, 0] + RAMP, n=2)
        after[:, 2] = samples[before + 1, 2]
        cycles.append(np.insert(samples, before + 1, after, axis=0))
    return ph.Measurements.from_arrays(
        [nodes[:, 0] for nodes in cycles],
        [with_unmeasured(nodes[:, 1]) for nodes in cycles],
        [nodes[:, 2] for nodes in cycles],
        states=CELL_STATES,
        inputs=["I"],
        units=dict.fromkeys(CELL_STATES, "V") | {"I": "A", "t": "s"},
    )


def cell_model() -> ph.FirstOrder:
    """An inner resistance R0, and one pair of a resistor and a capacitor.

        dv1/dt = (R1 I - v1)/tau1,   dv/dt = I/C + dv1/dt,   shown: v + R0 I

    v is the voltage without what falls off at the inner resistance, C stands for the
    slope of the voltage at rest in the charge.
    """
    tau = ph.Parameter(30.0, lower=0.1, upper=1e4, unit="s")
    pair = {"R1": positive(0.002, "Ohm"), "tau1": tau}
    rate = "(R1*I - v1)/tau1"
    capacity = positive(3e4, "A s/V", 100)
    rates = {
        "v": ph.formula(f"I/C + {rate}", C=capacity, **pair),
        "v1": ph.formula(rate, **pair),
    }
    shown = ph.formula("R0*I", R0=positive(0.002, "Ohm"))
    return ph.FirstOrder(CELL_STATES, rates, inputs=["I"], sensor={"v": shown})
