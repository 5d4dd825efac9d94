"""What acts on a machine and is not in its model: the disturbances, with their sizes.

They differ in what they do to the residuals: white noise lasts one sample, a sensor
error that lasts is seen as it is, a force is seen through the model's own dynamics, and
a function of a state returns whenever the state does. `Coordinates` are their sizes and
times as a vector, for a search.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg.lapack import dtbtrs

from phsi_opt.statistics import TINY

# Correlation length of a function, in standard deviations of the state. Shorter, a
# parameter's slope is known too well in spite of an unknown function; longer, a curved
# function is not found. On oscillators with a hidden cubic spring, 0.7 and 1.5 hold the
# stiffness in 80 to 95 % and 65 to 95 % of the records.
LENGTH = 1.0
# Share of its size that the linear part of a function keeps. A machine's model has the
# springs and dampers of its states already, which take what is straight over the
# record; a share is kept for what is straight here and not elsewhere. It is a trade
# between narrow and reliable intervals, measured in results/coverage.md (0.25 to 99).
LINEAR_SHARE = 0.25
# Sizes of noises and processes that are estimated one by one, at most: beyond, those of
# one kind keep their ratios.
MOST_SIZES = 27


# --- Processes in time


@dataclass(frozen=True)
class Process:
    """A first-order (Ornstein-Uhlenbeck) process.

    After a time dt it keeps the share exp(-dt/time) of its value; the rest is new and
    independent (Uhlenbeck and Ornstein, Physical Review 36, 1930).
    """

    place: int  # number of its equation, or of the state whose sensor errs
    size: float  # standard deviation, in the unit of that equation or sensor
    # Correlation time, in the unit of the record's times; 0: white, a value of its own
    # at every time.
    time: float


@dataclass(frozen=True, eq=False)
class Whitener:
    """From the values of a process of size one to independent standard normals.

    A matrix with two diagonals: the value at a time less what was kept of the previous
    one, over the standard deviation of what is new.
    """

    diagonal: np.ndarray  # (n,)
    below: np.ndarray  # (n - 1,), what multiplies the previous value

    @classmethod
    def of(cls, t: np.ndarray, trajectory: np.ndarray, time: float) -> "Whitener":
        """Of a process at some times.

        Args:
            t: (n,) times, trajectory after trajectory.
            trajectory: (n,) numbers of the trajectories; each starts anew.
            time: correlation time; 0: white.
        """
        is_first = np.diff(trajectory, prepend=-1) != 0
        elapsed = np.where(is_first, 0.0, np.diff(t, prepend=t[0]))
        log_kept = -elapsed / time if time > 0 else np.full(len(t), -np.inf)
        log_kept = np.where(is_first, -np.inf, log_kept)
        new = np.sqrt(np.maximum(-np.expm1(2 * log_kept), TINY))
        kept = np.exp(log_kept)
        return cls(1 / new, -kept[1:] / new[1:])

    @property
    def log_det(self) -> float:
        return float(np.sum(np.log(self.diagonal)))

    @property
    def precision(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonals of the inverse covariance, the main one (n,) and the next one."""
        diagonal = self.diagonal**2
        diagonal[:-1] += self.below**2
        return diagonal, self.below * self.diagonal[1:]

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Standard normals of values (n, ...)."""
        result = (self.diagonal * values.T).T
        result[1:] += (self.below * values[:-1].T).T
        return result

    def transposed(self, normals: np.ndarray) -> np.ndarray:
        """The transposed matrix times (n, ...)."""
        result = (self.diagonal * normals.T).T
        result[:-1] += (self.below * normals[1:].T).T
        return result

    def factor_of(self, weights: np.ndarray) -> np.ndarray:
        """F with F'F the covariance of weighted sums of the values, weights (n, k)."""
        return self._solved(weights, "T")

    def coloured(self, normals: np.ndarray) -> np.ndarray:
        """Values of the process from standard normals (n, ...)."""
        return self._solved(normals, "N")

    def _solved(self, right: np.ndarray, trans: str) -> np.ndarray:
        """The inverse of the matrix, or of its transpose, times (n, ...)."""
        if not right.size:  # LAPACK writes beyond what has no column
            return np.zeros(right.shape)
        lower = np.zeros((2, len(self.diagonal)), order="F")
        lower[0] = self.diagonal
        lower[1, :-1] = self.below
        columns = right.reshape(len(self.diagonal), -1)
        found, _ = dtbtrs(lower, columns, uplo="L", trans=trans)
        return np.asarray(found).reshape(right.shape)


