"""Two heaters on a board: heat losses, coupling and the sensors' lag.

Data: heaters Q1, Q2 (%) and the temperatures S1, S2 (degC) that two sensors show, 1 s,
ten minutes. The heaters' own temperatures T1, T2 are measured by nobody:

    dT1/dt = loss (Ta - T1) + coupling (T2 - T1) + a1 Q1
    dS1/dt = (T1 - S1)/lag

and the same for the second one. Ta is the temperature of the room.

    python -m problems.measured.heaters [FILE]
"""

from pathlib import Path

import numpy as np

import phsi_opt as ph
from problems.tools.data_paths import folder, given, is_present

FILE = folder("heaters") / "tclab.txt"
STATES = ("S1", "S2", "T1", "T2")
INPUTS = ("Q1", "Q2")
UNITS = {"S1": "degC", "S2": "degC", "T1": "degC", "T2": "degC", "t": "s"}


def load(path: Path) -> ph.Measurements:
    """The record: two sensors, two heaters whose temperature nobody measured."""
    t, Q1, Q2, S1, S2 = np.genfromtxt(
        path, delimiter=",", skip_header=1, usecols=range(5)
    ).T
    nobody = np.full((len(t), 2), np.nan)
    return ph.Measurements.from_arrays(
        t,
        np.column_stack([S1, S2, nobody]),
        np.column_stack([Q1, Q2]),
        states=STATES,
        inputs=INPUTS,
        hold="zero",
        units=UNITS,
    )


def model() -> ph.FirstOrder:
    """Two heaters that lose heat to the room and to each other, two sensors."""
    shared = {
        "loss": ph.Parameter(0.006, lower=0, unit="1/s"),
        "coupling": ph.Parameter(0.002, lower=0, unit="1/s"),
        "Ta": ph.Parameter(20.0, unit="degC"),
    }
    gain1 = ph.Parameter(0.004, lower=0, unit="degC/s")
    gain2 = ph.Parameter(0.002, lower=0, unit="degC/s")
    lag = ph.Parameter(20.0, lower=1, unit="s")
    heater1 = "loss*(Ta - T1) + coupling*(T2 - T1) + a1*Q1"
    heater2 = "loss*(Ta - T2) + coupling*(T1 - T2) + a2*Q2"
    rates = {
        "S1": ph.formula("(T1 - S1)/lag", lag=lag),
        "S2": ph.formula("(T2 - S2)/lag", lag=lag),
        "T1": ph.formula(heater1, a1=gain1, **shared),
        "T2": ph.formula(heater2, a2=gain2, **shared),
    }
    return ph.FirstOrder(STATES, rates, inputs=INPUTS)


def main(path: Path) -> dict[str, float]:
    """The fitted values."""
    if not is_present(path):
        return {}
    fit = ph.identify(model(), load(path))
    print(fit, f"{fit.seconds:.0f} s", sep="\n")
    return dict(fit.values)


if __name__ == "__main__":
    main(given(FILE))
