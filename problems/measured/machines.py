"""Measured machines that move: loaders and models.

Each set has a loader, which makes measurements of its files, and a base model, which
lacks what the set is known for. Sets whose model is integrated over small errors are
cut into windows with free starting states. States that nobody measured are NaN.
"""

from typing import NamedTuple

import numpy as np
from scipy.io import loadmat
from scipy.signal import resample_poly

import phsi_opt as ph
from phsi_opt.data.checks import Hold
from phsi_opt.model.terms import Dictionary
from problems.tools.data_paths import folder

Array = np.ndarray


def positive(start: float, unit: str = "", lower: float = 0.0) -> ph.Parameter:
    """A parameter that is not negative."""
    return ph.Parameter(start, lower=lower, unit=unit)


def with_unmeasured(*measured: Array, n: int = 1) -> Array:
    """Measured channels as columns, and ``n`` states that nobody measured."""
    return np.column_stack([*measured, np.full((len(measured[0]), n), np.nan)])


def one_run(t: Array, q: Array, u: Array, hold: Hold) -> ph.Measurements:
    """A run of a position q and an input u, (n_samples,); nobody measured p."""
    return ph.Measurements.from_arrays(
        t, with_unmeasured(q), u[:, None], states=["q", "p"], inputs=["u"], hold=hold
    )


def first_two(n: int, data: ph.Measurements) -> tuple[ph.Measurements, ph.Measurements]:
    """The first ``n`` samples of a record, and as many after them."""
    t = data.trajectories[0].t
    return data.between(None, t[n - 1]), data.between(t[n], t[2 * n - 1])


def oscillator(
    H: Dictionary, F: Dictionary, R: Dictionary | None = None
) -> ph.PseudoHamiltonian:
    """A position q and a momentum p that an input u drives; R: viscous damping if it is
    not given.
    """
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=H,
        R={"p": R} if R else ph.damping("p"),
        F={"p": F},
    )


