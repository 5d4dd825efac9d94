"""Which column of a table plays which part, in the words of the readers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from phsi_opt.arguments import is_size
from phsi_opt.data.checks import check_unique, checked_names
from phsi_opt.errors import DataError

# name -> column, or a list of names which are columns
ColumnMap = Mapping[str, Any] | Sequence[str]

Part = tuple[str, ...]  # that a column plays, as a study file names it below [data]
RUN_PART: Part = ("trajectory",)
TIME_PART: Part = ("time", "column")


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which column plays which part.

    Attributes:
        time: The column of the times; None: they are counted.
        states: The column of each state, or None: not measured.
        inputs: The column of each input.
        trajectory: The column which names each row's trajectory, or None: the whole
            table is one trajectory.
        step: The time between neighbouring rows, where they are counted.
        start: The moment at which t is 0, where times are dates; None: the first sample
            of each trajectory.
        date_format: How dates are written, in the signs of strptime; None: as ISO 8601;
            "": the times are numbers, even where these look like dates.

    Raises:
        DataError: A name cannot be used, an input has no column, or what is said of the
            times does not go together.
    """

    states: Any
    time: Any = None
    inputs: Any = None
    trajectory: str | None = None
    step: float | None = None
    start: Any = None
    date_format: str | None = None

    def __post_init__(self) -> None:
        self._check_times()
        for what in ("inputs", "states"):
            columns = getattr(self, what)
            if not isinstance(columns, Mapping):
                names = checked_names(() if columns is None else columns, what)
                check_unique(names, "name")
                columns = dict(zip(names, names, strict=True))
            object.__setattr__(self, what, dict(columns))
        if None in self.inputs.values():
            raise DataError(
                f"inputs={self.inputs!r} has an input without a column; "
                "inputs must be measured."
            )

    def _check_times(self) -> None:
        step = self.step
        if (self.time is None) == (step is None):
            raise DataError(
                f"time={self.time!r} and step={step!r}; expected one of them: "
                "the column of the times, or the time between neighbouring rows."
            )
        if step is None:
            return
        if not is_size(step) or step == 0:
            raise DataError(
                f"step={step!r} is no time between rows; expected a positive number."
            )
        if self.start is not None or self.date_format is not None:
            raise DataError(
                "start and date_format are for dates in a column; "
                "with step=... leave them out."
            )

    @property
    def parts(self) -> dict[Part, Any]:
        """The column of each part, None where it has none."""
        parts: dict[Part, Any] = {RUN_PART: self.trajectory, TIME_PART: self.time}
        for what in ("states", "inputs"):
            for name, column in getattr(self, what).items():
                parts[what, name, "column"] = column
        return parts

    @property
    def columns(self) -> list[Any]:
        """The columns that are asked for."""
        return [column for column in self.parts.values() if column is not None]
