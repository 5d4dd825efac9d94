"""TODO."""

from dataclasses import replace

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError
from phsi_opt.model.model import Model


def aligned(model: Model, data: Measurements) -> Measurements:
    """The measurements with their states and inputs in the model's order; raises
    `DataError` if they do not match.

    States that are the memory of an effect need not be in the measurements: nobody
        measures them.
    """
    if unknown := [name for name in model.memory if name not in data.states]:
        runs = tuple(
            replace(
                run,
                x=np.column_stack(
                    [run.x, np.full((run.n_samples, len(unknown)), np.nan)]
                ),
            )
            for run in data.trajectories
        )
        data = replace(data, trajectories=runs, states=(*data.states, *unknown))
    for what, mine, theirs in (
        ("state", model.states, data.states),
        ("input", model.inputs, data.inputs),
    ):
        for name in mine:
            if name not in theirs:
                hint = (
                    f"; declare it as not measured: states={{..., {name!r}: None}}"
                    if what == "state"
                    else ""
                )
                raise DataError(
                    f"{what} {name!r} of the model is not in the measurements ({', '.join(theirs)}){hint}."
                )
    if extra := set(data.states) - set(model.states):
        raise DataError(
            f"state {sorted(extra)[0]!r} of the measurements is not in the model; leave its column out."
        )
    columns, inputs = (
        [data.states.index(n) for n in model.states],
        [data.inputs.index(n) for n in model.inputs],
    )
    if data.states == model.states and data.inputs == model.inputs:
        return data
    runs = tuple(
        replace(run, x=run.x[:, columns], u=run.u[:, inputs])
        for run in data.trajectories
    )
    kept = {"t", *model.states, *model.inputs}
    units = {name: unit for name, unit in data.units.items() if name in kept}
    return replace(
        data,
        trajectories=runs,
        states=tuple(model.states),
        inputs=tuple(model.inputs),
        units=units,
    )
