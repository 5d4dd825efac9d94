"""The task of one call of `identify`: model, measurements and settings, as given.

What is found is an `Estimate`; nothing is computed here.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.transcription.grid import AlignedData, Grid
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss

Loss = PHSILoss | MaximumLikelihood
Progress = Callable[[str], None]


def silent(line: str) -> None:
    """The `Progress` that says nothing."""


def unchanged(grid: Grid) -> Grid:
    """The layout without inputs beyond those of the measurements."""
    return grid


@dataclass(frozen=True, eq=False)
class Task:
    """Model, measurements and settings of one call of `identify`.

    Attributes:
        model: with its free parameters at values to start from.
        aligned: measurements in the model's order, laid out.
        l1: weight of ``|coefficient|`` per slot, in units of the scaled loss.
        pruning: how terms are removed; None keeps them all.
        settings: of every solve.
        say: called with a line of text as the work goes on.
        layout: adds inputs to the grid that the measurements do not hold.
        executor: where further starts are solved; None: here.
    """

    model: Model
    aligned: AlignedData
    l1: dict[str, float]
    pruning: Pruning | None
    settings: SolverSettings
    say: Progress = silent
    layout: Callable[[Grid], Grid] = unchanged
    executor: Executor | None = None

    @property
    def data(self) -> Measurements:
        """The measurements, states and inputs in the model's order."""
        return self.aligned.data

    @property
    def grid(self) -> Grid:
        """The measurements laid out, one interval between neighbouring samples."""
        return self.aligned.grid

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the trajectories."""
        return tuple(run.name for run in self.data.trajectories)
