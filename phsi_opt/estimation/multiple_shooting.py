"""Windows of multiple shooting: pieces of a trajectory with free starting states.

Over a short window an unstable or chaotic model cannot run away from the data, so that
its parameters are found from farther off; each result starts longer windows. The
windows are cut here, and solved by `likelihood_solve`. Multiple shooting with an
optimiser is that of Bock and Plitt (1984).
"""

import numpy as np

from phsi_opt.transcription.grid import Grid

FIRST_WINDOWS = 32  # windows in the longest trajectory to begin with
WINDOW_GROWTH = 4  # factor by which windows grow from one solve to the next
SHORTEST_WINDOW = 8  # samples, at least
# Share of a window by which a sample may miss its end and still be there: rounding of
# times.
END_TOLERANCE = 1e-9


def cut_into_windows(grid: Grid, window: float) -> Grid:
    """The grid without the intervals between windows, so that each starts freely.

    No window has fewer than `SHORTEST_WINDOW` samples; a gap with steps in it is cut
    behind its first sample.

    Args:
        grid: of whole trajectories.
        window: length of the windows in time.
    """
    samples = np.flatnonzero(grid.sample)
    ends: list[int] = []
    for trajectory in range(int(grid.trajectory[-1]) + 1):
        of_trajectory = samples[grid.trajectory[samples] == trajectory]
        ends += _window_ends(grid.t, of_trajectory, window)
    is_cut = np.isin(grid.begin, ends)
    return grid.intervals(np.flatnonzero(~is_cut))


def _window_ends(t: np.ndarray, samples: np.ndarray, window: float) -> list[int]:
    """Nodes of the last sample of each window of a trajectory but the last window."""
    elapsed = t[samples] - t[samples[0]]
    number = np.floor(elapsed / window + END_TOLERANCE).astype(int)
    ends = []
    last = 0
    for i in np.flatnonzero(np.diff(number)) + 1:
        is_long = i - last >= SHORTEST_WINDOW
        leaves_enough = len(samples) - i >= SHORTEST_WINDOW
        if is_long and leaves_enough:
            ends.append(int(samples[i - 1]))
            last = int(i)
    return ends
