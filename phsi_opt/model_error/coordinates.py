"""Disturbances as a vector of logarithms, for a search over their sizes and times."""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.model_error.disturbances import Disturbances, StateFunction
from phsi_opt.model_error.processes import Process

# Logarithm of the factor on a size down to which a search goes: what is smaller than a
# millionth of where it began is not there.
SMALLEST = -14.0
LARGEST = 7.0  # and up to which it goes


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Logarithms of sizes and times relative to those of given disturbances.

    All forces share the factor on their time where it is free, and so do all sensors.

    Attributes:
        origin: the disturbances at zero.
        channels: states whose white noise is estimated.
        shortest: correlation time, at least.
        longest: at most.
        fixed_times: whether the times of the forces stay as they are.
    """

    origin: Disturbances
    channels: tuple[int, ...]
    shortest: float
    longest: float
    fixed_times: bool = False

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Lower and upper bound of every coordinate."""
        origin = self.origin
        bounds = [(SMALLEST, LARGEST)] * len(self.channels)
        bounds += self._bounds_of(origin.forces, self.fixed_times)
        bounds += self._bounds_of(origin.sensors, False)
        bounds += [(SMALLEST, LARGEST)] * len(origin.functions)
        return bounds

    def _bounds_of(
        self, processes: tuple[Process, ...], fixed: bool
    ) -> list[tuple[float, float]]:
        bounds = [(SMALLEST, LARGEST)] * len(processes)
        if processes and not fixed:
            time = processes[0].time
            bounds.append((np.log(self.shortest / time), np.log(self.longest / time)))
        return bounds

    def at(self, vector: np.ndarray) -> Disturbances:
        """The disturbances of a vector (n_coordinates,)."""
        left = list(vector)
        sigma = self.origin.sigma.copy()
        for channel in self.channels:
            sigma[:, channel] *= np.exp(left.pop(0))
        forces = self._moved(self.origin.forces, left, self.fixed_times)
        sensors = self._moved(self.origin.sensors, left, False)
        functions: list[StateFunction] = []
        for function in self.origin.functions:
            size = function.size * float(np.exp(left.pop(0)))
            functions.append(replace(function, size=size))
        return Disturbances(sigma, forces, sensors, tuple(functions))

    def _moved(
        self, processes: tuple[Process, ...], left: list[float], fixed: bool
    ) -> tuple[Process, ...]:
        """Take the coordinates of these processes off the list."""
        if not processes:
            return ()
        sizes = []
        for process in processes:
            sizes.append(process.size * float(np.exp(left.pop(0))))
        factor = 1.0 if fixed else float(np.exp(left.pop(0)))
        moved = []
        for process, size in zip(processes, sizes, strict=True):
            time = process.time * factor
            moved.append(Process(process.place, size, time))
        return tuple(moved)
