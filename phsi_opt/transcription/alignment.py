"""Measurements in the model's order: the same states and inputs, in the same places.

From here on a column is addressed by its number, which means the same in the model and
in the data. Units and noise stay with their names; values are never changed. A run that
is an exact copy of another is left out here: in all that follows it counts once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.data.copies import copies_in, counted_once, sentence_about
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid, grid_of


@dataclass(frozen=True, eq=False)
class AlignedData:
    """Measurements with states and inputs in a model's order, and their layout.

    Made once and handed on: alignments for larger models are kept, so that none is made
    twice however often it is asked for.

    Attributes:
        data: the measurements.
        grid: the same laid out with one interval between neighbouring samples.
        notes: what a user should know of them: runs that are copies of others.
    """

    data: Measurements
    grid: Grid
    notes: tuple[str, ...] = ()
    _larger: dict[tuple[str, ...], "AlignedData"] = field(
        default_factory=dict, repr=False
    )

    @classmethod
    def of(cls, model: Model, data: Measurements) -> "AlignedData":
        """Align and lay out measurements that hold what the model needs.

        Raises:
            DataError: a state or input of the model is not in the measurements, or one
                of theirs is not in the model; or these are no measurements.
            ModelError: the model is none.
        """
        if not isinstance(model, Model):
            raise ModelError(
                f"model={model!r} is no model; expected a PseudoHamiltonian or a "
                "FirstOrder."
            )
        if not isinstance(data, Measurements):
            raise DataError(
                f"data={data!r} are no Measurements; make them with "
                "Measurements.from_arrays or from_csv."
            )
        ordered = aligned(model, data)
        copies = copies_in(ordered)
        once = counted_once(ordered, copies)
        notes = (sentence_about(copies),) if copies else ()
        return cls(once, grid_of(once), notes)

    def for_model(self, model: Model) -> "AlignedData":
        """The same for a model that has states more; itself where it has none."""
        if (model.states, model.inputs) == (self.data.states, self.data.inputs):
            return self
        states = tuple(model.states)
        if states not in self._larger:
            data = aligned(model, self.data)
            self._larger[states] = AlignedData(data, grid_of(data), self.notes)
        return self._larger[states]

    def grid_with(self, steps: Sequence[np.ndarray]) -> Grid:
        """The layout with further nodes between samples.

        Args:
            steps: intervals in every gap between samples, one (n_samples - 1,) per
                trajectory.
        """
        if all(np.all(n == 1) for n in steps):
            return self.grid
        return grid_of(self.data, steps)


def aligned_once(model: Model, data: Measurements) -> Measurements:
    """`aligned`, without runs that are exact copies of others.

    Raises:
        DataError: as `aligned`.
    """
    ordered = aligned(model, data)
    return counted_once(ordered, copies_in(ordered))


def aligned(model: Model, data: Measurements) -> Measurements:
    """The measurements with their states and inputs in the model's order.

    States that are the memory of an effect need not be in the measurements: nobody
    measures them. They are added as columns of NaN. Measurements that are in the
    model's order already are returned as they are.

    Raises:
        DataError: a state or an input of the model is not in the measurements, or the
            measurements have a state that the model has not.
    """
    data = _with_memory_columns(data, model.memory)
    _check_names(model, data)
    if data.states == model.states and data.inputs == model.inputs:
        return data
    state_columns = [data.states.index(name) for name in model.states]
    input_columns = [data.inputs.index(name) for name in model.inputs]
    trajectories = tuple(
        replace(run, x=run.x[:, state_columns], u=run.u[:, input_columns])
        for run in data.trajectories
    )
    kept = {"t", *model.states, *model.inputs}
    units = {name: unit for name, unit in data.units.items() if name in kept}
    hold = data.hold
    if not isinstance(hold, str):
        hold = {name: hold[name] for name in model.inputs}
    return replace(
        data,
        trajectories=trajectories,
        states=tuple(model.states),
        inputs=tuple(model.inputs),
        units=units,
        hold=hold,
    )


def _with_memory_columns(data: Measurements, memory: Sequence[str]) -> Measurements:
    """The measurements with the memory's states that they lack, as never measured."""
    lacking = [name for name in memory if name not in data.states]
    if not lacking:
        return data
    trajectories = []
    for run in data.trajectories:
        not_measured = np.full((run.n_samples, len(lacking)), np.nan)
        x = np.column_stack([run.x, not_measured])
        trajectories.append(replace(run, x=x))
    return replace(
        data, trajectories=tuple(trajectories), states=(*data.states, *lacking)
    )


def _check_names(model: Model, data: Measurements) -> None:
    for name in model.states:
        if name not in data.states:
            raise DataError(
                f"state {name!r} of the model is not in the measurements "
                f"({', '.join(data.states)}); declare it as not measured: "
                f"states={{..., {name!r}: None}}."
            )
    for name in model.inputs:
        if name not in data.inputs:
            raise DataError(
                f"input {name!r} of the model is not in the measurements "
                f"({', '.join(data.inputs)})."
            )
    extra = sorted(set(data.states) - set(model.states))
    if extra:
        raise DataError(
            f"state {extra[0]!r} of the measurements is not in the model; "
            "leave its column out."
        )
