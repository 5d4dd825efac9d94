"""An input that is smooth between its samples: the cubic spline through them.

A straight line from sample to sample is too low at every crest: of a wave of w h
radians per sample it keeps the share 1 - (w h)^2/12, and a fit takes what is lost for
friction or for a softer spring. A spline loses a share of order (w h)^4.
"""

from typing import Any

import numpy as np


class SmoothInputs:
    """The inputs of one trajectory at any time.

    The spline has two continuous derivatives, and at both ends a third ("not a knot"):
    two samples make a line, three a parabola.

    Args:
        t: (n_samples,) strictly increasing times, at least 2.
        u: (n_samples, n_inputs) inputs at t, at least one.
    """

    def __init__(self, t: np.ndarray, u: np.ndarray) -> None:
        from scipy.interpolate import CubicSpline  # slow to import, and seldom needed

        self.limits = (float(t[0]), float(t[-1]))
        self._spline: Any = CubicSpline(t, u)

    def __call__(self, times: np.ndarray | float) -> np.ndarray:
        """The inputs at times, (..., n_inputs); before and after the samples the value
        at the end.
        """
        return np.asarray(self._spline(np.clip(times, *self.limits)))

    def lines(
        self, begin: np.ndarray, end: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The straight line that acts in each stretch of time like the spline.

        A step of an integrator takes its input from a line. That with the mean and the
        first moment of the spline moves a mass as far, and leaves it as fast, as the
        spline does. It need not meet the line of the next stretch.

        Args:
            begin: (n,) times; no sample lies between the ends of a stretch.
            end: (n,) times.

        Returns:
            Its values at both ends of every stretch, (n, n_inputs) each.
        """
        first, middle, last = self(begin), self((begin + end) / 2), self(end)
        # In s from -1 to 1 the spline is a0 + a1 s + a2 s^2 + a3 s^3. The closest line,
        # which has its mean and moment, is a0 + a2/3 + (a1 + 3 a3/5) s.
        half = (end - begin)[:, None] / 2
        a1 = half * self._spline((begin + end) / 2, 1)
        a2 = (first + last) / 2 - middle
        a3 = (last - first) / 2 - a1
        mean, rise = middle + a2 / 3, a1 + 3 * a3 / 5
        return mean - rise, mean + rise
