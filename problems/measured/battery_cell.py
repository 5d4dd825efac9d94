"""A battery cell: inner resistance and slow voltages from pulses of current.

Data: current I (A, positive while charging) and voltage (V) of one cell, in cycles at
falling charge: a pulse of -30 A, a short rest, a pulse of 22.5 A, 18 min of discharge
at 10 A, an hour of rest. The model, with one or two pairs of a resistor and a
capacitor:

    dv1/dt = (R1 I - v1)/tau1
    dv/dt = I/C + dv1/dt
    shown: v + R0 I

v is the cell's voltage without what falls off at the inner resistance, C stands for the
slope of the voltage at rest in the charge. Nobody measures v1.

Used are the `CYCLES` in the middle of the charge, each a trajectory of its own that
begins in the rest before it. The record tells the current that flowed until a sample,
so each jump is put right after the sample before it, at a point without a voltage. Of
the discharge, sampled each second, every `THIN`-th sample is kept.

    python -m problems.measured.battery_cell [FILE]
"""

from pathlib import Path

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.tools.data_paths import folder, given, is_present

FILE = folder("battery_cell") / "hppc_25c.csv"
PULSE = 6  # the number of the step by which a cycle begins
DISCHARGE = 9
CYCLES = slice(1, 7)  # of ten; the voltage at rest bends most above and below
THIN = 10  # samples of the discharge
N_REST = 5  # samples of the rest before a cycle
RAMP = 1e-3  # s, over which a jump of the current is drawn
JUMP = 1.0  # A, from which a change between two samples is a jump
UNITS = {"v": "V", "v1": "V", "v2": "V", "I": "A", "t": "s"}


def load(path: Path, n_pairs: int = 2) -> ph.Measurements:
    """The cycles in the middle of the charge, for a model with ``n_pairs``."""
    table = pd.read_csv(path, index_col=False)
    step = table["Step"].to_numpy()
    t = table["Time(s)"].to_numpy()
    current = table["Current(A)"].to_numpy()
    voltage = table["Voltage(V)"].to_numpy()
    begins = np.flatnonzero((step[1:] == PULSE) & (step[:-1] != PULSE)) + 1
    ends = np.append(begins[1:], len(t))
    times = []
    states = []
    inputs = []
    for begin, end in zip(begins[CYCLES], ends[CYCLES], strict=True):
        rows = np.arange(begin - N_REST, end)
        rows = rows[_is_kept(step[rows], current[rows])]
        nodes = _with_jumps(t[rows], voltage[rows], current[rows])
        nobody = np.full((len(nodes), n_pairs), np.nan)
        times.append(nodes[:, 0])
        states.append(np.column_stack([nodes[:, 1], nobody]))
        inputs.append(nodes[:, 2])
    return ph.Measurements.from_arrays(
        times,
        states,
        inputs,
        states=_states(n_pairs),
        inputs=["I"],
        units={name: UNITS[name] for name in (*_states(n_pairs), "I", "t")},
    )


def _is_kept(step: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Every ``THIN``-th sample of the discharge, all others, both ends of a jump."""
    is_every = np.arange(len(step)) % THIN == 0
    jumps = np.abs(np.diff(current)) > JUMP
    beside = np.append(jumps, False) | np.append(False, jumps)
    return (step != DISCHARGE) | is_every | beside


def _with_jumps(t: np.ndarray, voltage: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Times, voltages and currents, (n_nodes, 3), with a point after each sample that a
    jump follows: there the next current flows already and the voltage is not known.
    """
    samples = np.column_stack([t, voltage, current])
    before = np.flatnonzero(np.abs(np.diff(current)) > JUMP)
    after = np.column_stack(
        [t[before] + RAMP, np.full(len(before), np.nan), current[before + 1]]
    )
    return np.insert(samples, before + 1, after, axis=0)


def _states(n_pairs: int) -> list[str]:
    return ["v", *(f"v{i}" for i in range(1, n_pairs + 1))]


def model(n_pairs: int = 2) -> ph.FirstOrder:
    """A cell with an inner resistance and one or two slow voltages."""
    resistances = (0.002, 0.003)  # Ohm
    constants = (30.0, 600.0)  # s
    rates = {}
    slow = ""
    parameters: dict[str, ph.Parameter] = {}
    for i in range(1, n_pairs + 1):
        resistance = ph.Parameter(resistances[i - 1], lower=0, unit="Ohm")
        constant = ph.Parameter(constants[i - 1], lower=0.1, upper=1e4, unit="s")
        own = {f"R{i}": resistance, f"tau{i}": constant}
        rate = f"(R{i}*I - v{i})/tau{i}"
        rates[f"v{i}"] = ph.formula(rate, **own)
        slow += f" + {rate}"
        parameters |= own
    capacity = ph.Parameter(3e4, lower=100, unit="A s/V")
    rates["v"] = ph.formula(f"I/C{slow}", C=capacity, **parameters)
    inner = ph.Parameter(0.002, lower=0, unit="Ohm")
    shown = ph.formula("R0*I", R0=inner)
    return ph.FirstOrder(_states(n_pairs), rates, inputs=["I"], sensor={"v": shown})


def main(path: Path) -> dict[str, dict[str, float]]:
    """The fitted values with one pair and with two."""
    if not is_present(path):
        return {}
    values = {}
    for n_pairs in (1, 2):
        fit = ph.identify(model(n_pairs), load(path, n_pairs))
        print(fit, f"{fit.seconds:.0f} s", sep="\n", flush=True)
        values[f"pairs: {n_pairs}"] = dict(fit.values)
    return values


if __name__ == "__main__":
    main(given(FILE))
