"""The slope of the log evidence in every size and time, and steps uphill.

Slopes follow from the solution at given sizes, but for traces of an inverse, which are
estimated by random signs from a fixed seed (Hutchinson 1990). The curvature is the
average information, of which only solutions for further right-hand sides are needed
(Gilmour, Thompson and Cullis, Biometrics 51, 1995). So a step costs about two
evaluations of the evidence, however many sizes there are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csc_matrix

from phsi_opt.errors import SolveError
from phsi_opt.model_error.disturbances import (
    Coordinates,
    Disturbances,
    Process,
    Whitener,
    random_signs,
)
from phsi_opt.model_error.marginal_likelihood import (
    Eliminated,
    MarginalLikelihood,
    solve_border,
    whitener_of_force,
    whitener_of_sensor,
)
from phsi_opt.optimization.bounded_step import RIDGE
from phsi_opt.statistics import TINY

# Random vectors: as many as together look at 8000 values, within these limits.
LEAST_PROBES = 6
MOST_PROBES = 24
LEAST_INFORMATION = 0.1  # of a coordinate: a size that nothing tells moves freely
MOST_STEPS = 25
# Gain of the log evidence by a step at which an ascent ends: far below what makes a
# difference to a standard error, and about what the random signs leave open.
LEAST_GAIN = 0.03
# Gain by better sizes, of a record linearised where others led, at which these stay: it
# makes no difference to a verdict.
SETTLED_EVIDENCE = 0.1
PRIOR_STEP = 1e-4  # of the logarithm of a size or time, for slopes of priors


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes of the log evidence in logarithms, or sums of them.

    In the order: noise of each channel, size of each process, time of each process,
    size of each function.

    Attributes:
        log_evidence: where they were taken.
        gradient: (n,).
        information: (n, n) average information, a curvature.
    """

    log_evidence: float
    gradient: np.ndarray
    information: np.ndarray


def slopes(
    likelihood: MarginalLikelihood,
    disturbances: Disturbances,
    channels: tuple[int, ...],
    sums: np.ndarray | None = None,
) -> Slopes:
    """Slopes at given disturbances.

    Args:
        likelihood: of the structure of the disturbances.
        disturbances: with their sizes.
        channels: states whose noise is estimated.
        sums: (n_sums, n) of slopes that are wanted; None: each slope by itself.

    Raises:
        SolveError: the states do not follow from the data.
    """
    return _Derivatives(likelihood, disturbances, channels).slopes(sums)


@dataclass(frozen=True, eq=False)
class Climbed:
    """Where an ascent ended.

    Attributes:
        vector: (n_coordinates,).
        log_evidence: there.
        gain: of it since the origin.
        information: there, (n_coordinates, n_coordinates), how surely it ended there.
    """

    vector: np.ndarray
    log_evidence: float
    gain: float
    information: np.ndarray


def climbed(
    likelihood: MarginalLikelihood,
    coordinates: Coordinates,
    channels: tuple[int, ...],
    most_steps: int,
    worth: float = -np.inf,
    least_gain: float = LEAST_GAIN,
) -> Climbed:
    """The largest log evidence, by damped Newton steps from the coordinates' origin.

    Args:
        likelihood: of the structure of the origin.
        coordinates: with their bounds.
        channels: states whose noise is estimated.
        most_steps: uphill, at most.
        worth: log evidence below which what is found is of no use; an ascent ends where
            it promises no more.
        least_gain: of the log evidence by a step, at which they end.
    """
    lower, upper = np.array(coordinates.bounds).reshape(-1, 2).T
    sums = coordinates.among_slopes()
    vector = np.zeros(len(lower))
    # Share of the information that is added to it (Levenberg 1944, Marquardt 1963).
    damping = 0.1
    here = _slopes_at(likelihood, coordinates.at(vector), channels, sums)
    if here is None:
        return Climbed(vector, -np.inf, 0.0, np.zeros((len(vector), len(vector))))
    first = here.log_evidence
    for _ in range(most_steps):
        leads_out = (vector <= lower) & (here.gradient < 0)
        leads_out |= (vector >= upper) & (here.gradient > 0)
        # The evidence is steeper than a quadratic in logarithms of sizes that are far
        # too small or too large.
        hope = 3 * _promise(here, ~leads_out)
        if hope < least_gain or here.log_evidence + hope < worth:
            break
        step = _newton_step(here.gradient, here.information, ~leads_out, damping)
        trial = np.clip(vector + step, lower, upper)
        there = _slopes_at(likelihood, coordinates.at(trial), channels, sums)
        if there is None or there.log_evidence < here.log_evidence:
            damping *= 10
            if damping > 1e4:
                break
            continue
        gain = there.log_evidence - here.log_evidence
        vector = trial
        here = there
        damping = max(damping / 10, 1e-3)
        if gain < least_gain:
            break
    gain = here.log_evidence - first
    return Climbed(vector, here.log_evidence, gain, here.information)


