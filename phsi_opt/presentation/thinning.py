"""Long records thinned for drawing: the extremes of every stretch stay."""

import math
from collections.abc import Sequence

import numpy as np


def thinned(curves: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Samples to draw, (n_drawn,) increasing: first, last, and extremes of each bin.

    Args:
        curves: (n_samples,) each, NaN where not known; of each, the least and the
            largest value of every bin are kept.
        most: samples to draw at most, but for the first and the last one.
    """
    n_samples = len(curves[0])
    if n_samples <= most:
        return np.arange(n_samples)
    n_bins = max(most // (2 * len(curves)), 1)
    kept = {0, n_samples - 1}
    for part in np.array_split(np.arange(n_samples), n_bins):
        for curve in curves:
            kept |= _extremes(curve, part)
    return np.array(sorted(kept))


def _extremes(curve: np.ndarray, part: np.ndarray) -> set[int]:
    """Where a curve is least and largest in a part; one of its NaN, for a gap."""
    is_known = np.isfinite(curve[part])
    found = set()
    if not is_known.all():
        found.add(int(part[np.argmin(is_known)]))
    known = part[is_known]
    if len(known):
        found.add(int(known[np.argmin(curve[known])]))
        found.add(int(known[np.argmax(curve[known])]))
    return found


def rounded(curve: np.ndarray, digits: int = 4) -> list[float | None]:
    """Values (n,) with as many digits of their range as can be seen; None for NaN."""
    known = curve[np.isfinite(curve)]
    extent = float(np.ptp(known)) if len(known) else 0.0
    size = extent or (abs(float(known[0])) if len(known) else 1.0) or 1.0
    n_decimals = digits - math.floor(math.log10(size))
    values: list[float | None] = []
    for value in curve.tolist():
        is_known = math.isfinite(value)
        values.append(round(value, n_decimals) if is_known else None)
    return values
