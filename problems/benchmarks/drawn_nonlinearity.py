"""A static nonlinearity that every seed draws, less what its linear model can do of it.

A nonlinearity that is always the same gives every estimate the same bias: its intervals
hold the truth always or never. How often they hold is asked over nonlinearities that
are drawn: kind, shape, sign and share. The linear spring, the damper and the constant
that come nearest to one over the motions of its kind are taken off it before anything
is simulated; what remains has no linear part, so that the coefficients of the
simulation are the truth. The share is that of what remains.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np

from problems.benchmarks.disturbed_oscillator import (
    MOTION_RUNS,
    MOTION_SEED,
    TRUTH,
    Disturbance,
    Draw,
    Layout,
    Motion,
    motion,
)

KINDS = (
    "cubic spring",
    "one-sided spring",
    "cogging",
    "quadratic drag",
    "tanh friction",
)
BOTH_SIGNS = ("cubic spring", "one-sided spring")  # losses stay losses
WAVE_LENGTHS = (0.3, 1.0)  # of cogging, share of the range of motion
# Of the friction, share of the root mean square velocity. With a wider corner too
# little is left beside a linear damper: it would turn into a drive at large velocities.
CORNERS = (0.3, 1.0)
STREAM = 1  # of random numbers, beside those of the record's own draw
# The motions depend on the nonlinearity, and it on them: a third pass changes stiffness
# and damping of its linear part by 3e-5 N/m and 1.3e-4 N s/m at most (20 seeds), which
# is a fiftieth and a tenth of what noise alone leaves unknown of them.
N_PASSES = 2


@dataclass(frozen=True, eq=False)
class Nonlinearities:
    """One for every run, as forces that pull back.

    Attributes:
        kind: (n_runs,) place in `KINDS`.
        wave_number: (n_runs,) of cogging, 1/m.
        phase: (n_runs,) of cogging.
        corner: (n_runs,) of friction, m/s.
        share: (n_runs,) root mean square of the force over that of the linear spring.
        size: (n_runs,) factor on the shape, with its sign.
        stiffness: (n_runs,) of the shape's linear part.
        damping: (n_runs,) of the same.
        constant: (n_runs,) of the same.
    """

    kind: np.ndarray
    wave_number: np.ndarray
    phase: np.ndarray
    corner: np.ndarray
    share: np.ndarray
    size: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    constant: np.ndarray

    @classmethod
    def of(
        cls, seeds: Sequence[int], shares: tuple[float, float], layout: Layout
    ) -> "Nonlinearities":
        """Those of some seeds, one each; a seed's does not depend on the others.

        Args:
            seeds: of the records.
            shares: least and largest share of the linear spring's force.
            layout: of the records, whose motions decide what the linear part is.
        """
        draws = [_drawn(seed, shares, layout) for seed in seeds]
        drawn = cls(*np.array(draws).T)
        still = _without_disturbance(layout.samples)
        moved = _repeated(still, len(seeds))
        ensemble = Draw.joined([_ensemble(layout.samples)] * len(seeds))
        for _ in range(N_PASSES):
            drawn = drawn.without_linear_part(moved)
            moved = motion(ensemble, drawn.repeated(MOTION_RUNS).pull)
        return drawn.without_linear_part(moved)

    def pull(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The forces, (n_runs,), m/s^2.

        Args:
            q: (n_runs,) positions.
            v: (n_runs,) velocities.
        """
        linear = self.stiffness * q + self.damping * v + self.constant
        return self.size * (self.shape(q, v) - linear)

    def shape(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The forces of unit size with their linear part, (n_runs,)."""
        of_kind = [
            q**3,
            q**2,
            np.sin(self.wave_number * q + self.phase),
            v * np.abs(v),
            np.tanh(v / self.corner),
        ]
        return np.choose(self.kind.astype(int), of_kind)

    def repeated(self, n_runs: int) -> "Nonlinearities":
        """Every one for as many runs, one after the other."""
        values = []
        for field in fields(self):
            values.append(np.repeat(getattr(self, field.name), n_runs))
        return Nonlinearities(*values)

    def without_linear_part(self, moved: Motion) -> "Nonlinearities":
        """The same shapes, sized and freed of what is linear over a motion.

        Args:
            moved: as many runs for every nonlinearity, one after the other.
        """
        n = len(self.kind)
        # One column per nonlinearity, so that parameters meet their own motion.
        q = moved.position.reshape(n, -1).T
        v = moved.velocity.reshape(n, -1).T
        shape = self.shape(q, v)
        linear = np.zeros((3, n))
        size = np.zeros(n)
        for i in range(n):
            regressors = np.column_stack([q[:, i], v[:, i], np.ones(len(q))])
            found = np.linalg.lstsq(regressors, shape[:, i])[0]
            left = _root_mean_square(shape[:, i] - regressors @ found)
            spring = TRUTH["k"] * _root_mean_square(q[:, i])
            linear[:, i] = found
            size[i] = np.sign(self.size[i]) * self.share[i] * spring / left
        return replace(
            self,
            size=size,
            stiffness=linear[0],
            damping=linear[1],
            constant=linear[2],
        )


def kind_of(seed: int, layout: Layout) -> str:
    """The kind of nonlinearity that a seed draws, one of `KINDS`."""
    return KINDS[int(_rng(seed, layout).integers(len(KINDS)))]


def _rng(seed: int, layout: Layout) -> np.random.Generator:
    return np.random.default_rng([seed, layout.runs, layout.samples, STREAM])


def _drawn(seed: int, shares: tuple[float, float], layout: Layout) -> tuple[float, ...]:
    """The fields of one nonlinearity, its linear part still unknown."""
    rng = _rng(seed, layout)
    still = _without_disturbance(layout.samples)
    kind = int(rng.integers(len(KINDS)))
    motion_range = float(np.mean(np.ptp(still.position, axis=1)))
    wave_length = rng.uniform(*WAVE_LENGTHS) * motion_range
    phase = rng.uniform(0, 2 * np.pi)
    corner = rng.uniform(*CORNERS) * _root_mean_square(still.velocity)
    share = rng.uniform(*shares)
    sign = rng.choice([-1.0, 1.0])
    size = sign if KINDS[kind] in BOTH_SIGNS else 1.0
    return (kind, 2 * np.pi / wave_length, phase, corner, share, size, 0.0, 0.0, 0.0)


@cache
def _ensemble(samples: int) -> Draw:
    """What drives the runs over which a linear part is told."""
    return Draw.of(MOTION_SEED, Disturbance(), Layout(MOTION_RUNS, samples))


@cache
def _without_disturbance(samples: int) -> Motion:
    """Motion of the linear oscillator over those runs."""
    return motion(_ensemble(samples), _nothing)


def _nothing(q: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.zeros(len(q))


def _repeated(moved: Motion, times: int) -> Motion:
    """The same runs several times, one after the other."""
    return Motion(
        np.tile(moved.position, (times, 1)), np.tile(moved.velocity, (times, 1))
    )


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
