"""The measurements of the disturbed oscillator."""

from collections.abc import Sequence

import numpy as np

import phsi_opt as ph
from problems.benchmarks.disturbed_oscillator import (
    INTERVAL,
    Disturbance,
    Draw,
    Layout,
    cubic_coefficient,
    motion,
    positions,
)
from problems.benchmarks.drawn_nonlinearity import Nonlinearities


def records(
    seeds: Sequence[int], disturbance: Disturbance, layout: Layout
) -> list[ph.Measurements]:
    """The measurements of every seed; all are simulated at once."""
    draw = Draw.joined([Draw.of(seed, disturbance, layout) for seed in seeds])
    shown = _positions(draw, seeds, disturbance, layout) + draw.noise
    if disturbance.step:
        shown = np.round(shown / disturbance.step) * disturbance.step
    found = []
    for first in range(0, len(shown), layout.runs):
        own = slice(first, first + layout.runs)
        found.append(_measurements(shown[own], draw.voltage[own]))
    return found


def _positions(
    draw: Draw, seeds: Sequence[int], disturbance: Disturbance, layout: Layout
) -> np.ndarray:
    """Without noise, (n_runs, n_samples)."""
    if disturbance.drawn_shares is None:
        return positions(draw, cubic_coefficient(disturbance.cubic_share))
    drawn = Nonlinearities.of(seeds, disturbance.drawn_shares, layout)
    return motion(draw, drawn.repeated(layout.runs).pull).position


def _measurements(shown: np.ndarray, voltage: np.ndarray) -> ph.Measurements:
    """Of one record, (n_runs, n_samples) each."""
    n_runs, n_samples = shown.shape
    t = np.arange(n_samples) * INTERVAL
    states = []
    for position in shown:
        states.append(np.column_stack([position, np.full(n_samples, np.nan)]))
    return ph.Measurements.from_arrays(
        [t] * n_runs,
        states,
        list(voltage[:, :, None]),
        states=["q", "v"],
        inputs=["u"],
        hold="linear",
    )
