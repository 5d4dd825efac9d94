"""The shape of a hidden effect, and the unit in which its size is counted."""

from dataclasses import replace

import numpy as np

from problems.hidden_effects.machines import Setting
from problems.hidden_effects.rows import INPUT
from problems.hidden_effects.truth import SENSORS, Hidden, Moment, force_of


def drawn_shape(
    rng: np.random.Generator, name: str, at: int, s: Setting
) -> dict[str, float]:
    """The numbers of an effect beside its size, on the scales of the experiment.

    The numbers of all effects are drawn, whichever is asked for.
    """
    sign = float(rng.choice([-1.0, 1.0]))
    phase = float(rng.uniform(0, 2 * np.pi))
    if name in SENSORS:
        largest = float(np.abs(s.nominal[..., at]).max())
        return {"sign": sign, "largest": largest}
    shape = {"sign": sign, "phase": phase}
    for key, value in _shapes(rng, at, s).get(name, {}).items():
        shape[key] = float(value)
    return shape


def _shapes(
    rng: np.random.Generator, at: int, s: Setting
) -> dict[str, dict[str, float]]:
    n = s.machine.n
    omega = 2 * np.pi / s.period
    q = s.nominal[..., at]
    v = s.nominal[..., n + at] / s.machine.mass[at]
    fast = float(np.sqrt(np.mean(v**2)))
    far = float(np.abs(q).max())
    last = float(s.t[-1])
    loudest = 0.0 if s.drive is None else float(np.abs(s.drive.values).max())
    return {
        "coulomb friction": {"width": 1e-3 * fast},
        "stribeck friction": {
            "width": 1e-3 * fast,
            "rise": rng.uniform(0.8, 1.5),
            "speed": rng.uniform(0.3, 0.6) * fast,
        },
        "gap": {"play": rng.uniform(0.25, 0.6) * far},
        "harmonic force": {"omega": omega * rng.uniform(0.5, 1.6)},
        "parametric stiffness": {"omega": omega * rng.uniform(0.4, 2.2)},
        "input saturation": {"largest": loudest},
        "hysteresis": dict.fromkeys(
            ("beta", "gamma"), 0.5 / (rng.uniform(0.15, 0.4) * far)
        ),
        "change of stiffness": {"when": rng.uniform(0.35, 0.65) * last},
        "attached absorber": {
            "omega": omega * rng.uniform(0.7, 1.3),
            "damping": 0.05 * omega,
        },
        "square wave": {"omega": omega * rng.uniform(0.15, 0.35)},
        "impact": {"wall": rng.uniform(0.3, 0.6) * far, "loss": 0.1 / fast},
        "shocks": {
            "length": 0.2 * s.period,
            "first": rng.uniform(0.05, 0.3) * last,
            "second": rng.uniform(0.35, 0.6) * last,
            "third": rng.uniform(0.65, 0.9) * last,
        },
    }


def unit_of(hidden: Hidden, s: Setting) -> float:
    """The size in which the limits of `calibration` are given."""
    name = hidden.name
    if name in SENSORS:
        return _unit_of_sensor(hidden, s)
    if name in ("input lag", "input delay"):
        return s.period
    if name in ("input saturation", "input gain"):
        return 1.0
    if name == "input dead zone":
        assert s.drive is not None
        return float(np.abs(s.drive.values).max())
    at = hidden.at
    spring = s.machine.stiffness[at] * np.sqrt(np.mean(s.nominal[..., at] ** 2))
    if name == "hysteresis":
        return float(spring * (hidden.shape["beta"] + hidden.shape["gamma"]))
    if name == "attached absorber":  # in masses
        return float(s.machine.mass[at])
    if name == "shocks":
        return float(spring * 2)
    return float(spring / max(_rms_of_force(hidden, s), 1e-12))


def _unit_of_sensor(hidden: Hidden, s: Setting) -> float:
    x = s.nominal[..., hidden.at]
    drift = float(x.std() / s.t[-1])
    units = {
        "sensor offset": float(x.std()),
        "sensor drift": 2 * drift,
        "sensor delay": s.period,
    }
    return units.get(hidden.name, 1.0)


def _rms_of_force(hidden: Hidden, s: Setting) -> float:
    """Root mean square along the nominal runs of the force of size one."""
    n = s.machine.n
    at = hidden.at
    no_memory = np.zeros((s.nominal.shape[1], 1))
    forces = []
    for t, x in zip(s.t, s.nominal, strict=True):
        q = x[:, :n]
        v = x[:, n:] / s.machine.mass
        moment = Moment(t, q[:, at], v[:, at], q[:, n - 1 - at], no_memory, s.drive)
        force = force_of(replace(hidden, size=1.0), moment)
        forces.append(np.broadcast_to(force, len(x)))
    return np.sqrt(np.mean(np.array(forces) ** 2))


def place_of_effect(rng: np.random.Generator, name: str, s: Setting) -> int:
    """The mass (for sensors: the measured state) on which an effect acts."""
    if name in INPUT:
        return s.machine.pushed
    if name in SENSORS:
        return int(rng.choice(s.seen))
    return int(rng.integers(s.machine.n))