class Record(NamedTuple):
    """Times, positions and forces of the same samples, each (n_samples,)."""

    t: Array
    q: Array
    u: Array

    def thinned(self, thin: int) -> "Record":
        """Every ``thin``-th position; the force as its mean in between, which leaves
        the momentum exact.
        """
        n = (len(self.t) - 1) // thin
        u = self.u[: n * thin].reshape(n, thin).mean(axis=1)
        kept = slice(0, n * thin + 1, thin)
        return Record(self.t[kept], self.q[kept], np.append(u, u[-1]))

    def in_windows(self, size: int, units: dict[str, str]) -> ph.Measurements:
        """Windows of ``size`` steps that share their ends.

        The position is the state q; nobody measured its momentum p. A last window that
        is shorter than half of the others is left out.
        """
        n = len(self.t) - 1
        pieces = [slice(i, i + size + 1) for i in range(0, n - size // 2, size)]
        x = with_unmeasured(self.q)
        return ph.Measurements.from_arrays(
            [self.t[piece] for piece in pieces],
            [x[piece] for piece in pieces],
            [self.u[piece][:, None] for piece in pieces],
            states=["q", "p"],
            inputs=["u"],
            hold="zero",
            units=units,
        )


# --- the EMPS linear drive

EMPS_FILES = {"fit": "DATA_EMPS.mat", "test": "DATA_EMPS_PULSES.mat"}
# m/s, where dry friction turns over; the drive moves at 0.04 to 0.13 m/s
EMPS_TURNOVER = 2e-3
# The values that come with the data of the benchmark.
EMPS_PUBLISHED = {"M": 95.109, "Fv": 203.503, "Fc": 20.394, "offset": -3.165}
EMPS_MASS = positive(80.0, "kg", 1)


def emps_record(name: str) -> Record:
    """Position (m) and motor force (N) at 1 kHz, 24.8 s; "test" has force pulses."""
    content = loadmat(folder("emps") / EMPS_FILES[name])
    force = content["vir"].ravel() * content["gtau"].item()
    return Record(content["t"].ravel(), content["qm"].ravel(), force)


def emps(record: str = "fit") -> ph.Measurements:
    """A record, thinned, as the position q (m) and the motor force u (N), in windows of
    1 s.

    The drive ran in closed loop, but the force is taken as a free input, and a position
    without a spring drifts: over the whole record every small error of the model is
    integrated twice, far above the encoder's noise.
    """
    units = {"q": "m", "u": "N", "t": "s"}
    return emps_record(record).thinned(10).in_windows(100, units)


def emps_model() -> ph.PseudoHamiltonian:
    """M dv/dt = u - Fv v - Fc sign(v) - offset."""
    friction = ph.formula(
        "Fv + Fc*(dH_dp**4 + v0**4)**(-0.25)",
        Fv=positive(100.0, "N s/m"),
        Fc=positive(5.0, "N"),
        v0=EMPS_TURNOVER,
    )
    force = ph.formula("u - offset", offset=ph.Parameter(0.0, unit="N"))
    return oscillator(ph.formula("p**2/(2*M)", M=EMPS_MASS), force, friction)


def emps_base() -> ph.PseudoHamiltonian:
    """A mass with viscous friction, driven by the force."""
    return oscillator(ph.formula("p**2/(2*M)", M=EMPS_MASS), ph.formula("u"))


# --- the quarter-drone arm

DRONE_FILES = {
    "steps": "sinal2_degraus",
    "swept sine": "sinal3_swept_sine",
    "multisine": "sinal4_multiseno",
}
FLYING = (20.0, 80.0)  # s


def drone(record: str) -> ph.Measurements:
    """Angle q (rad) and command to the motor u (%) in a closed loop, where the arm
    flies; thinned from 100 to 20 Hz, the command to its mean in between; in windows of
    5 s.
    """
    path = folder("quarter_drone") / f"{DRONE_FILES[record]}_malha_fechada.csv"
    table = np.genfromtxt(path, delimiter=",", names=True)
    t = table["Tempo_s"]
    flying = (t >= FLYING[0] - 1e-6) & (t <= FLYING[1] + 1e-6)
    angle = np.deg2rad(table["Saida_y"][flying])
    thinned = Record(t[flying], angle, table["Controle_u"][flying]).thinned(5)
    return thinned.in_windows(100, {"q": "rad", "p": "rad/s", "u": "%", "t": "s"})


def drone_model() -> ph.PseudoHamiltonian:
    """dp/dt = -g sin(q) - d p + b u, scaled to a unit inertia: gravity, damping, a
    thrust in proportion to the command.
    """
    energy = ph.formula("p**2/2 - g*cos(q)", g=positive(10.0))
    return oscillator(energy, ph.formula("b*u", b=ph.Parameter(0.2)))


# --- the ball and hoop drive

HOOP_TESTS = ("fixedStepSequence", "closedLoop")
HOOP_SHARE = 0.7  # of the random steps that is fitted; the rest judges


def hoop(record: str = "randomStepSequence") -> ph.Measurements:
    """The hoop's speed y (V), and the motor command u (-1 to 1), held, 0.1 s."""
    content = loadmat(folder("ball_and_hoop") / f"{record}.mat")
    return ph.Measurements.from_arrays(
        content["time"].ravel(),
        content["y"].ravel()[:, None],
        content["u"].ravel()[:, None],
        states=["y"],
        inputs=["u"],
        hold="zero",
        units={"y": "V", "t": "s"},
    )


def hoop_model() -> ph.PseudoHamiltonian:
    """dy/dt = -r y + b u: kinetic energy y^2/2, linear loss, input gain."""
    return ph.PseudoHamiltonian(
        states=["y"],
        inputs=["u"],
        S=[[0.0]],
        H=ph.formula("y**2/2"),
        R=ph.damping("y"),
        F={"y": ph.formula("b*u", b=ph.Parameter(1.0))},
    )


# --- the coupled electric drives

DRIVES_FILE = "drive.mat"
DRIVES_STATES = ("v", "s", "w")
REACH = 4  # samples; the simulation runs ahead or behind by up to three
DRIVES_START = {"k": 240.0, "J": 1.15, "d": 12.0, "b": 27.0}


def drives() -> ph.Measurements:
    """Voltage u of the motors and the pulley's speed v, 20 ms, three records at
    amplitudes 1, 1.5 and 0.5 V, each a trajectory.

    The sensor shows the size of the speed alone, and a fit through a sensor |v| ends
    far from the best signs. So each sign is taken from a simulation of the model from
    rest, which follows every swing. `DRIVES_START` was found by giving the first 120
    samples signs that continue their slope, fitting them, and repeating both on the
    whole records until no sign changed.
    """
    content = loadmat(folder("coupled_drives") / DRIVES_FILE)
    t = 0.02 * np.arange(len(content["z1"]))
    states = []
    inputs = []
    for record in (1, 2, 3):
        u = content[f"u{record}"].ravel()
        size = content[f"z{record}"].ravel()
        states.append(with_unmeasured(size * _sign(t, u, size), n=2))
        inputs.append(u)
    return ph.Measurements.from_arrays(
        [t] * 3,
        states,
        inputs,
        states=DRIVES_STATES,
        inputs=["u"],
        hold="zero",
        units={"v": "V", "u": "V", "t": "s"},
    )


def _sign(t: Array, u: Array, size: Array) -> Array:
    """Which way the pulley turns: as the simulation, but each change of sign moved by
    up to `REACH` samples to where the signed speed bends least.
    """
    v = ph.simulate(drives_model(), t, np.zeros(3), u, hold="zero")[:, 0]
    sign = np.where(v < 0, -1.0, 1.0)
    changes = np.flatnonzero(np.diff(sign)) + 1
    swings = np.diff(changes, prepend=0, append=len(sign))
    for i, change in enumerate(changes.tolist()):
        # a third of the swings beside it at most, or a short swing would vanish
        reach = min(REACH, int(min(swings[i], swings[i + 1])) // 3)
        moved = []
        for by in range(-reach, reach + 1):
            candidate = sign.copy()
            candidate[change : change + max(by, 0)] = sign[change - 1]
            candidate[max(change + min(by, 0), 0) : change] = sign[change]
            moved.append(candidate)
        bends = [np.sum(np.diff(each * size, 2) ** 2) for each in moved]
        sign = moved[int(np.argmin(bends))]
    return sign


def drives_model() -> ph.PseudoHamiltonian:
    """A belt between two drums, in the sensor's unit and for drums of unit inertia.

        dw/dt = b u - d w - k s,   ds/dt = w - v/J,   dv/dt = k s

    w is the drum's speed, s the stretch of the belt, v the pulley's momentum.
    """
    start = DRIVES_START
    inertia = positive(start["J"], lower=1e-2)
    stiffness = positive(start["k"], "1/s^2")
    return ph.PseudoHamiltonian(
        kind="mechanical",
        states=DRIVES_STATES,
        inputs=["u"],
        S=[[0.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
        H=ph.formula("w**2/2 + k*s**2/2 + v**2/(2*J)", k=stiffness, J=inertia),
        R={"w": ph.formula("d", d=positive(start["d"], "1/s"))},
        F={"w": ph.formula("b*u", b=ph.Parameter(start["b"]))},
    )


# --- the pendulum with a motor

PENDULUM_FILE = "data_measured.csv"


def pendulum() -> ph.Measurements:
    """Angle q (rad, 0 hangs down) and motor torque u (N m) at 300 Hz, 3.9 s, noisy; the
    torque is a straight line between samples.

    The file has a velocity too, which is worked out from the angle: what both have
    beside a mean of 21 samples agrees (a correlation of 0.94 with the angle's central
    differences). Without it nothing is counted twice.
    """
    path = folder("torque_pendulum") / PENDULUM_FILE
    table = np.genfromtxt(path, delimiter=",", names=True)
    return ph.Measurements.from_arrays(
        table["time"],
        with_unmeasured(table["position"]),
        table["torque"],
        states=["q", "v"],
        inputs=["u"],
        units={"q": "rad", "v": "rad/s", "u": "N m", "t": "s"},
    )


def pendulum_model() -> ph.PseudoHamiltonian:
    """J dv/dt = u - G sin(q) - viscous v.

    Published by least squares: dry friction 0.184 N m times atan(100 v), viscous
    friction 0.047 N m s/rad, torque offset -0.076 N m, of which the set does not tell
    to which side of the equation it belongs. Energy and losses are those of a unit
    inertia, so that the momentum is the velocity.
    """
    inertia = positive(0.2, "kg m^2", 1e-3)
    viscous = positive(0.05, "N m s/rad")
    return ph.PseudoHamiltonian(
        states=["q", "v"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("v**2/2 - G/J*cos(q)", G=positive(3.0, "N m"), J=inertia),
        R={"v": ph.formula("viscous/J", viscous=viscous, J=inertia)},
        F={"v": ph.formula("u/J", J=inertia)},
    )


# --- the Silverbox, an electronic Duffing oscillator

BOX_RATE = 1e7 / 2**14  # Hz
# Points of the input per sample. A straight line between two samples weakens the input
# by 4 % at the resonance and by 30 % at 200 Hz. With 1, 2 and 4 points and 1000 samples
# fitted, 0.94, 0.47 and 0.42 mV of another multisine were left; 2 is taken for speed.
FINER = 2
BOX_FIT = (40_700, 44_796)  # samples of a multisine
BOX_HELD_OUT = (50_000, 54_096)  # of another one
ARROW = (36_000, 40_096)  # its last part has the largest amplitudes
N_BOX_STORY = 2048  # samples of each multisine that the study is given


def box(first: int, end: int) -> ph.Measurements:
    """Samples ``first`` to ``end``: output q (V), and the input u (V), band-limited,
    at `FINER` points per sample.
    """
    path = folder("silverbox") / "SNLS80mV.csv"
    V1, V2 = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 1)).T
    interpolated = resample_poly(V1, FINER, 1, window=("kaiser", 8.0))
    u = interpolated[first * FINER : (end - 1) * FINER + 1]
    x = np.full((len(u), 2), np.nan)
    x[::FINER, 0] = V2[first:end]
    return ph.Measurements.from_arrays(
        np.arange(len(u)) / (FINER * BOX_RATE),
        x,
        u[:, None],
        states=["q", "p"],
        inputs=["u"],
        hold="linear",
        units={"q": "V", "u": "V", "t": "s"},
    )


def box_model() -> ph.PseudoHamiltonian:
    """A unit mass on a linear spring with linear loss; it starts near 70 Hz."""
    energy = ph.formula("k*q**2/2 + p**2/2", k=positive(1.9e5, "1/s^2"))
    gain = ph.Parameter(1e5, unit="1/s^2")
    return oscillator(energy, ph.formula("b*u", b=gain))
