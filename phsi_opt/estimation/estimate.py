"""A task of `identify`, and its estimate: the solved program of a loss.

An estimate still holds the measurements and their layout, so it is not saved;
`Estimate.fit` takes from it what a user reads. What differs between the losses
(residuals, standard errors) is said by the subclasses.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import TypeVar

import numpy as np
import scipy

from phsi_opt.arguments import require_choice, require_share, require_size, typed
from phsi_opt.data.checks import checked_hold
from phsi_opt.errors import ModelError
from phsi_opt.estimation.fit import (
    OF_SENSOR,
    SENSOR_ERROR,
    Fit,
    FitUncertainty,
    ModelErrorRow,
)
from phsi_opt.estimation.uncertainty import Uncertainty, unknown
from phsi_opt.later import Later
from phsi_opt.model.laws import parameter_words
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import parameter_units
from phsi_opt.model.slots import Entry
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.standard_errors import Source, Spread, StandardErrors
from phsi_opt.optimization.ipopt import Solution, SolverSettings
from phsi_opt.presentation.units import Scale, rate_unit, scale_of, spaced
from phsi_opt.statistics import TINY, chi_square_limit
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.grid import AlignedData, Grid, WithMeasurements
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss
from phsi_opt.transcription.parameter_vector import Point, Theta

Loss = PHSILoss | MaximumLikelihood
TERM_SLOTS = ("H", "R", "F")


@typed
@dataclass(frozen=True)
class Pruning:
    """Remove terms that are too small or not significant, and solve again, repeatedly.

    Args:
        threshold: terms with ``|coefficient| < threshold`` go (thesis Algorithm 6; 0:
            none).
        slots: slots from which terms may be removed (by default not R, since a small
            damping is still a damping).
        debias: solve the last time without L1, because L1 shrinks all coefficients.
            Required for significance.
        max_rounds: largest number of solves.
        significance: probability, over the whole dictionary, of keeping any term whose
            true coefficient is zero. Terms are removed if two tests allow a zero
            coefficient: a z-test of each term at significance / number of terms
            (Bonferroni), and Wald's chi-square test (1943) of all terms of a round
            together. None: threshold only.

    Raises:
        ModelError: a setting is not valid.
    """

    threshold: float = 0.05
    slots: tuple[str, ...] = ("H", "F")
    debias: bool = True
    max_rounds: int = 50
    significance: float | None = None

    def __post_init__(self) -> None:
        require_size("Pruning: threshold", self.threshold)
        for slot in self.slots:
            require_choice("Pruning: slot", slot, TERM_SLOTS)
        if self.significance is None:
            return
        require_share("Pruning: significance", self.significance)
        if not self.debias:
            raise ModelError(
                "significance needs debias=True: a coefficient that L1 shrinks has no "
                "standard error."
            )

    def candidates(self, model: Model) -> list[str]:
        """Names of the coefficients that may go."""
        names = []
        for name, entry in model.entries.items():
            is_free_term = entry.prunable and not entry.parameter.fixed
            if is_free_term and entry.slot in self.slots:
                names.append(name)
        return names

    def small(self, model: Model, values: dict[str, float]) -> set[str]:
        """Names of the coefficients to remove for their size."""
        candidates = self.candidates(model)
        return {name for name in candidates if abs(values[name]) < self.threshold}

    def insignificant(
        self,
        model: Model,
        values: dict[str, float],
        covariance: np.ndarray,
        n_tests: int,
    ) -> set[str]:
        """Names of the coefficients to remove because zero explains the data as well.

        By their covariance (n_free, n_free), in the order of ``model.free``; a
        coefficient without a standard error (NaN) stays. ``n_tests`` is the number of
        terms before pruning.
        """
        if self.significance is None:
            return set()
        z = {}  # |estimate| / standard error
        for name in self.candidates(model):
            place = model.free.index(name)
            z[name] = abs(values[name]) / np.sqrt(covariance[place, place])
        limit = -scipy.special.ndtri(self.significance / max(n_tests, 1) / 2)
        weak = [name for name in z if z[name] < limit]
        weak.sort(key=z.__getitem__)
        while len(weak) > 1:
            together = _wald(weak, model, values, covariance)
            if together < chi_square_limit(self.significance, len(weak)):
                break
            weak.pop()
        return set(weak)


@dataclass(frozen=True, eq=False)
class Task(WithMeasurements):
    """Model, measurements and settings of one call of `identify`."""

    model: Model  # with its free parameters at values to start from
    aligned: AlignedData  # measurements in the model's order, laid out
    # Weight of ``|coefficient|`` per slot, in units of the scaled loss.
    l1: dict[str, float]
    pruning: Pruning | None  # how terms are removed; None keeps them all
    settings: SolverSettings  # of every solve
    say: Progress = silent  # called with a line of text as the work goes on
    executor: Executor | None = None  # where further starts are solved; None: here
    corners: tuple[str, ...] = ()  # widths of dry friction's that may become sharper


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(ABC):
    """The model (after pruning), its program and the solution."""

    task: Task  # what was asked for
    loss: Loss  # what was minimised
    model: Model  # with the terms that were kept; its values are those before the solve
    grid: Grid  # nodes and intervals of the program
    unknown: Theta  # names and places of the free parameters
    point: Point  # where the solver started, with the scale of each unknown
    solution: Solution  # of its program
    l1: dict[str, float]  # the weights that this program has; empty after debiasing
    removed: tuple[str, ...] = ()  # names of the coefficients that pruning removed
    notes: tuple[str, ...] = ()  # sentences for the warnings of the fit

    @property
    @abstractmethod
    def misfit(self) -> float:
        """The loss without its L1 terms."""

    @property
    def n_values(self) -> int:
        """Number of residuals, those of the measured values."""
        return len(self.grid.channel)

    @property
    def deviance(self) -> float:
        """-2 log likelihood; NaN for a loss that has none."""
        return np.nan

    @property
    def bic(self) -> float:
        """Bayesian information criterion, deviance + n_theta log(n_values)."""
        return self.deviance + len(self.unknown) * float(np.log(self.n_values))

    @abstractmethod
    def uncertainty_at_optimum(self) -> Uncertainty:
        """Covariance of theta at an optimum without an L1 term."""

    @property
    def is_success(self) -> bool:
        return self.solution.outcome.success

    @property
    def theta(self) -> np.ndarray:
        """The estimates in the order of `Theta`, (n_theta,)."""
        return self.solution.values["theta"]

    @property
    def values(self) -> dict[str, float]:
        """One value per parameter of the model, the mean over the trajectories."""
        means = self.unknown.means(self.theta).tolist()
        return dict(zip(self.model.free, means, strict=True))

    @property
    def has_l1(self) -> bool:
        return any(self.l1.values())

    @property
    def nodes(self) -> np.ndarray:
        """States at the nodes, (n_nodes, n_states)."""
        return self.solution.values["x"].reshape(self.grid.y.shape)

    @property
    def standard_errors(self) -> StandardErrors | None:
        """Those that count model error; None if `uncertainty` has all that is known."""
        return None

    @property
    def covariance_by_noise(self) -> np.ndarray:
        """Covariance of theta, (n_theta, n_theta), by noise alone."""
        return self.uncertainty.covariance

    def covariance_by(self, spread: Spread) -> np.ndarray:
        """By a spread, in the parameters' units; NaN where `uncertainty` gives none."""
        scale = self.point.theta_scale
        known = spread.covariance * np.outer(scale, scale)
        return np.where(np.isfinite(self.uncertainty.covariance), known, np.nan)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the estimates, where it is known."""
        n_theta = len(self.unknown.names)
        if not self.is_success:
            return unknown(
                n_theta, "no standard errors: the solver did not reach an optimum"
            )
        if self.has_l1:
            return unknown(
                n_theta,
                "no standard errors: the L1 term shrinks the coefficients "
                "(prune with debias)",
            )
        return self.uncertainty_at_optimum()

    def noise_by_name(self, sigma: np.ndarray) -> dict[str, float]:
        """Noise of the measured states, from that of all, (n_states,)."""
        measured = np.flatnonzero(self.grid.measured_states).tolist()
        return {self.model.states[k]: float(sigma[k]) for k in measured}

    def fit(self) -> Fit:
        data = self.task.data
        by_trajectory = {}
        if not self.unknown.is_shared:
            for run in self.unknown.runs:
                by_trajectory[run] = self.unknown.values_of(self.theta, run)
        provenance = {
            "phsi_opt": _release(),
            "loss": repr(self.loss),
            "l1": dict(self.task.l1),
            "pruning": repr(self.task.pruning),
            "data_sha256": data.digest,
            "n_trajectories": data.n_trajectories,
            "n_samples": data.n_samples,
        }
        return Fit(
            model=self.model.with_values(self.values),
            names=self.unknown.names,
            by_trajectory=by_trajectory,
            loss=type(self.loss).__name__,
            loss_value=self.misfit,
            uncertainty=Later(self.fit_uncertainty),
            noise={},
            outcome=self.solution.outcome,
            n_values=self.n_values,
            hold=checked_hold(data.hold, self.model.inputs),
            units=dict(data.units),
            removed=self.removed,
            provenance=provenance,
        )

    def fit_uncertainty(self) -> FitUncertainty:
        """How well the estimates are known, with all that was worked out about it."""
        warnings = [*self.task.aligned.notes, *self.notes]
        if self.removed:
            warnings.append(
                "standard errors treat the selected terms as known; they do not "
                f"include the uncertainty of the selection ({len(self.removed)} terms "
                "were removed)"
            )
        warnings += map(self._bound_warning, self.solution.outcome.at_bounds)
        warnings += self._prior_notes()
        warnings += self.uncertainty.warnings
        covariance = self.uncertainty.covariance
        known = FitUncertainty(covariance=covariance, warnings=tuple(warnings))
        found = self.standard_errors
        if found is None:
            return known
        covariances = {Source.NOISE: self.covariance_by_noise}
        for source, spread in found.spreads.items():
            if source != Source.NOISE:
                covariances[source] = self.covariance_by(spread)
        return replace(
            known,
            covariance=covariances[found.source],
            source=found.source,
            covariances=covariances,
            freedom=found.spread.freedom,
            model_error_rows=self._model_error_rows(found.disturbances),
            log_evidence=found.log_evidence,
        )

    def _prior_notes(self) -> Iterator[str]:
        """That priors count, and which of them the data contradict."""
        for place, (name, entry) in enumerate(
            zip(self.unknown.names, self.unknown.entries, strict=True)
        ):
            prior = entry.parameter.prior
            if prior is None:
                continue
            scale = self._scale(entry)
            shown = f"{scale.shown(prior[0]):g} +- {prior[1] / scale.size:g}"
            told = f"the prior of {name}, {shown}{spaced(scale.unit)}, counts as data"
            distance = abs(self.theta[place] - prior[0]) / prior[1]
            if distance > 3:
                told += (
                    f", but the estimate is {distance:.2g} standard deviations away: "
                    "the prior is wrong, or the model incomplete"
                )
            yield told

    def _scale(self, entry: Entry) -> Scale:
        """Of the numbers of a parameter."""
        units = parameter_units(self.model, self.task.aligned.data.units)
        return scale_of(units[entry.name])

    def _bound_warning(self, name: str) -> str:
        place = self.unknown.names.index(name)
        parameter = self.unknown.entries[place].parameter
        bound = parameter.nearest_bound(self.theta[place])
        scale = self._scale(self.unknown.entries[place])
        side = "lower" if bound == parameter.lower else "upper"
        told = parameter_words(self.model, name)
        is_term = self.unknown.entries[place].slot in ("H", "F") and not bound
        sign = f"check the sign of the term with {told}. " if is_term else ""
        return (
            f"{told} is at its {side} bound {scale.shown(bound):g}"
            f"{spaced(scale.unit)}; the data favour values beyond it: {sign}The model "
            "may be incomplete, or the bound wrong. It has no standard error, and "
            "others treat it as known"
        )

    def _model_error_rows(
        self, disturbances: Disturbances
    ) -> tuple[ModelErrorRow, ...]:
        """A row per disturbance, forces first, and where white noise differs."""
        states = self.model.states
        units = self.task.data.units
        grid = self.grid
        rate = np.sqrt(np.mean(grid.rates(self.nodes) ** 2, axis=0))
        rows = []

        def add(
            kind: str, place: int, size: float, time: float, is_sensor: bool = False
        ) -> None:
            state = states[place]
            where = f"{OF_SENSOR}{state}" if is_sensor else f"d{state}/dt"
            unit = units.get(state, "")
            typical = np.nanstd(grid.y[:, place]) if is_sensor else rate[place]
            if not is_sensor:
                per = unit and f"{unit} per unit of time"
                unit = rate_unit(unit or "1", units["t"]) if units.get("t") else per
            share = size / max(float(typical), TINY)
            rows.append(ModelErrorRow(where, kind, size, time, unit, share))

        for force in disturbances.forces:
            add("force", force.place, force.size, force.time)
        for one in disturbances.functions:
            add(f"function of {states[one.state]}", one.equation, one.size, np.nan)
        for sensor in disturbances.sensors:
            add(SENSOR_ERROR, sensor.place, sensor.size, sensor.time, is_sensor=True)
        differs = np.ptp(disturbances.sigma, axis=0) > 0
        for k in np.flatnonzero(differs & grid.measured_states).tolist():
            sizes = disturbances.sigma[:, k].tolist()
            for run, size in zip(self.task.runs, sizes, strict=True):
                add(f"noise of {run}", k, size, 0.0, is_sensor=True)
        return tuple(rows)


@cache
def _release() -> str:
    try:
        return version("phsi_opt")
    except PackageNotFoundError:
        return "unknown"


# ---- pruning: solve, remove terms, solve again ---------------------------------------

E = TypeVar("E", bound=Estimate)
# A warm-started solve: (model with fewer terms, theta, L1 weights, estimate so far)
Resolve = Callable[[Model, np.ndarray, dict[str, float], E], E]


def pruned(estimate: E, resolve: Resolve[E]) -> E:
    """Warm-started re-solves until the task's pruning removes no more terms.

    First by size with the L1 term, then without it, then by significance. The tests of
    significance count the present terms and those that were removed before.

    Raises:
        ModelError: if every term, or every one of H, would go.
    """
    pruning = estimate.task.pruning
    if pruning is None:
        return estimate
    n_tests = len(pruning.candidates(estimate.model)) + len(estimate.removed)
    for _ in range(pruning.max_rounds):
        change = _next_change(estimate, pruning, n_tests)
        if change is None:
            break
        removed, l1 = change
        _check_rest(estimate.model, removed, pruning)
        model = estimate.model.without(removed)
        unknown = Theta.of(model, estimate.unknown.runs)
        values = dict(zip(estimate.unknown.names, estimate.theta, strict=True))
        theta = unknown.from_values(values, np.zeros(len(unknown)))
        again = resolve(model, theta, l1, estimate)
        all_removed = (*estimate.removed, *sorted(removed))
        estimate = replace(again, removed=all_removed, notes=estimate.notes)
    return estimate


def _next_change(
    estimate: Estimate, pruning: Pruning, n_tests: int
) -> tuple[set[str], dict[str, float]] | None:
    """Terms that the next solve leaves out, and its L1 weights; None: all is done."""
    model = estimate.model
    unknown = estimate.unknown
    # The largest of the trajectories.
    by_parameter = np.abs(estimate.theta[unknown.table])
    sizes = by_parameter.max(axis=1, initial=0.0).tolist()
    small = pruning.small(model, dict(zip(model.free, sizes, strict=True)))
    if small:
        return small, estimate.l1
    if pruning.debias and estimate.has_l1:
        return set(), {}
    if pruning.significance is None or not estimate.is_success:
        return None
    # A parameter that every trajectory has of its own has no covariance here.
    first = unknown.table[:, 0]
    is_shared = np.bincount(unknown.owner) == 1
    covariance = np.where(
        np.outer(is_shared, is_shared),
        estimate.uncertainty.covariance[np.ix_(first, first)],
        np.nan,
    )
    weak = pruning.insignificant(model, estimate.values, covariance, n_tests)
    return (weak, estimate.l1) if weak else None


def _check_rest(model: Model, removed: set[str], pruning: Pruning) -> None:
    energy = {term.parameter_name("H") for term in model.H}
    if removed and set(model.free) <= removed:
        what = "every term"
    elif removed and energy and energy <= removed:
        what = "every term of H"
    else:
        return
    raise ModelError(
        f"{pruning!r} removes {what}; lower its threshold or the L1 weight, or add "
        "terms that the data need."
    )


def _wald(
    names: list[str], model: Model, values: dict[str, float], covariance: np.ndarray
) -> float:
    """Wald's statistic xi' C^-1 xi of the coefficients all being zero."""
    places = list(map(model.free.index, names))
    xi = np.array(list(map(values.__getitem__, names)))
    block = covariance[np.ix_(places, places)]
    return float(xi @ np.linalg.solve(block, xi))
