"""Which experiment would tell two fitted models apart that the record does not.

The first model is taken for the truth. It is simulated in experiments derived from the
record (`experiments`), and the second model imitates it as well as it can: it is fitted
to the simulated record and the experiment together (`imitation`). What is left, over
the noise, is the separation: a difference that re-fitting removes does not count. Where
the second model imitates the first everywhere (it may contain it), the two change
places.

Each experiment changes one thing; inputs are not optimised.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.diagnosis.experiments import Experiment, SimulatedRecord, experiments
from phsi_opt.diagnosis.imitation import FittedModel
from phsi_opt.errors import DataError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.model import Model
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.tables import text_of_table
from phsi_opt.statistics import TINY

# Standard deviations of the whole experiment from which two models count as told apart.
SEPARATED_MODELS = 5.0
# Standard deviations per value below which two predictions are the same.
SAME_PREDICTION = 1e-3

if TYPE_CHECKING:
    import pandas as pd

MOST_SAMPLES = 1000  # of the record that are looked at
COLUMNS = ("experiment", "separation", "separates")


@dataclass(frozen=True, eq=False)
class Separation:
    """The experiments that were tried, best first.

    Attributes:
        table: a row per experiment. Columns: experiment (in words), separation (root
            mean square of the difference that re-fitting leaves, in standard deviations
            of the noise, per value measured), separates (whether the models count as
            told apart).
        in_record: the separation in the record itself.
        alike: whether the two predict the same in every experiment.
    """

    table: "pd.DataFrame" = field(repr=False)
    in_record: float
    alike: bool

    @property
    def sentence(self) -> str:
        """The best experiment in words."""
        if self.table.empty:
            return "no experiment could be simulated with both models"
        if self.alike:
            return (
                "no experiment of those tried separates them: "
                "they are the same model in other words"
            )
        best = self.table.iloc[0]
        size = f"{best['separation']:.2g} noise standard deviations"
        if not best["separates"]:
            return (
                "no experiment of those tried separates them; "
                f"the best is {best['experiment']}, by {size}"
            )
        return (
            f"{best['experiment']}: the two predictions then differ by {size}; "
            f"in this record by {self.in_record:.2g}."
        )

    def __str__(self) -> str:
        shown = text_of_table(self.table)
        return f"{self.sentence}\n{shown}"

    __repr__ = __str__


def separating(
    first: Fit, second: Fit, data: Measurements, noise: np.ndarray
) -> Separation:
    """Look for an experiment that tells one fitted model from another.

    Args:
        first: the fit that is taken for the truth.
        second: the fit that imitates it.
        data: the measurements that both were fitted to; their longest trajectory (its
            first `MOST_SAMPLES` samples) is what the experiments are derived from.
            States of a model that they do not hold count as not measured.
        noise: (n_states,) standard deviation of the measurement noise per state, in the
            order of the first model's states.

    Returns:
        The experiments, best first.

    Raises:
        DataError: the noise of a measured state is not positive.
        SolveError: the record itself cannot be simulated with both models.
    """
    number = int(np.argmax([run.n_samples for run in data.trajectories]))
    by_state = _noise_of(first.model, data, noise)
    source = _Source(data, data.trajectories[number], by_state)
    one = FittedModel(first, data, number)
    other = FittedModel(second, data, number)
    found = _separation(one, other, source)
    return _separation(other, one, source) if found.alike else found


@dataclass(frozen=True, eq=False)
class _Source:
    """The trajectory that experiments are derived from.

    Attributes:
        data: the measurements that hold it.
        trajectory: one of theirs.
        noise: standard deviation by measured state.
    """

    data: Measurements
    trajectory: Trajectory
    noise: Mapping[str, float]

    def simulated(self, truth: FittedModel) -> SimulatedRecord:
        """The record as a model runs along it.

        Raises:
            SolveError: it cannot be simulated.
        """
        t = self.trajectory.t[:MOST_SAMPLES]
        u = self.trajectory.u[:MOST_SAMPLES]
        itself = Experiment("the record", t, u, self.data.measured)
        shown = truth.shown(itself, self.data.states)
        if shown is None:
            raise SolveError(_not_simulated(self.trajectory.name, truth.model))
        return SimulatedRecord(itself, self.data, truth.model, truth.x0, shown)

    def noise_with(self, spread: Mapping[str, float]) -> dict[str, float]:
        """The noise of those sensors there are, and of those there could be.

        A further sensor would have the same share of the spread as those there are, on
        average.
        """
        shares = []
        for name in self.data.measured:
            shares.append(self.noise[name] / max(spread[name], TINY))
        share = float(np.mean(shares))
        noise = {}
        for name in self.data.states:
            if name not in self.noise and spread[name] > 0:
                noise[name] = share * spread[name]
        return {**noise, **self.noise}


def _separation(
    truth: FittedModel, imitator: FittedModel, source: _Source
) -> Separation:
    """How well every experiment tells the imitator from the truth."""
    simulated = source.simulated(truth)
    record = simulated.experiment
    noise = source.noise_with(simulated.spread)

    def misfit(experiments: Sequence[Experiment]) -> float | None:
        shown = truth.measurements(experiments)
        return None if shown is None else imitator.misfit(shown, noise)

    in_record = misfit([record])
    if in_record is None:
        raise SolveError(_not_simulated(source.trajectory.name, imitator.model))
    rows = []
    for experiment in experiments(simulated):
        in_both = misfit([record, experiment])
        if in_both is not None:
            added = max(in_both - in_record, 0.0)
            size = np.sqrt(added / experiment.n_values)
            rows.append((experiment.name, size, bool(added >= SEPARATED_MODELS**2)))
    table = printed_table(rows, columns=list(COLUMNS)).sort_values(
        "separation", ascending=False, kind="stable", ignore_index=True
    )
    size_in_record = float(np.sqrt(in_record / record.n_values))
    alike = bool((table["separation"] < SAME_PREDICTION).all())
    return Separation(table, size_in_record, alike)


def _not_simulated(trajectory: str, model: Model) -> str:
    return (
        f"trajectory {trajectory!r} cannot be simulated with the model of "
        f"{', '.join(model.free)}, or not be imitated by it: it is stiff, or its "
        "solution ends; "
        "look for the experiment by `simulate` instead."
    )


def _noise_of(model: Model, data: Measurements, noise: np.ndarray) -> dict[str, float]:
    """By measured state.

    Raises:
        DataError: one is not positive.
    """
    values = np.asarray(noise, dtype=float).tolist()
    # A model with memory has more states than its noise names.
    by_state = dict(zip(model.states, values, strict=False))
    for name in data.measured:
        if not 0 < by_state.get(name, np.nan) < np.inf:
            raise DataError(
                f"noise of {name!r} is {by_state.get(name)!r}; "
                "expected a positive standard deviation per measured state, "
                "such as `Comparison.sigma`."
            )
    return {name: by_state[name] for name in data.measured}
