"""A second look: what an effect explains when the model with it is linearised anew.

Screening linearises the base model once, and a base that is far off makes that poor:
what a candidate changes of the states is not seen. Here Gauss-Newton steps go along the
model with the candidate, from the states and values that screening expects, parameters
within their bounds. A step costs one factorisation of the record, a hundredth of a
re-fit, so that every effect can be looked at before one is re-fitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.screening.effect_size import Size, new_names, size_of
from phsi_opt.screening.linearized_record import LinearizedRecord, likelihood_of
from phsi_opt.statistics import TINY, effective_sample_share, profiled_deviance
from phsi_opt.transcription.augmented_states import with_memory

MOST_GAUSS_NEWTON = 4  # of Gauss and Newton
# Relative change of the misfit from one step to the next below which they end, and the
# largest at which the last one is believed.
SETTLED_MISFIT = 0.01
LARGEST_UNSETTLED_CHANGE = 0.3


@dataclass(frozen=True, eq=False)
class Look:
    """Where steps along a model lead.

    Attributes:
        model: with the values that were reached.
        linearized: the model at its last states but one step.
        misfit: squared residuals that are left, in units of the noise variance.
        change: of the misfit in the last step, as a share of it.
    """

    model: Model
    linearized: LinearizedRecord = field(repr=False)
    misfit: float
    change: float

    @property
    def residual(self) -> np.ndarray:
        """In units of the noise, (n_values,)."""
        return self.linearized.within_bounds.residual

    @property
    def deviance(self) -> float:
        """Of the last step, up to a constant (see ``profiled_deviance``)."""
        grid = self.linearized.grid
        counts = grid.measured.sum(axis=0)
        squares = counts * grid.rms_by_channel(self.residual) ** 2
        return profiled_deviance(squares, counts)

    @property
    def states(self) -> np.ndarray:
        """Where a re-fit may begin, (n_nodes, n_states)."""
        return self.linearized.states_within_bounds

    def size(self, effect: Effect, base: Model, share: float) -> Size:
        """Size of an effect, for a share of the residuals that is independent.

        Args:
            effect: that the model has more than the base.
            base: the model without it.
            share: of the residuals that is independent.
        """
        at = self.linearized
        names = new_names(base, effect, at.unknown.names)
        places = [at.unknown.names.index(name) for name in names]
        variance = max(self.misfit / at.n_values, 1.0) / max(share, TINY)
        covariance = at.covariance[np.ix_(places, places)]
        values = self.model.values
        return size_of(effect, self.model, names, values, variance * covariance)


def independent_share(before: Look, after: Look) -> float:
    """Share of the residuals that is independent, for the change between two looks."""
    smaller = before.linearized
    is_shared = after.linearized.grid.channel < smaller.model.n_states
    residual = after.residual[is_shared]
    size = smaller.grid.rms_by_channel(residual) + TINY
    return effective_sample_share(
        smaller.by_trajectory(before.residual - residual, size),
        smaller.by_trajectory(residual, size),
    )


def second_look(
    record: Record,
    effects: Sequence[Effect],
    values: Mapping[str, float],
    is_held: bool = False,
) -> Look | None:
    """Gauss-Newton steps along a record's model with effects more.

    Args:
        record: of the base model.
        effects: added to it; none: the base model itself.
        values: of parameters, from which to start; others as in the record.
        is_held: whether parameters stay at these values, but for those that are
            `estimated_here`: what the model leaves on data that it was not fitted to.

    Returns:
        None where the model cannot be linearised, or the steps do not settle.
    """
    try:
        model = record.model.with_values(record.estimate.rounded)
        for effect in effects:
            model = model.add(effect)
        with np.errstate(all="ignore"):  # steps that lead nowhere are left
            look = _settled(record, model, values, is_held)
    except (PhsiOptError, np.linalg.LinAlgError, ValueError):
        return None
    is_known = np.isfinite(look.misfit) and look.change < LARGEST_UNSETTLED_CHANGE
    return look if is_known else None


def _settled(
    record: Record, model: Model, values: Mapping[str, float], is_held: bool
) -> Look:
    """Steps until the misfit hardly changes, or there were enough of them."""
    estimate = record.estimate
    model = resolve_guesses(model, estimate.grid, estimate.x)
    known = {name: value for name, value in values.items() if name in model.entries}
    model = model.with_values(known)
    parameters = _parameters(record, model, known)
    grid = record.aligned.for_model(model).grid
    states = with_memory(model, grid, estimate.x, parameters)
    likelihood = likelihood_of(record, model, grid)
    held = set(model.free) - record.estimated_here(model) if is_held else set()

    def linearized(x: np.ndarray, theta: np.ndarray) -> LinearizedRecord:
        return LinearizedRecord.at(record, likelihood, x, theta, held)

    at = linearized(states, parameters)
    misfit = at.within_bounds.misfit
    change = np.inf
    for _ in range(MOST_GAUSS_NEWTON):
        at = linearized(at.states_within_bounds, at.parameters_within_bounds)
        change = abs(at.within_bounds.misfit / misfit - 1)
        misfit = at.within_bounds.misfit
        if change < SETTLED_MISFIT:
            break
    means = at.parameters_within_bounds.mean(axis=1)
    reached = dict(zip(model.free, means.tolist(), strict=True))
    return Look(model.with_values(reached), at, misfit, float(change))


def _parameters(
    record: Record, model: Model, values: Mapping[str, float]
) -> np.ndarray:
    """Parameters to start from, (n_free, n_trajectories).

    Those of ``values``, but for what every trajectory has of its own.
    """
    own = dict(zip(record.model.free, record.theta, strict=True))
    n_trajectories = len(record.trajectories)
    rows = []
    for name in model.free:
        is_local = model.entries[name].parameter.per_trajectory
        if name in own and (is_local or name not in values):
            rows.append(own[name])
        else:
            rows.append(np.full(n_trajectories, model.values[name]))
    return np.array(rows).reshape(-1, n_trajectories)
