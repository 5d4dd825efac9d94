"""Two structures that are shaken and lose energy to dry friction that sticks before it
slides: Bouc and Wen's oscillator, and the wing of an F-16 with a payload at its tip.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat

import phsi_opt as ph
from problems.measured.machines import Array, one_run, oscillator, positive
from problems.tools.data_paths import folder

# --- Bouc and Wen's oscillator

BOUC_WEN_RATE = 750.0  # Hz
N_BOUC_WEN = 1000  # samples that a study fits; as many judge


def bouc_wen(name: str) -> ph.Measurements:
    """Displacement (m) and force (N); the force is band-limited: a smooth curve."""
    u, y = (_only_array(f"{what}{name}.mat") for what in "uy")
    return one_run(np.arange(len(u)) / BOUC_WEN_RATE, y, u, "cubic")


def _only_array(name: str) -> Array:
    content = loadmat(folder("bouc_wen") / name)
    (key,) = (key for key in content if not key.startswith("_"))
    return content[key].ravel()


def bouc_wen_base() -> ph.PseudoHamiltonian:
    """A mass on a linear spring with linear loss."""
    energy = ph.formula("k*q**2/2 + p**2/(2*m)", k=positive(5e4), m=positive(2.0))
    return oscillator(energy, ph.formula("u"))


# --- F-16: a wing with a payload

RATE, PERIOD = 400, 8192  # Hz; samples
FITTED, JUDGED = (1, 7), (3, 5)  # levels: a study fits these, these judge
FREQUENCY = np.fft.rfftfreq(PERIOD, 1 / RATE)
BAND = (6.8, 8.0)  # Hz, the main resonance, which has two thirds of the motion
PART, THIN = 10 * RATE, 4  # samples of a level that a study sees, and every how many


class Shaken(NamedTuple):
    """Times (s), force (N), accelerations (m/s^2) of shaker, wing and payload."""

    t: Array  # (n_samples,)
    u: Array  # (n_samples, 1)
    a: Array  # (n_samples, 3)


def f16(level: int) -> Shaken:
    """The whole record of a level: nine periods. Even levels are for tests."""
    kind = "" if level % 2 else "_Validation"
    content = loadmat(folder("f16") / f"FullMSine_Level{level}{kind}.mat")
    u, a = content["Force"].T, content["Acceleration"].T
    return Shaken(np.arange(len(u)) / RATE, u, a)


def period(level: int) -> Shaken:
    """The mean of the periods but the first."""
    t, u, a = f16(level)
    u, a = (x.reshape(-1, PERIOD, x.shape[1])[1:].mean(axis=0) for x in (u, a))
    return Shaken(t[:PERIOD], u, a)


def inside(band: tuple[float, float]) -> Array:
    """Which frequencies of a period lie within a band (Hz)."""
    first, last = band
    return (first <= FREQUENCY) & (last >= FREQUENCY)


def in_band(signal: Array, band: tuple[float, float], times: int = 0) -> Array:
    """A period (n_samples, n) within a band (Hz), integrated so many times."""
    lines = inside(band)
    factor = np.zeros(len(FREQUENCY), complex)
    factor[lines] = (2j * np.pi * FREQUENCY[lines]) ** -times
    return np.fft.irfft(np.fft.rfft(signal, axis=0) * factor[:, None], axis=0)


def resonance(levels: Sequence[int]) -> ph.Measurements:
    """Velocity of the payload (m/s) and force (N) near the main resonance, 10 s each.

    Each level shows another part of the period, so that no wave fits all of them.
    """
    states, inputs = [], []
    for level in levels:
        record = period(level)
        begin = level // 2 * PERIOD // 4
        part = np.arange(begin, begin + PART, THIN) % PERIOD
        velocity = in_band(record.a[:, 2:], BAND, times=1)[part, 0]
        states.append(np.c_[np.full_like(velocity, np.nan), velocity])
        inputs.append(in_band(record.u, BAND)[part])
    return ph.Measurements.from_arrays(
        [np.arange(0, PART, THIN) / RATE] * len(levels),
        states,
        inputs,
        states=["q", "p"],
        inputs=["u"],
        units={"t": "s", "q": "m", "p": "m/s", "u": "N"},
        hold="cubic",
    )


def resonance_model() -> ph.PseudoHamiltonian:
    """A mode of vibration of unit mass: linear stiffness and damping."""
    energy = ph.formula("k*q**2/2 + p**2/2", k=positive(2070.0))
    return oscillator(energy, ph.formula("b*u", b=ph.Parameter(0.003)))
