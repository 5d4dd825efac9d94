"""What the log evidence would gain by processes that are not there yet.

At white noise alone, the evidence has a slope and a curvature in the variance of every
process that could act beside the model. One factorisation, without any process in it,
gives them for many processes at once, and the Newton step that they promise says
whether a search is worth its time. (A score test of variance components: Lin,
Biometrika 84, 1997; the curvature is the average information of `ascent`, and traces
are those of random signs.)

Changes of the data and of the dynamics stand below each other here: (n_values +
n_intervals * n_states, k). What a force adds to the states, the data would show; so it
is taken from the dynamics where a sensor's error is added to the data.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csc_matrix

from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    solve_border,
    whitener_of_force,
    whitener_of_sensor,
)
from phsi_opt.model_error.processes import Process, Whitener, random_signs
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import RIDGE

# Random vectors for every group of processes: a slope is then known to about a third of
# its standard deviation.
N_SIGNS = 8


@dataclass(frozen=True)
class PromisedGain:
    """What the first step of a search promises, of the log evidence.

    Attributes:
        forces: by forces.
        sensors: by processes of sensors.
    """

    forces: float = 0.0
    sensors: float = 0.0


@dataclass(frozen=True)
class Trial:
    """Processes that could act together, each at its time.

    Attributes:
        forces: that could act.
        sensors: processes that could add to what is shown.
        is_tied: whether those of one kind share a factor, as in a search; otherwise
            sizes do not matter.
    """

    forces: Sequence[Process]
    sensors: Sequence[Process]
    is_tied: bool = False


@dataclass(frozen=True, eq=False)
class _Component:
    """A process that could act beside the model.

    Attributes:
        effects: what its values do to data and dynamics, sparse, of its own size.
        whitener: of its values at size one.
        felt: (n, 1) what it would take to bring down what is left of the data.
    """

    effects: csc_matrix
    whitener: Whitener
    felt: np.ndarray

    @cached_property
    def factor(self) -> np.ndarray:
        """F'F is the variance that the prior gives what is felt, (n, 1)."""
        return self.whitener.factor_of(self.felt)


M = TypeVar("M")
_Kind = list[_Component]  # whose variances share a factor: of small systems one alone


class Asked:
    """The processes of a trial, and what a record says of them.

    Args:
        kinds: those of forces first.
        n_forces: number of kinds of forces.

    Attributes:
        information: (n, n) about the variances.
        excess: (n,) slopes of the log evidence in the variances times their sizes.
    """

    def __init__(self, kinds: list[_Kind], n_forces: int) -> None:
        self.kinds = kinds
        self.n_forces = n_forces
        self.information = np.zeros((0, 0))
        self.excess = np.zeros(0)

    @property
    def size(self) -> np.ndarray:
        """Root of the information about each variance, (n,)."""
        return np.sqrt(np.maximum(np.diag(self.information), TINY))

    @property
    def seen(self) -> np.ndarray:
        """What each kind feels, squared, as far as it could bring it down, (n,)."""
        seen = np.zeros(len(self.kinds))
        for number, kind in enumerate(self.kinds):
            for one in kind:
                seen[number] += np.sum(one.factor**2)
        return seen

    @property
    def gain(self) -> PromisedGain:
        """What the first step of a search promises."""
        size = self.size
        with np.errstate(over="ignore"):  # a component that leaves no trace
            correlation = self.information / np.outer(size, size)
        information = np.clip(correlation, -1.0, 1.0)
        of_forces = slice(0, self.n_forces)
        of_sensors = slice(self.n_forces, len(size))
        return PromisedGain(
            _gain(self.excess[of_forces], information[of_forces, of_forces]),
            _gain(self.excess[of_sensors], information[of_sensors, of_sensors]),
        )


