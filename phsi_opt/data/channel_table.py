"""The channels of measurements as a table: how many samples, their range, noise."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from phsi_opt.data.trajectory import Trajectory
from phsi_opt.presentation.table_making import printed_table

if TYPE_CHECKING:
    from phsi_opt.presentation.printed_table import PrintedTable


COLUMNS_OF_CHANNELS = (
    "channel",
    "part",
    "unit",
    "measured",
    "lowest",
    "highest",
    "noise",
)


class HasChannels(Protocol):
    """What `channel_table` asks of measurements."""

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """The trajectories."""

    @property
    def states(self) -> tuple[str, ...]:
        """The names of the states."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the inputs."""

    @property
    def units(self) -> Mapping[str, str]:
        """The unit of every channel."""

    @property
    def noise(self) -> Mapping[str, float] | None:
        """Standard deviations by state."""


def channel_table(data: HasChannels) -> "PrintedTable":
    """A row per channel, in `COLUMNS_OF_CHANNELS`; NaN for what is not known."""
    x = np.concatenate([run.x for run in data.trajectories])
    u = np.concatenate([run.u for run in data.trajectories])
    rows = [
        *_rows("state", data.states, x, data),
        *_rows("input", data.inputs, u, data),
    ]
    return printed_table(rows, columns=list(COLUMNS_OF_CHANNELS))


def _rows(
    part: str, names: Sequence[str], values: np.ndarray, data: HasChannels
) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    noise = data.noise or {}
    for name, column in zip(names, values.T, strict=True):
        known = column[np.isfinite(column)]
        lowest = known.min() if known.size else np.nan
        highest = known.max() if known.size else np.nan
        measured = f"{known.size} of {column.size}"
        sigma = noise.get(name, np.nan)
        rows.append((name, part, data.units[name], measured, lowest, highest, sigma))
    return rows