@lru_cache(4)  # a search asks for the same ones at every step
def random_signs(lengths: tuple[int, ...], n: int) -> tuple[np.ndarray, ...]:
    """Signs, (n_values, n) for each of the lengths n_values, read-only.

    For a random sign vector s, the mean of s'As is the trace of A (Hutchinson,
    Communications in Statistics 19, 1990). The same signs everywhere make an estimate
    the same every time, and smooth in what the matrix depends on.
    """
    rng = np.random.default_rng(0)
    drawn = []
    for length in lengths:
        signs = np.asfortranarray(rng.choice([-1.0, 1.0], (length, n)))
        signs.flags.writeable = False
        drawn.append(signs)
    return tuple(drawn)


# --- Functions of a state


@dataclass(frozen=True)
class StateFunction:
    """An unknown smooth function of one state, in one equation."""

    equation: int  # number of the equation that it acts in
    state: int  # number of the state that it is a function of
    size: float  # its standard deviation, in the unit of the equation


def smooth_functions(
    values: np.ndarray, linear_share: float = LINEAR_SHARE
) -> np.ndarray:
    """Values of random smooth functions along a state, (n, n_functions).

    A Gaussian process whose correlation falls as ``exp(-(a - b)^2 / (2 length^2))``,
    as a sum of few functions with independent coefficients of one size (Rasmussen and
    Williams, Gaussian Processes for Machine Learning, 2006, chapter 8).

    Args:
        values: (n,) of the state.
        linear_share: that of their linear part that they keep.

    Returns:
        Columns whose sum with independent coefficients of size one is a process of
        size one, less its mean: a constant force is no function of a state; and less
        all but a share of its linear part. None where the state does not move.
    """
    spread = float(np.std(values))
    if not spread > TINY:
        return np.zeros((len(values), 0))
    standard = (values - np.mean(values)) / spread
    # Where the process is written down exactly.
    points = np.linspace(standard.min(), standard.max(), 10)
    variance, directions = np.linalg.eigh(_covariance(points, points))
    is_kept = variance > 1e-4 * variance[-1]
    to_functions = directions[:, is_kept] / np.sqrt(variance[is_kept])
    functions: np.ndarray = _covariance(standard, points) @ to_functions
    functions -= functions.mean(axis=0)
    linear = np.outer(standard, standard @ functions) / len(standard)
    return functions - (1 - linear_share) * linear