class WhiteRecord:
    """A linearised record under white noise alone, ready to be asked.

    Args:
        likelihood: of a structure without processes; functions of states may be in it.
        white: the noise, and functions of any size.

    Attributes:
        border: what is left for parameters and functions.
        left: what states and parameters leave of the data, without any function.

    Raises:
        SolveError: the states do not follow from the data.
    """

    def __init__(self, likelihood: MarginalLikelihood, white: Disturbances) -> None:
        self.problem = problem = likelihood.problem
        self._likelihood = likelihood
        self._parts = likelihood.eliminated(white)
        self.border = likelihood.border_of(self._parts)
        n_theta = self.border.n_theta
        self._in_shown = likelihood.border_in_shown[:, :n_theta]
        self._right = self._parts.right[:, :n_theta]
        self._solved = self._parts.solved[:, :n_theta]
        ridge = RIDGE * np.eye(n_theta)
        self._information = self.border.information[:n_theta, :n_theta] + ridge
        self._n_rows = problem.n_values + len(problem.offset)
        data = np.concatenate([problem.residual, -problem.offset])[:, None]
        self.left = self._answered(data, self._parts.solved[:, -1:].copy())
        self._made: dict[tuple[bool, int], tuple[csc_matrix, np.ndarray]] = {}

    def _left(self, shifts: np.ndarray) -> np.ndarray:
        """What states and parameters leave of shifts, weighted by the noise.

        Of the values, and as multipliers of the dynamics, less than zero.
        """
        likelihood = self._likelihood
        n = likelihood.n_unknowns
        n_values = self.problem.n_values
        inner = np.empty((len(self._right), shifts.shape[1]), order="F")
        weighted = self._parts.weights[:, None] * shifts[:n_values]
        inner[:n] = likelihood.shown_transposed @ weighted
        inner[n:] = shifts[n_values:]
        return self._answered(shifts, self._parts.factors.solve(inner))

    def _answered(self, shifts: np.ndarray, answer: np.ndarray) -> np.ndarray:
        """The same, once the states have answered; their answer is written over."""
        n = self._likelihood.n_unknowns
        values = shifts[: self.problem.n_values]
        weights = self._parts.weights[:, None]
        # The matrix is symmetric: what was solved for the parameters serves again.
        in_theta = self._in_shown.T @ (weights * values) - self._right.T @ answer
        theta = solve_border(self._information, in_theta)
        answer -= self._solved @ theta
        shown = self._likelihood.shown @ answer[:n] + self._in_shown @ theta
        return np.concatenate([weights * (values - shown), -answer[n:]])

    def promised_gains(
        self, trials: Sequence[Trial], channels: Sequence[int]
    ) -> list[PromisedGain]:
        """Gains of the log evidence by the processes of each trial.

        What few columns need is solved for together; the random signals of each trial
        by themselves: fresh memory costs more than a further call.

        Args:
            trials: processes that could act.
            channels: states whose noise is estimated, and would follow.
        """
        every = [self.asked(trial) for trial in trials]
        together = [asked for asked in every if asked.kinds]
        if together:
            are_tied = any(trial.is_tied for trial in trials)
            self._set_information(together, _kinds(list(channels), are_tied))
            for asked in together:
                self.set_excess(asked)
        return [asked.gain for asked in every]

    def asked(self, trial: Trial) -> Asked:
        """A trial, nothing worked out about it."""
        forces = [self._component(one, is_force=True) for one in trial.forces]
        sensors = [self._component(one, is_force=False) for one in trial.sensors]
        of_forces = _kinds(forces, trial.is_tied)
        return Asked(of_forces + _kinds(sensors, trial.is_tied), len(of_forces))

    def _component(self, process: Process, *, is_force: bool) -> _Component:
        """A process; what its place does is made once for all trials."""
        key = (is_force, process.place)
        if key not in self._made:
            effects = self._effects(*key)
            self._made[key] = (effects, effects.T @ self.left)
        effects, felt = self._made[key]
        whitener_of = whitener_of_force if is_force else whitener_of_sensor
        whitener = whitener_of(self.problem, process)
        return _Component(process.size * effects, whitener, process.size * felt)

    def _effects(self, is_force: bool, place: int) -> csc_matrix:
        """What values of a force, or of a sensor's error, do to data and dynamics."""
        problem = self.problem
        if is_force:
            own = problem.dynamics_of_force(place).tocoo()
            entries = (-own.data, (problem.n_values + own.row, own.col))
            return csc_matrix(entries, shape=(self._n_rows, own.shape[1]))
        row = problem.values_of(place)
        ones = (np.ones(len(row)), (row, np.arange(len(row))))
        return csc_matrix(ones, shape=(self._n_rows, len(row)))

    def _set_information(
        self, together: Sequence[Asked], groups: Sequence[Sequence[int]]
    ) -> None:
        """Average information about variances, while noises follow them."""
        columns = []
        n_values = self.problem.n_values
        residual = self.left[:n_values, 0] / self._parts.weights
        for channels in groups:
            # How the data would move with the logarithm of the noise.
            column = np.zeros(self._n_rows)
            is_in = np.isin(self.problem.channel, channels)
            column[:n_values] = np.where(is_in, 2 * residual, 0.0)
            columns.append(column)
        for asked in together:
            for kind in asked.kinds:
                # What they do to the data where they follow what they feel.
                followed = [e.effects @ e.whitener.coloured(e.factor) for e in kind]
                columns.append(np.sum(followed, axis=0)[:, 0])
        shifts = np.array(columns).T
        products = shifts.T @ self._left(shifts)
        products = (products + products.T) / 4
        n = len(groups)
        of_noise = np.linalg.pinv(products[:n, :n], hermitian=True)
        for asked in together:
            own = slice(n, n + len(asked.kinds))
            mixed = products[own, : len(groups)]
            asked.information = products[own, own] - mixed @ of_noise @ mixed.T
            n = own.stop

    def set_excess(self, asked: Asked) -> None:
        """Slopes of the log evidence in the variances times their sizes."""
        components = []
        for kind, scale in zip(asked.kinds, asked.size, strict=True):
            components += [(one, np.sqrt(scale)) for one in kind]
        lengths = tuple(len(one.felt) for one, _ in components)
        signs = random_signs(lengths, N_SIGNS)
        shifts = np.zeros((self._n_rows, N_SIGNS), order="F")
        signals = []
        for (one, scale), own in zip(components, signs, strict=True):
            signals.append(one.whitener.coloured(own) / scale)
            shifts += one.effects @ signals[-1]
        left = self._left(shifts)
        products = []
        for (one, _), signal in zip(components, signals, strict=True):
            products.append(float(np.sum(signal * (one.effects.T @ left))))
        ends = np.cumsum([0, *(len(kind) for kind in asked.kinds)])
        by_chance = np.add.reduceat(products, ends[:-1]) / N_SIGNS
        slopes = (asked.seen / asked.size - by_chance) / 2
        # That of a channel whose residuals are zero is beyond numbers.
        asked.excess = np.maximum(slopes, -1e6)


def _kinds(members: list[M], is_tied: bool) -> list[list[M]]:
    """Members that share a factor together, else each by itself."""
    if is_tied:
        return [members] if members else []
    return [[member] for member in members]


def _gain(slopes: np.ndarray, information: np.ndarray) -> float:
    """The most that a quadratic rises by variances that are not negative.

    Args:
        slopes: (n,) at zero.
        information: (n, n), of diagonal one.
    """
    if not np.any(slopes > 0):
        return 0.0
    regular = information + 1e-9 * np.eye(len(slopes))  # where there is none
    found = np.linalg.solve(regular, slopes)
    if np.any(found < 0):
        lower = np.linalg.cholesky(regular)
        found, _ = nnls(lower.T, np.linalg.solve(lower, slopes))
    return float(slopes @ found - found @ information @ found / 2)
