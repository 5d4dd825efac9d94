"""How well any test could see a cubic spring in a record, and what it does unseen.

The best that a test can know: the form of the missing force, the size of the noise, and
the record. Its power follows from how far the response to the cubic spring lies outside
what stiffness, damping, gain and initial states can imitate (the noncentrality of the
likelihood-ratio test). What they imitate is the bias of the estimates. Both by
responses linearised at the truth, from the simulation alone, without the package.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, ncx2

from problems.benchmarks.disturbed_oscillator import (
    TRUTH,
    Disturbance,
    Draw,
    Layout,
    cubic_coefficient,
    motion,
)

LEVEL = 0.05  # of the test
# Half the change by which a slope is told: of a coefficient or a state of about one;
# half and twice of it move noncentralities by less than 1e-5 of themselves.
STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Detectability:
    """Of a cubic spring in some records.

    Attributes:
        noncentrality: (n_records,) of the likelihood-ratio test for its coefficient.
        power: (n_records,) of that test.
        bias: (n_records,) of the stiffness where the spring is left out, N/m.
        std_error: (n_records,) of the stiffness there, from white noise, N/m.
    """

    noncentrality: np.ndarray
    power: np.ndarray
    bias: np.ndarray
    std_error: np.ndarray


def detectability(
    seeds: Sequence[int], disturbance: Disturbance, layout: Layout
) -> Detectability:
    """Of the cubic spring of a disturbance in the records of some seeds."""
    draw = Draw.joined([Draw.of(seed, disturbance, layout) for seed in seeds])
    cubic = cubic_coefficient(disturbance.cubic_share)
    of_model, of_spring = _slopes(draw, cubic)
    found = []
    for first in range(0, len(draw.state), layout.runs):
        own = slice(first, first + layout.runs)
        shared = [slope[own].ravel() for slope in of_model[:3]]
        columns = [*shared, *_of_states(of_model[3:], own)]
        in_noise = np.column_stack(columns) / disturbance.noise
        by_spring = cubic * of_spring[own].ravel() / disturbance.noise
        imitated = np.linalg.lstsq(in_noise, by_spring)[0]
        outside = by_spring - in_noise @ imitated
        covariance = np.linalg.inv(in_noise.T @ in_noise)
        std_error = np.sqrt(covariance[0, 0])
        found.append([outside @ outside, imitated[0], std_error])
    noncentrality, bias, std_error = np.array(found).T
    power = ncx2.sf(chi2.isf(LEVEL, 1), 1, noncentrality)
    return Detectability(noncentrality, power, bias, std_error)


def _slopes(draw: Draw, cubic: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Slopes of the positions, (n_runs, n_samples) each.

    Returns:
        In stiffness, damping, gain, first position and first velocity; and in the
        coefficient of the cubic spring.
    """
    slopes = []
    for name in ("stiffness", "damping", "gain", "position", "velocity", "cubic"):
        above = _positions(draw, cubic, name, STEP)
        below = _positions(draw, cubic, name, -STEP)
        slopes.append((above - below) / (2 * STEP))
    return slopes[:-1], slopes[-1]


def _positions(draw: Draw, cubic: float, name: str, change: float) -> np.ndarray:
    """Positions where one thing is changed, (n_runs, n_samples)."""
    more = {name: change}
    stiffer = more.get("stiffness", 0.0)
    damped = more.get("damping", 0.0)
    spring = cubic + more.get("cubic", 0.0)
    gain = 1 + more.get("gain", 0.0) / TRUTH["g"]
    first = np.array([more.get("position", 0.0), more.get("velocity", 0.0)])

    def pull(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return stiffer * q + damped * v + spring * q**3

    changed = replace(draw, voltage=gain * draw.voltage, state=draw.state + first)
    return motion(changed, pull).position


def _of_states(slopes: Sequence[np.ndarray], own: slice) -> list[np.ndarray]:
    """Columns of the initial states, each of which moves its own run alone."""
    columns = []
    for slope in slopes:
        of_record = slope[own]
        for run in range(len(of_record)):
            alone = np.zeros_like(of_record)
            alone[run] = of_record[run]
            columns.append(alone.ravel())
    return columns
