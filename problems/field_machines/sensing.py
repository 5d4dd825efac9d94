"""What is measured of a motion: noise, coarse steps, runs of different noise, noise
that lasts.
"""

from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from problems.field_machines.records import Array, Experiment, Motion

STEPS = (3.0, 20.0)  # of a coarse sensor, in a standard deviation of the motion
UNEVEN = 5.0  # times as much noise in some runs as in others
MEMORY = 0.7  # of coloured noise, from sample to sample


@dataclass(frozen=True)
class Sensing:
    """How a motion is measured.

    ``noise``: share of the root mean square of each channel; ``n_steps``: of the sensor
    in a standard deviation of the channel, 0: fine; ``memory``: of the noise.
    """

    noise: float
    n_steps: float = 0.0
    is_uneven: bool = False
    memory: float = 0.0


def measured(
    rng: np.random.Generator, e: Experiment, motion: Motion, how: Sensing
) -> tuple[ph.Measurements, ph.Measurements]:
    """Training runs and those held out, with noise."""
    kept = e.kept
    training = motion.x[:, : e.n_train][kept[:, : e.n_train]]
    y = motion.x + _noise(rng, e, how) * np.sqrt(np.mean(training**2, axis=0))
    if how.n_steps:
        step = training.std(axis=0) / how.n_steps
        y = step * np.round(y / step)
    unseen = [k for k in range(len(e.states)) if k not in e.seen]
    y[..., unseen] = np.nan
    runs = np.arange(e.n_runs)
    train = _measurements(e, y, motion.u, runs[: e.n_train])
    return train, _measurements(e, y, motion.u, runs[e.n_train :])


def _noise(rng: np.random.Generator, e: Experiment, how: Sensing) -> Array:
    """In shares of a channel's root mean square."""
    news = rng.normal(size=(len(e.t), e.n_runs, len(e.states)))
    noise = news.copy()
    for k in range(1, len(e.t)):
        fresh = np.sqrt(1 - how.memory**2) * news[k]
        noise[k] = how.memory * noise[k - 1] + fresh
    sizes = np.full(e.n_runs, how.noise)
    if how.is_uneven:
        sizes[0::2] /= np.sqrt(UNEVEN)
        sizes[1::2] *= np.sqrt(UNEVEN)
    return noise * sizes[:, None]


def _measurements(e: Experiment, y: Array, u: Array, runs: Array) -> ph.Measurements:
    times = []
    states = []
    inputs = []
    for run in runs:
        there = e.kept[:, run]
        times.append(e.t[there])
        states.append(y[there, run])
        inputs.append(u[there, run])
    return ph.Measurements.from_arrays(
        times,
        states,
        inputs if e.inputs else None,
        states=e.states,
        inputs=list(e.inputs) or None,
        hold=e.hold,
        names=[f"run {run + 1}" for run in runs],
    )