def _promise(here: Slopes, moves: np.ndarray) -> float:
    """What the quadratic at a place rises by, where some coordinates may move."""
    if not moves.any():
        return 0.0
    inner = here.information[np.ix_(moves, moves)]
    curvature = inner + LEAST_INFORMATION * np.eye(len(inner))
    gradient = here.gradient[moves]
    return float(gradient @ np.linalg.solve(curvature, gradient)) / 2


def _slopes_at(
    likelihood: MarginalLikelihood,
    there: Disturbances,
    channels: tuple[int, ...],
    sums: np.ndarray,
) -> Slopes | None:
    """Slopes, or None where the states do not follow from the data."""
    try:
        found = slopes(likelihood, there, channels, sums)
    except SolveError:
        return None
    return found if np.isfinite(found.log_evidence) else None


def _newton_step(
    gradient: np.ndarray, information: np.ndarray, moves: np.ndarray, damping: float
) -> np.ndarray:
    """A step uphill, no coordinate (a logarithm) by more than two."""
    step = np.zeros(len(gradient))
    inner = information[np.ix_(moves, moves)]
    diagonal = np.maximum(np.diag(inner), LEAST_INFORMATION)
    damped = inner + np.diag(damping * diagonal + LEAST_INFORMATION)
    step[moves] = np.linalg.solve(damped, gradient[moves])
    longest = np.max(np.abs(step))
    return step * min(1.0, 2.0 / max(longest, TINY))


@dataclass(frozen=True, eq=False)
class _Prior:
    """A process, its values, and how its prior changes with its time.

    Attributes:
        process: with its size.
        whitener: of its values at size one.
        later: the same for a time that is a little longer.
        places: of the values among all unknowns.
    """

    process: Process
    whitener: Whitener
    later: Whitener
    places: slice

    @property
    def n(self) -> int:
        """Number of its values."""
        return len(self.whitener.diagonal)

    @cached_property
    def _changes(self) -> tuple[np.ndarray, np.ndarray]:
        """Slopes of the two diagonals of the inverse covariance, likewise."""
        scale = self.process.size**2 * PRIOR_STEP
        now, later = self.whitener, self.later
        diagonal = (later.precision_diagonal - now.precision_diagonal) / scale
        return diagonal, (later.precision_below - now.precision_below) / scale

    def changed(self, values: np.ndarray) -> np.ndarray:
        """Slope of the inverse covariance times values (n, ...)."""
        diagonal, below = self._changes
        result = (diagonal * values.T).T
        result[1:] += (below * values[:-1].T).T
        result[:-1] += (below * values[1:].T).T
        return result


