"""The pendulum with a motor: friction and torque offset from one swing-up.

Data: angle q (rad, 0 hangs down), velocity v (rad/s) and motor torque u (N m) at 300
Hz, 3.9 s, all noisy. Both states are measured:

    dq/dt = v
    J dv/dt = u + offset - G sin(q) - viscous v - dry sign(v)

The sign is rounded over `TURNOVER`. Published for these data, by least squares: dry
friction 0.184 N m times atan(100 v), viscous friction 0.047 N m s/rad, torque offset
-0.076 N m, of which the set does not tell to which side of the equation it belongs. The
torque is taken as it was measured: its noise is an error of the input.

    python -m problems.measured.torque_pendulum [FILE]
"""

from pathlib import Path

import numpy as np

import phsi_opt as ph
from problems.tools.data_paths import folder, given, is_present

FILE = folder("torque_pendulum") / "data_measured.csv"
# rad/s, where dry friction turns over; atan(100 v) does at some 0.01 rad/s
TURNOVER = 0.02
UNITS = {"q": "rad", "v": "rad/s", "u": "N m", "t": "s"}
# N m and N m s/rad; dry friction as the torque far from rest, where atan is pi/2
PUBLISHED = {"dry": 0.184 * np.pi / 2, "viscous": 0.047, "offset": -0.076}


def load(path: Path, *, has_velocity: bool = True) -> ph.Measurements:
    """The record: angle, velocity and torque, a straight line between samples.

    The velocity is worked out from the angle: what both have beside a mean of 21
    samples agrees (a correlation of 0.94 with the angle's central differences). Without
    it nothing is counted twice.
    """
    table = np.genfromtxt(path, delimiter=",", names=True)
    velocity = table["velocity"] if has_velocity else np.full(len(table), np.nan)
    return ph.Measurements.from_arrays(
        table["time"],
        np.column_stack([table["position"], velocity]),
        table["torque"],
        states=["q", "v"],
        inputs=["u"],
        units=UNITS,
    )


def model() -> ph.PseudoHamiltonian:
    """A pendulum with viscous and dry friction and an offset of its torque.

    Energy and losses are those of a unit inertia, so that the momentum is the velocity;
    the parameters are those of the pendulum.
    """
    inertia = ph.Parameter(0.2, lower=1e-3, unit="kg m^2")
    gravity = ph.Parameter(3.0, lower=0, unit="N m")
    viscous = ph.Parameter(0.05, lower=0, unit="N m s/rad")
    dry = ph.Parameter(0.1, lower=0, unit="N m")
    offset = ph.Parameter(0.0, unit="N m")
    friction = ph.formula(
        "(viscous + dry*(v**4 + v0**4)**(-0.25))/J",
        viscous=viscous,
        dry=dry,
        v0=TURNOVER,
        J=inertia,
    )
    return ph.PseudoHamiltonian(
        states=["q", "v"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("v**2/2 - G/J*cos(q)", G=gravity, J=inertia),
        R={"v": friction},
        F={"v": ph.formula("(u + offset)/J", offset=offset, J=inertia)},
    )


def main(path: Path) -> dict[str, float]:
    """The fitted values."""
    if not is_present(path):
        return {}
    fit = ph.identify(model(), load(path))
    print(fit, f"published: {PUBLISHED}", f"{fit.seconds:.0f} s", sep="\n")
    return dict(fit.values)


if __name__ == "__main__":
    main(given(FILE))
