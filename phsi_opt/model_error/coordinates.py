"""Disturbances as a vector of logarithms, for a search over their sizes and times."""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.processes import Process
from phsi_opt.statistics import TINY

# Logarithm of the factor on a size down to which a search goes: what is smaller than a
# millionth of where it began is not there.
SMALLEST_LOG = -14.0
LARGEST_LOG = 7.0  # and up to which it goes
# Sizes of noises and processes that are estimated one by one, at most: beyond, those of
# one kind keep their ratios.
MOST_SIZES = 27


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Logarithms of sizes and times relative to those of given disturbances.

    All forces share the factor on their time where it is free, and so do all sensors.
    White processes, those with the shortest time, stay white. Of a large system the
    noises share a factor too, and so do the sizes of the forces, and of the sensors.

    Attributes:
        origin: the disturbances at zero.
        channels: states whose white noise is estimated.
        least_noise: (n_states,) least noise, white and lasting, mean over trajectories.
        shortest: correlation time, at least.
        longest: at most.
        largest_functions: sizes of the functions, at most.
        fixed_times: whether times stay as they are.
    """

    origin: Disturbances
    channels: tuple[int, ...]
    least_noise: np.ndarray
    shortest: float = 0.0
    longest: float = np.inf
    largest_functions: tuple[float, ...] = ()
    fixed_times: bool = False

    @property
    def is_tied(self) -> bool:
        """Whether sizes of one kind share a factor, as they do where there are many."""
        return len(self.channels) + len(self.origin.processes) > MOST_SIZES

    def _groups(self, n: int) -> list[list[int]]:
        """Which of ``n`` sizes of one kind share a factor."""
        if self.is_tied:
            return [list(range(n))] if n else []
        return [[place] for place in range(n)]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Lower and upper bound of every coordinate."""
        origin = self.origin
        bounds = []
        lowest = []
        for channel in self.channels:
            noise = float(np.mean(origin.sigma[:, channel]))
            least = self._least_white(channel) / noise
            lowest.append(max(float(np.log(max(least, TINY))), SMALLEST_LOG))
        for group in self._groups(len(self.channels)):
            highest = max(lowest[place] for place in group)
            bounds.append((min(highest, 0.0), LARGEST_LOG))
        bounds += self._bounds_of(origin.forces)
        bounds += self._bounds_of(origin.sensors)
        limits = zip(origin.functions, self.largest_functions, strict=True)
        for function, largest in limits:
            bounds.append(
                (SMALLEST_LOG, max(float(np.log(largest / function.size)), 0.0))
            )
        return bounds

    def _least_white(self, channel: int) -> float:
        """White noise of a channel, at least: what errors that last leave of its noise.

        Not less than a tenth of it: the weight of a value is one over its white noise.
        """
        least = self.least_noise[channel]
        lasting = [one.size for one in self.origin.sensors if one.place == channel]
        left = least**2 - sum(size**2 for size in lasting)
        return float(np.sqrt(max(left, (0.1 * least) ** 2)))

    def is_free(self, distance: float) -> np.ndarray:
        """Whether the origin is farther from both bounds, (n_coordinates,) of bool."""
        nearest = np.array([min(-lower, upper) for lower, upper in self.bounds])
        return np.asarray(nearest > distance)

    def among_slopes(self) -> np.ndarray:
        """Which slopes of `ascent.Slopes` belong to each coordinate, ones and zeros.

        (n_coordinates, n_slopes); a time that several processes share has the sum of
        their slopes.
        """
        origin = self.origin
        n_channels = len(self.channels)
        n_processes = len(origin.forces) + len(origin.sensors)
        n_functions = len(origin.functions)
        units = np.eye(n_channels + 2 * n_processes + n_functions)
        rows = self._sums(units[:n_channels])
        first = n_channels
        for processes in (origin.forces, origin.sensors):
            last = first + len(processes)
            rows += self._sums(units[first:last])
            lasting = np.array([self._lasts(process) for process in processes])
            if lasting.any() and not self.fixed_times:
                times = units[first + n_processes : last + n_processes]
                rows.append(times[lasting].sum(axis=0))
            first = last
        rows += [*units[n_channels + 2 * n_processes :]]
        return np.array(rows).reshape(len(rows), len(units))

    def _sums(self, units: np.ndarray) -> list[np.ndarray]:
        """A row per group, (n_slopes,), of a row per size."""
        return [units[group].sum(axis=0) for group in self._groups(len(units))]

    def _bounds_of(self, processes: tuple[Process, ...]) -> list[tuple[float, float]]:
        bounds = [(SMALLEST_LOG, LARGEST_LOG)] * len(self._groups(len(processes)))
        times = [p.time for p in processes if self._lasts(p)]
        if times and not self.fixed_times:
            lower = np.log(self.shortest / times[0])
            bounds.append((lower, np.log(self.longest / times[0])))
        return bounds

    def _lasts(self, process: Process) -> bool:
        return process.time > self.shortest

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
            moved = replace(one, size=one.size * float(size))
            processes.append(replace(moved, time=one.time * float(time)))
        functions = []
        for function, size in zip(origin.functions, of_functions, strict=True):
            functions.append(replace(function, size=function.size * float(size)))
        n_forces = len(origin.forces)
        return replace(
            origin,
            sigma=sigma,
            forces=tuple(processes[:n_forces]),
            sensors=tuple(processes[n_forces:]),
            functions=tuple(functions),
        )
