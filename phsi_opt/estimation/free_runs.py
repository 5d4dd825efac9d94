"""The free run of a fit, and what it warns of.

A free run begins at a state that was estimated from the whole record and never looks at
the measurements again; after a gap with an unknown input it begins anew. Steps of the
transcription that are too long for a fast motion hide that an optimum is none: an
accurate run shows it.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from operator import attrgetter

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noticed import breaks_of
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit, parameter_matrix, parameters_of
from phsi_opt.initialization.relative_guesses import fast_motion
from phsi_opt.model.model import Model
from phsi_opt.simulation.simulate import free_run
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.sensors import outputs_at_samples

Runs = tuple[np.ndarray, ...]  # (n_samples, n_states) each
Parameters = Mapping[str, Mapping[str, float]]  # free ones, by trajectory and name
# Standard deviations of the measurements: stands for a free run that broke off.
DIVERGED_RUN = 1e3
# Error of a free run, in standard deviations of the measurements, from which a constant
# (one) describes them better by far: a motion out of step with them has 1.4.
LEAVING_ERROR = 2.0


def free_runs(
    model: Model,
    aligned: AlignedData,
    states: Sequence[np.ndarray],
    parameters: Parameters,
) -> tuple[Runs, Runs, Runs]:
    """Simulated states, what the sensors show of them, and measured minus shown."""
    data = aligned.data
    simulated = []
    for run, known in zip(data.trajectories, states, strict=True):
        own = model.with_values(parameters[run.name])
        ends = [0, *(breaks_of(run) + 1), run.n_samples]
        pieces = []
        for begin, end in pairwise(ends):
            x0 = known[begin]
            try:
                t, u = run.t[begin:end], run.u[begin:end]
                x = free_run(own, t, x0, u, data.hold)
            except SolveError:
                is_first = np.arange(end - begin)[:, None] == 0
                x = np.where(is_first, x0, DIVERGED_RUN * np.nanstd(run.x))
            pieces.append(x)
        simulated.append(np.vstack(pieces))
    theta = parameter_matrix(model, parameters)
    shown = outputs_at_samples(model, aligned.grid, simulated, theta)
    residuals = [run.x - y for run, y in zip(data.trajectories, shown, strict=True)]
    return tuple(simulated), tuple(shown), tuple(residuals)


def leaving_words(model: Model, data: Measurements, residuals: Runs) -> str:
    """What to do if a free run leaves the measurements; "" where it does not."""
    places = list(map(data.states.index, data.measured))
    spread = np.maximum(np.nanstd(data.stacked("x")[:, places], axis=0), TINY)
    squares = np.concatenate(residuals)[:, places] ** 2
    errors = np.sqrt(np.nanmean(squares, axis=0)) / spread
    worst = int(np.argmax(errors))
    if not errors[worst] > LEAVING_ERROR:
        return ""
    runs = ", ".join(map(attrgetter("name"), data.trajectories[:3]))
    advice = "choose other starting values for the parameters"
    if not model.free:
        advice = "the formulas and their fixed numbers"
    return (
        f"The free run of {data.measured[worst]} leaves the measurements ({runs}): its "
        f"error is {errors[worst]:.3g} times their standard deviation; a constant is "
        f"better. Check the units, and {advice}."
    )


def doubts_of(fit: Fit, aligned: AlignedData) -> str:
    """The warning to read first, of a fit and the data it was made from."""
    words = [fast_motion(fit.model, aligned.grid, aligned.data.units)]
    if fit.states and fit.outcome.success:
        parameters = parameters_of(fit, aligned.data)
        residuals = free_runs(fit.model, aligned, fit.states, parameters)[2]
        words.insert(0, leaving_words(fit.model, aligned.data, residuals))
    return " ".join(filter(None, words))
