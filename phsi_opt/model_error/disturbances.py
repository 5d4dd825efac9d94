"""What acts beside a model: noise, wandering forces and sensors, functions of a state.

Whatever a model leaves out of a machine shows as one of these. They are told apart by
what they do to the residuals: white noise lasts a sample, a sensor that wanders is seen
as it is, a force is seen through the model's own dynamics, and a function of a state
returns whenever the state does.
"""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.model_error.processes import Process


@dataclass(frozen=True)
class StateFunction:
    """An unknown smooth function of one state, in one equation.

    Attributes:
        equation: number of the equation that it acts in.
        state: number of the state that it is a function of.
        size: its standard deviation, in the unit of the equation.
    """

    equation: int
    state: int
    size: float


@dataclass(frozen=True, eq=False)
class Disturbances:
    """Everything that acts beside a model, with its sizes.

    Attributes:
        sigma: (n_trajectories, n_states) standard deviation of the white noise of every
            sensor.
        forces: processes that act in equations.
        sensors: processes that add to what sensors show.
        functions: of states, that act in equations.
    """

    sigma: np.ndarray
    forces: tuple[Process, ...] = ()
    sensors: tuple[Process, ...] = ()
    functions: tuple[StateFunction, ...] = ()

    @property
    def processes(self) -> tuple[Process, ...]:
        """All of them, forces first."""
        return (*self.forces, *self.sensors)

    @property
    def function_sizes(self) -> np.ndarray:
        """Size of every function, (n_functions,)."""
        return np.array([function.size for function in self.functions])

    @property
    def structure(self) -> "Structure":
        """Which there are, without their sizes."""
        return Structure(
            forces=tuple(process.place for process in self.forces),
            sensors=tuple(process.place for process in self.sensors),
            functions=tuple((f.equation, f.state) for f in self.functions),
        )

    @property
    def is_white(self) -> bool:
        """Whether there is white noise and nothing else."""
        return self.structure == Structure()

    def with_functions(self, functions: tuple[StateFunction, ...]) -> "Disturbances":
        """Other functions of states."""
        return replace(self, functions=functions)


@dataclass(frozen=True)
class Structure:
    """Which disturbances there are.

    Attributes:
        forces: equation of every force.
        sensors: channel of every sensor's process.
        functions: equation and state of every function.
    """

    forces: tuple[int, ...] = ()
    sensors: tuple[int, ...] = ()
    functions: tuple[tuple[int, int], ...] = ()