class _Derivatives:
    """What the slopes at given disturbances are worked out from."""

    def __init__(
        self,
        likelihood: MarginalLikelihood,
        disturbances: Disturbances,
        channels: tuple[int, ...],
    ) -> None:
        self.likelihood = likelihood
        self.channels = channels
        self.problem = likelihood.problem
        self.parts: Eliminated = likelihood.eliminated(disturbances)
        self.sizes = disturbances.function_sizes
        border = likelihood.border_of(self.parts)
        self.information = border.with_priors(self.sizes)
        marginal = border.marginal(self.sizes)
        self.log_evidence = marginal.log_evidence
        self.step = marginal.border
        solved = self.parts.solved
        self.unknowns = solved[:, -1] - solved[:, :-1] @ self.step
        shown = likelihood.shown @ self.unknowns[: likelihood.n_unknowns]
        in_border = likelihood.border_in_shown @ self.step
        self.residual = self.problem.residual - shown - in_border
        # Places of each function's coefficients in the border.
        self.coefficients = []
        for number in range(len(self.sizes)):
            own = np.flatnonzero(border.owner == number)
            self.coefficients.append(border.n_theta + own)
        self.priors = self._priors(disturbances)

    def _priors(self, disturbances: Disturbances) -> list[_Prior]:
        factor = float(np.exp(PRIOR_STEP))

        def later(processes: tuple[Process, ...]) -> tuple[Process, ...]:
            return tuple(replace(one, time=one.time * factor) for one in processes)

        moved = replace(
            disturbances,
            forces=later(disturbances.forces),
            sensors=later(disturbances.sensors),
        )
        priors = []
        for process, now, then, (first, n) in zip(
            disturbances.processes,
            self.parts.whiteners,
            self.likelihood.whiteners(moved),
            self.likelihood.places_of_processes(),
            strict=True,
        ):
            priors.append(_Prior(process, now, then, slice(first, first + n)))
        return priors

    def slopes(self, sums: np.ndarray | None = None) -> Slopes:
        """Gradient and average information."""
        n_slopes = len(self.channels) + 2 * len(self.priors) + len(self.sizes)
        changes, data = self._changes(np.eye(n_slopes) if sums is None else sums)
        n_values = self.problem.n_values
        n_probes = int(np.clip(8_000 // n_values, LEAST_PROBES, MOST_PROBES))
        lengths = (n_values, *(prior.n for prior in self.priors))
        signs = random_signs(lengths, n_probes)
        probes = self._probes(signs)
        inner = np.hstack([changes[0], probes[0]])
        border = np.hstack([changes[1], probes[1]])
        k = data.shape[1]
        alone = self.parts.factors.solve(inner)
        open_border = border - self.parts.right[:, :-1].T @ alone
        of_border = solve_border(self.information, open_border)
        # Half the change of the data, over the covariance that is left of them.
        squares = data.T @ (self.parts.weights[:, None] * data)
        explained = changes[0].T @ alone[:, :k]
        explained = explained + open_border[:, :k].T @ of_border[:, :k]
        information = (squares - explained) / 2
        answer = alone[:, k:] - self.parts.solved[:, :-1] @ of_border[:, k:]
        of_values = answer[:, :n_probes], of_border[:, k : k + n_probes]
        gradient = np.concatenate(
            [
                self._in_noise(signs[0], *of_values),
                *self._in_processes(signs[1:], answer[:, n_probes:]),
                self._in_functions(),
            ]
        )
        if sums is not None:
            gradient = sums @ gradient
        return Slopes(self.log_evidence, gradient, (information + information.T) / 2)

    def _right(
        self, values: np.ndarray, dynamics: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Right-hand sides in the unknowns, dynamics and border, of weighted values.

        Args:
            values: (n_values, k).
            dynamics: (n_intervals * n_states, k).
        """
        likelihood = self.likelihood
        n = likelihood.n_unknowns
        inner = np.empty((len(self.parts.right), values.shape[1]), order="F")
        inner[:n] = likelihood.shown_transposed @ values
        inner[n:] = dynamics
        return inner, likelihood.border_in_shown.T @ values

    def _changes(
        self, sums: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """How the data would move with sums of sizes and times, (n_values, k).

        As right-hand sides, and as they are. What a force adds to the states, the data
        would show; so it is taken from the dynamics where it is added to the data.

        Args:
            sums: (k, n_slopes).
        """
        likelihood = self.likelihood
        n_channels = len(self.channels)
        n_functions = len(self.sizes)
        of_processes = slice(n_channels, sums.shape[1] - n_functions)
        is_in = self.problem.channel[:, None] == np.array(self.channels, dtype=int)
        of_noise = np.where(is_in, 2 * self.residual[:, None], 0.0)
        shifts = of_noise @ sums[:, :n_channels].T
        n_dynamics = len(self.parts.right) - likelihood.n_unknowns
        offsets = np.zeros((n_dynamics, len(sums)))
        if self.priors:
            moved = self._moved_processes() @ sums[:, of_processes].T
            shifts += likelihood.values_of_processes(moved)
            offsets -= likelihood.dynamics_of_processes(moved)
        if n_functions:
            coefficients = np.zeros((len(self.step), n_functions))
            for number, places in enumerate(self.coefficients):
                coefficients[places, number] = 2 * self.step[places]
            step = coefficients @ sums[:, of_processes.stop :].T
            offsets += likelihood.border_in_dynamics @ step
        return self._right(self.parts.weights[:, None] * shifts, offsets), shifts

    def _moved_processes(self) -> np.ndarray:
        """Values of all processes, as each size and then each time would move them.

        (n_unknowns, 2 n_processes).
        """
        n_processes = len(self.priors)
        moved = np.zeros((self.likelihood.n_unknowns, 2 * n_processes))
        for number, prior in enumerate(self.priors):
            values = self.unknowns[prior.places]
            # The covariance of the values times how its inverse changes.
            normals = prior.whitener.factor_of(prior.changed(values))
            by_time = prior.whitener.coloured(normals)
            moved[prior.places, number] = 2 * values
            by_time = by_time * prior.process.size**2
            moved[prior.places, n_processes + number] = -by_time
        return moved

    def _probes(self, signs: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Random signs: first of the measured values, then of the processes."""
        n_probes = signs[0].shape[1]
        weighted = np.sqrt(self.parts.weights)[:, None] * signs[0]
        both = np.hstack([weighted, np.zeros_like(weighted)])
        inner, border = self._right(both, 0.0)
        for prior, own in zip(self.priors, signs[1:], strict=True):
            transposed = prior.whitener.transposed(own) / prior.process.size
            inner[prior.places, n_probes:] = transposed
        return inner, border

    def _in_noise(
        self, signs: np.ndarray, answer: np.ndarray, of_border: np.ndarray
    ) -> np.ndarray:
        """From squared residuals in units of the noise, and leverages."""
        likelihood = self.likelihood
        root = np.sqrt(self.parts.weights)
        shown = likelihood.shown @ answer[: likelihood.n_unknowns]
        shown = root[:, None] * (shown + likelihood.border_in_shown @ of_border)
        leverage = np.mean(signs * shown, axis=1)
        left = (root * self.residual) ** 2 - 1 + leverage
        return np.array([left[self.problem.channel == c].sum() for c in self.channels])

    def _in_processes(
        self, signs: tuple[np.ndarray, ...], answer: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """From squared innovations, and how many of them the data leave to priors."""
        by_size = []
        by_time = []
        for prior, own in zip(self.priors, signs, strict=True):
            whitener, size = prior.whitener, prior.process.size
            values, found = self.unknowns[prior.places], answer[prior.places]
            squares = float(np.sum((whitener.whitened(values) / size) ** 2))
            left = np.mean(np.sum(own * (whitener.whitened(found) / size), axis=0))
            by_size.append(squares - prior.n + float(left))
            change = float(values @ prior.changed(values))
            coloured = prior.changed(whitener.coloured(own) * size)
            trace = float(np.mean(np.sum(found * coloured, axis=0)))
            d_log_det = (prior.later.log_det - whitener.log_det) / PRIOR_STEP
            by_time.append(d_log_det - (change + trace) / 2)
        return np.array(by_size), np.array(by_time)

    def _in_functions(self) -> np.ndarray:
        covariance = solve_border(self.information, np.eye(len(self.information)))
        variance = np.diag(covariance)
        slopes = []
        for places, size in zip(self.coefficients, self.sizes, strict=True):
            squares = np.sum(self.step[places] ** 2) + np.sum(variance[places])
            slopes.append(squares / size**2 - len(places))
        return np.array(slopes)


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
