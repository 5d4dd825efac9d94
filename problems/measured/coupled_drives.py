"""The coupled electric drives: a belt between two drums, and a sensor without a sign.

Data: the voltage u of the motors (a random binary sequence) and the size z of the
pulley's speed, 20 ms, three records of 500 samples at amplitudes 1, 1.5 and 0.5 V. The
model, in the sensor's unit and for drums of unit inertia:

    dw/dt = b u - d w - k s
    ds/dt = w - v/J
    dv/dt = k s
    shown: z = |v|

w is the drum's speed, s the stretch of the belt, v the pulley's momentum.

A fit of z itself through a sensor |v| ends far from the best signs. So the sign of each
sample is taken from a simulation of the model at the values in `START`, from rest,
which follows every swing of the three records; changes of sign are then moved to the
nearest place where the signed speed is smooth. `START` was found by giving the first
120 samples signs that continue their slope, fitting them, and repeating both on the
whole records with simulated signs until no sign changed.

    python -m problems.measured.coupled_drives [FILE]
"""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

import phsi_opt as ph
from problems.tools.data_paths import folder, given, is_present

FILE = folder("coupled_drives") / "drive.mat"
SAMPLING = 0.02  # s
RECORDS = (1, 2, 3)
STATES = ("v", "s", "w")
INPUTS = ("u",)
REACH = 4  # samples; the simulation runs ahead or behind by up to three
START = {"k": 240.0, "J": 1.15, "d": 12.0, "b": 27.0}


def load(path: Path) -> ph.Measurements:
    """The three records with the signs of a simulation, each a trajectory."""
    content = loadmat(path)
    t = SAMPLING * np.arange(len(content["z1"]))
    nobody = np.full((len(t), 2), np.nan)
    states = []
    inputs = []
    for record in RECORDS:
        u = content[f"u{record}"].ravel()
        size = content[f"z{record}"].ravel()
        states.append(np.column_stack([size * _sign(t, u, size), nobody]))
        inputs.append(u)
    return ph.Measurements.from_arrays(
        [t] * len(RECORDS),
        states,
        inputs,
        states=STATES,
        inputs=INPUTS,
        hold="zero",
        units={"v": "V", "u": "V", "t": "s"},
    )


def _sign(t: np.ndarray, u: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Which way the pulley turns, (n_samples,).

    As the simulation, but each change of sign moved by up to `REACH` samples to where
    the signed speed bends least.
    """
    at_rest = np.zeros(len(STATES))
    v = ph.simulate(model(), t, at_rest, u, hold="zero")[:, 0]
    sign = np.where(v < 0, -1.0, 1.0)
    changes = np.flatnonzero(np.diff(sign)) + 1
    swings = np.diff(changes, prepend=0, append=len(sign))
    for i, change in enumerate(changes.tolist()):
        # a third of the swings beside it at most, or a short swing would vanish
        reach = min(REACH, int(min(swings[i], swings[i + 1])) // 3)
        moved = [_moved(sign, change, by) for by in range(-reach, reach + 1)]
        bends = [np.sum(np.diff(each * size, 2) ** 2) for each in moved]
        sign = moved[int(np.argmin(bends))]
    return sign


def _moved(sign: np.ndarray, change: int, by: int) -> np.ndarray:
    """The signs with the change before the sample ``change`` moved by so many."""
    moved = sign.copy()
    if by > 0:
        moved[change : change + by] = sign[change - 1]
    if by < 0:
        moved[max(change + by, 0) : change] = sign[change]
    return moved


def model() -> ph.PseudoHamiltonian:
    """Drum, belt and pulley."""
    stiffness = ph.Parameter(START["k"], lower=0, unit="1/s^2")
    inertia = ph.Parameter(START["J"], lower=1e-2)
    damping = ph.Parameter(START["d"], lower=0, unit="1/s")
    return ph.PseudoHamiltonian(
        kind="mechanical",
        states=STATES,
        inputs=INPUTS,
        S=[[0.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
        H=ph.formula("w**2/2 + k*s**2/2 + v**2/(2*J)", k=stiffness, J=inertia),
        R={"w": ph.formula("d", d=damping)},
        F={"w": ph.formula("b*u", b=ph.Parameter(START["b"]))},
    )


def main(path: Path) -> dict[str, float]:
    """The fitted values."""
    if not is_present(path):
        return {}
    fit = ph.identify(model(), load(path))
    print(fit, f"{fit.seconds:.0f} s", sep="\n")
    return dict(fit.values)


if __name__ == "__main__":
    main(given(FILE))