def _covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(len(a), len(b))."""
    distance = (a[:, None] - b[None, :]) / LENGTH
    covariance: np.ndarray = np.exp(-(distance**2) / 2)
    return covariance


# --- All of them, and their sizes as a vector


@dataclass(frozen=True, eq=False)
class Disturbances:
    """Everything that acts and is not in the model, with its sizes."""

    # (n_trajectories, n_states) standard deviation of the white noise of every sensor.
    sigma: np.ndarray
    forces: tuple[Process, ...] = ()  # processes that act in equations
    sensors: tuple[Process, ...] = ()  # processes that add to what sensors show
    functions: tuple[StateFunction, ...] = ()  # of states, that act in equations

    @property
    def processes(self) -> tuple[Process, ...]:
        """All of them, forces first."""
        return (*self.forces, *self.sensors)

    @property
    def function_sizes(self) -> np.ndarray:
        return np.array([function.size for function in self.functions])

    @property
    def is_white(self) -> bool:
        """Whether there is white noise and nothing else."""
        return not (self.processes or self.functions)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Logarithms of sizes and times relative to those of given disturbances.

    All forces share the factor on their time where it is free, and so do all sensors.
    White processes, those with the shortest time, stay white. Of a large system the
    noises share a factor too, and so do the sizes of the forces, and of the sensors.
    """

    origin: Disturbances  # the disturbances at zero
    channels: tuple[int, ...]  # states whose white noise is estimated
    # (n_states,) least noise, white and lasting, mean over trajectories.
    least_noise: np.ndarray
    shortest: float = 0.0  # correlation time, at least
    longest: float = np.inf  # at most
    largest_functions: tuple[float, ...] = ()  # sizes of the functions, at most
    fixed_times: bool = False  # whether times stay as they are
    # Logarithms of the factor on a size between which a search stays: what is smaller
    # than a millionth of where it began is not there.
    smallest: float = -14.0
    largest: float = 7.0

    @property
    def is_tied(self) -> bool:
        """Whether sizes of one kind share a factor, as they do where there are many."""
        return len(self.channels) + len(self.origin.processes) > MOST_SIZES

    @cached_property
    def _members(self) -> list[tuple[list[int], float, float]]:
        """Of every coordinate the slopes that move together, and its bounds."""
        # Slopes are those of `ascent.Slopes`: noise of each channel, size of each
        # process, time of each process, size of each function.
        origin = self.origin
        n_channels, n_processes = len(self.channels), len(origin.processes)
        lowest = list(map(self._lowest_noise, self.channels))
        members = []
        for group in self._groups(0, n_channels):
            highest = max(lowest[place] for place in group)
            members.append((group, min(highest, 0.0), self.largest))
        first = n_channels
        for processes in (origin.forces, origin.sensors):
            for group in self._groups(first, len(processes)):
                members.append((group, self.smallest, self.largest))
            lasting = []
            for place, process in enumerate(processes, start=first + n_processes):
                if process.time > self.shortest and not self.fixed_times:
                    lasting.append((place, process.time))
            if lasting:
                times = np.array([self.shortest, self.longest]) / lasting[0][1]
                lower, upper = np.log(times).tolist()
                members.append(([place for place, _ in lasting], lower, upper))
            first += len(processes)
        first += n_processes
        pairs = zip(origin.functions, self.largest_functions, strict=True)
        for place, (function, largest) in enumerate(pairs, start=first):
            upper = max(float(np.log(largest / function.size)), 0.0)
            members.append(([place], self.smallest, upper))
        return members

    def _groups(self, first: int, n: int) -> list[list[int]]:
        """Which of ``n`` sizes of one kind share a factor."""
        places = list(range(first, first + n))
        if self.is_tied:
            return [places] if n else []
        return [[place] for place in places]

    def _lowest_noise(self, channel: int) -> float:
        """Coordinate of the least white noise of a channel."""
        # White noise is what errors that last leave of the least noise, and not less
        # than a tenth of it: the weight of a value is one over its white noise.
        least = self.least_noise[channel]
        lasting = [one.size for one in self.origin.sensors if one.place == channel]
        remaining = least**2 - sum(size**2 for size in lasting)
        white = float(np.sqrt(max(remaining, (0.1 * least) ** 2)))
        noise = float(np.mean(self.origin.sigma[:, channel]))
        return max(float(np.log(max(white / noise, TINY))), self.smallest)

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper bound of every coordinate, (2, n_coordinates)."""
        bounds = [limits for _, *limits in self._members]
        return np.array(bounds, dtype=float).reshape(-1, 2).T

    def is_free(self, distance: float) -> np.ndarray:
        """Whether the origin is farther from both bounds, (n_coordinates,) of bool."""
        lower, upper = self.bounds
        return np.asarray(np.minimum(-lower, upper) > distance)

    def among_slopes(self) -> np.ndarray:
        """Which slopes of `ascent.Slopes` belong to each coordinate, ones and zeros.

        (n_coordinates, n_slopes); a time that several processes share has the sum of
        their slopes.
        """
        origin = self.origin
        n = len(self.channels) + 2 * len(origin.processes) + len(origin.functions)
        rows = np.zeros((len(self._members), n))
        for row, (places, _, _) in zip(rows, self._members, strict=True):
            row[places] = 1.0
        return rows

    def at(self, vector: np.ndarray) -> Disturbances:
        """The disturbances of a vector (n_coordinates,)."""
        origin = self.origin
        n, n_processes = len(self.channels), len(origin.processes)
        factors = np.exp(self.among_slopes().T @ vector)
        ends = np.cumsum([n, n_processes, n_processes])
        noises, sizes, times, of_functions = np.split(factors, ends)
        sigma = origin.sigma.copy()
        sigma[:, list(self.channels)] *= noises
        processes = []
        for one, size, time in zip(origin.processes, sizes, times, strict=True):
            scaled = replace(one, size=one.size * float(size))
            processes.append(replace(scaled, time=one.time * float(time)))
        functions = []
        for function, size in zip(origin.functions, of_functions, strict=True):
            functions.append(replace(function, size=function.size * float(size)))
        n_forces = len(origin.forces)
        return Disturbances(
            sigma=sigma,
            forces=tuple(processes[:n_forces]),
            sensors=tuple(processes[n_forces:]),
            functions=tuple(functions),
        )
