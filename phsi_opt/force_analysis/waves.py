"""Waves along a variable, and how much of a force one of them explains."""

import numpy as np

from phsi_opt.statistics import TINY

# Intervals (drawn at random where there are more) on which a frequency is refined.
MOST_REFINED = 3000
# Determinant of sine and cosine over the product of their squares: smaller ones are one
# function, to rounding.
LEAST_DETERMINANT = 1e-9


def harmonics(phase: np.ndarray) -> np.ndarray:
    """Sine and cosine of a phase (n,), and of twice the phase, (n, 4)."""
    twice = 2 * phase
    waves = [np.sin(phase), np.cos(phase), np.sin(twice), np.cos(twice)]
    return np.column_stack(waves)


def drawn(places: np.ndarray) -> np.ndarray:
    """All places (n,), or a random choice in their order where there are many."""
    if len(places) <= MOST_REFINED:
        return places
    rng = np.random.default_rng(0)
    return np.sort(rng.choice(places, MOST_REFINED, replace=False))


def explained_by_wave(
    z: np.ndarray, y: np.ndarray, frequencies: np.ndarray
) -> np.ndarray:
    """Fall of the sum of squares of y (n,) by a wave of each frequency along z (n,)."""
    phase = 2 * np.pi * np.outer(frequencies, z)
    sine = np.sin(phase)
    cosine = np.cos(phase)
    ss = np.sum(sine * sine, axis=1)
    cc = np.sum(cosine * cosine, axis=1)
    sc = np.sum(sine * cosine, axis=1)
    sy = sine @ y
    cy = cosine @ y
    least = LEAST_DETERMINANT * ss * cc + TINY
    determinant = np.maximum(ss * cc - sc**2, least)
    both = 2 * sy * cy * sc
    fall = sy**2 * cc - both + cy**2 * ss
    return np.asarray(fall / determinant)
