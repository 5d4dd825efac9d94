"""The slope of the log evidence in every size and time, and steps uphill.

Slopes follow from the solution at given sizes, but for traces of an inverse, which are
estimated by random signs from a fixed seed (Hutchinson 1990). The curvature is the
average information, of which only solutions for further right-hand sides are needed
(Gilmour, Thompson and Cullis, Biometrics 51, 1995). So a step costs about two
evaluations of the evidence, however many sizes there are.
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.model_error.coordinates import Coordinates
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.marginal_likelihood import (
    Eliminated,
    MarginalLikelihood,
    solve_border,
)
from phsi_opt.model_error.processes import Process, Whitener
from phsi_opt.model_error.signs import random_signs
from phsi_opt.statistics import TINY

PROBED_VALUES = 8_000  # values that all random vectors together look at, at least
LEAST_PROBES = 6
MOST_PROBES = 24
# Share of the information that is added to it (Levenberg 1944, Marquardt 1963), and the
# factor on it after a step that led down.
FIRST_DAMPING = 0.1
LEAST_DAMPING = 1e-3
MOST_DAMPING = 1e4
MORE_DAMPING = 10.0
LEAST_INFORMATION = 0.1  # of a coordinate: a size that nothing tells moves freely
LONGEST_STEP = 2.0  # of a logarithm
MOST_STEPS = 25
# Gain of the log evidence by a step at which an ascent ends: far below what makes a
# difference to a standard error, and about what the random signs leave open.
LEAST_GAIN = 0.03
# An ascent may gain so many times what the quadratic at a place promises: the evidence
# is steeper in logarithms of sizes that are far too small or too large.
HOPE = 3.0
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
        information: there, (n_coordinates, n_coordinates), how surely it ended there.
    """

    vector: np.ndarray
    log_evidence: float
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
    damping = FIRST_DAMPING
    try:
        here = slopes(likelihood, coordinates.at(vector), channels, sums)
    except SolveError:
        return Climbed(vector, -np.inf, np.zeros((len(vector), len(vector))))
    for _ in range(most_steps):
        leads_out = (vector <= lower) & (here.gradient < 0)
        leads_out |= (vector >= upper) & (here.gradient > 0)
        hope = HOPE * _promise(here, ~leads_out)
        if hope < least_gain or here.log_evidence + hope < worth:
            break
        step = _newton_step(here.gradient, here.information, ~leads_out, damping)
        trial = np.clip(vector + step, lower, upper)
        there = _slopes_at(likelihood, coordinates.at(trial), channels, sums)
        if there is None or there.log_evidence < here.log_evidence:
            damping *= MORE_DAMPING
            if damping > MOST_DAMPING:
                break
            continue
        gain = there.log_evidence - here.log_evidence
        vector = trial
        here = there
        damping = max(damping / MORE_DAMPING, LEAST_DAMPING)
        if gain < least_gain:
            break
    return Climbed(vector, here.log_evidence, here.information)


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
    """A step uphill, no coordinate by more than `LONGEST_STEP`."""
    step = np.zeros(len(gradient))
    if not moves.any():
        return step
    inner = information[np.ix_(moves, moves)]
    diagonal = np.maximum(np.diag(inner), LEAST_INFORMATION)
    damped = inner + np.diag(damping * diagonal + LEAST_INFORMATION)
    step[moves] = np.linalg.solve(damped, gradient[moves])
    longest = np.max(np.abs(step))
    return step * min(1.0, LONGEST_STEP / max(longest, TINY))


@dataclass(frozen=True, eq=False)
class _Prior:
    """A process, its values, and how its prior changes with its time.

    The inverse covariance of the values has two diagonals; ``d_diagonal`` and
    ``d_below`` are their slopes in the logarithm of the time.
    """

    process: Process
    whitener: Whitener
    places: slice
    d_diagonal: np.ndarray
    d_below: np.ndarray
    d_log_det: float

    @classmethod
    def of(
        cls, process: Process, whitener: Whitener, later: Whitener, places: slice
    ) -> "_Prior":
        step = PRIOR_STEP
        diagonal = later.precision_diagonal - whitener.precision_diagonal
        below = later.precision_below - whitener.precision_below
        scale = process.size**2 * step
        d_log_det = (later.log_det - whitener.log_det) / step
        return cls(
            process, whitener, places, diagonal / scale, below / scale, d_log_det
        )

    @property
    def n(self) -> int:
        return len(self.whitener.diagonal)

    def changed(self, values: np.ndarray) -> np.ndarray:
        """Slope of the inverse covariance times values (n, ...)."""
        result = (self.d_diagonal * values.T).T
        result[1:] += (self.d_below * values[:-1].T).T
        result[:-1] += (self.d_below * values[1:].T).T
        return result

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Standard normals of values (n, ...)."""
        return self.whitener.whitened(values) / self.process.size

    def transposed(self, normals: np.ndarray) -> np.ndarray:
        """The transposed whitener times (n, ...)."""
        return self.whitener.transposed(normals) / self.process.size

    def coloured(self, normals: np.ndarray) -> np.ndarray:
        """Values with this prior from standard normals (n, ...)."""
        return self.whitener.coloured(normals) * self.process.size

    def covariance_times(self, values: np.ndarray) -> np.ndarray:
        """The covariance times values (n,)."""
        covered = self.whitener.covariance_times(values[:, None])[:, 0]
        return covered * self.process.size**2


@dataclass(frozen=True, eq=False)
class _Columns:
    """Right-hand sides: in the unknowns and dynamics, in the border, and in the data.

    Attributes:
        inner: (n_inner, k).
        border: (n_border, k).
        data: (n_values, k), the part of it that is a change of the data.
    """

    inner: np.ndarray
    border: np.ndarray
    data: np.ndarray


class _Derivatives:
    def __init__(
        self,
        likelihood: MarginalLikelihood,
        disturbances: Disturbances,
        channels: tuple[int, ...],
    ) -> None:
        self.likelihood = likelihood
        self.disturbances = disturbances
        self.channels = channels
        self.problem = likelihood.problem
        self.parts: Eliminated = likelihood.eliminated(disturbances)
        self.sizes = np.array([f.size for f in disturbances.functions])
        border = likelihood.border_of(self.parts)
        self.information = border.with_priors(self.sizes)
        marginal = border.marginal(self.sizes)
        self.log_evidence = marginal.log_evidence
        self.step = marginal.border
        self.n_theta = border.n_theta
        self.owner = border.owner
        solved = self.parts.solved
        self.unknowns = solved[:, -1] - solved[:, :-1] @ self.step
        n = likelihood.n_unknowns
        shown = likelihood.shown @ self.unknowns[:n]
        self.residual = (
            self.problem.residual - shown - likelihood.border_in_shown @ self.step
        )
        self.priors = self._priors()

    def _priors(self) -> list[_Prior]:
        forces = self.disturbances.forces
        processes = self.disturbances.processes
        later = []
        for process in processes:
            time = process.time * float(np.exp(PRIOR_STEP))
            later.append(Process(process.place, process.size, time))
        n = len(forces)
        moved = Disturbances(
            self.disturbances.sigma, tuple(later[:n]), tuple(later[n:])
        )
        now = self.parts.whiteners
        then = self.likelihood.whiteners(moved)
        priors = []
        places = self.likelihood.places_of_processes()
        for number, process in enumerate(processes):
            first, length = places[number]
            where = slice(first, first + length)
            priors.append(_Prior.of(process, now[number], then[number], where))
        return priors

    def slopes(self, sums: np.ndarray | None = None) -> Slopes:
        """Gradient and average information."""
        n_slopes = len(self.channels) + 2 * len(self.priors) + len(self.sizes)
        changes = self._changes(np.eye(n_slopes) if sums is None else sums)
        probes = self._probes()
        inner = np.hstack([changes.inner, probes.inner])
        border = np.hstack([changes.border, probes.border])
        k = changes.inner.shape[1]
        alone = self.parts.factors.solve(inner)
        open_border = border - self.parts.right[:, :-1].T @ alone
        of_border = solve_border(self.information, open_border)
        information = self._information(
            changes, alone[:, :k], open_border[:, :k], of_border[:, :k]
        )
        answer = alone[:, k:] - self.parts.solved[:, :-1] @ of_border[:, k:]
        gradient = self._gradient(answer, of_border[:, k:])
        if sums is not None:
            gradient = sums @ gradient
        return Slopes(self.log_evidence, gradient, information)

    def _changes(self, sums: np.ndarray) -> _Columns:
        """How the data would move with sums of sizes and times, as right-hand sides.

        What a force adds to the states, the data would show; so it is taken from the
        dynamics where it is added to the data.

        Args:
            sums: (k, n_slopes).
        """
        likelihood = self.likelihood
        n_inner = len(self.parts.right)
        n = likelihood.n_unknowns
        weights = self.parts.weights
        n_channels = len(self.channels)
        n_functions = len(self.sizes)
        of_processes = slice(n_channels, sums.shape[1] - n_functions)
        is_in = self.problem.channel[:, None] == np.array(self.channels, dtype=int)
        of_noise = np.where(is_in, 2 * self.residual[:, None], 0.0)
        shifts = of_noise @ sums[:, :n_channels].T
        offsets = np.zeros((n_inner - n, len(sums)))
        if self.priors:
            moved = self._moved_processes() @ sums[:, of_processes].T
            shifts += likelihood.values_of_processes(moved)
            offsets -= likelihood.dynamics_of_processes(moved)
        if n_functions:
            step = self._moved_functions() @ sums[:, of_processes.stop :].T
            offsets += likelihood.border_in_dynamics @ step
        weighted = weights[:, None] * shifts
        inner = np.empty((n_inner, len(sums)), order="F")
        inner[:n] = likelihood.shown_transposed @ weighted
        inner[n:] = offsets
        return _Columns(
            inner=inner,
            border=likelihood.border_in_shown.T @ weighted,
            data=shifts,
        )

    def _moved_processes(self) -> np.ndarray:
        """Values of all processes, as each size and then each time would move them.

        (n_unknowns, 2 n_processes).
        """
        n_processes = len(self.priors)
        moved = np.zeros((self.likelihood.n_unknowns, 2 * n_processes))
        for number, prior in enumerate(self.priors):
            values = self.unknowns[prior.places]
            by_time = prior.covariance_times(prior.changed(values))
            moved[prior.places, number] = 2 * values
            moved[prior.places, n_processes + number] = -by_time
        return moved

    def _moved_functions(self) -> np.ndarray:
        """Coefficients as each size would move them, (n_border, n_functions)."""
        moved = np.zeros((len(self.step), len(self.sizes)))
        for number in range(len(self.sizes)):
            places = self.n_theta + np.flatnonzero(self.owner == number)
            moved[places, number] = 2 * self.step[places]
        return moved

    def _probes(self) -> _Columns:
        """Random signs: first of the measured values, then of the processes."""
        likelihood = self.likelihood
        n_values = self.problem.n_values
        n_probes = int(np.clip(PROBED_VALUES // n_values, LEAST_PROBES, MOST_PROBES))
        self.n_probes = n_probes
        lengths = (n_values, *(prior.n for prior in self.priors))
        self.value_signs, *self.process_signs = random_signs(lengths, n_probes)
        inner = np.zeros((len(self.parts.right), 2 * n_probes), order="F")
        border = np.zeros((len(self.step), 2 * n_probes))
        weighted = np.sqrt(self.parts.weights)[:, None] * self.value_signs
        n = likelihood.n_unknowns
        inner[:n, :n_probes] = likelihood.shown_transposed @ weighted
        border[:, :n_probes] = likelihood.border_in_shown.T @ weighted
        for prior, signs in zip(self.priors, self.process_signs, strict=True):
            inner[prior.places, n_probes:] = prior.transposed(signs)
        return _Columns(inner, border, np.zeros((0, 0)))

    def _information(
        self,
        changes: _Columns,
        alone: np.ndarray,
        open_border: np.ndarray,
        of_border: np.ndarray,
    ) -> np.ndarray:
        """Half the change of the data, over the covariance that is left of them."""
        squares = changes.data.T @ (self.parts.weights[:, None] * changes.data)
        explained = changes.inner.T @ alone + open_border.T @ of_border
        information: np.ndarray = (squares - explained) / 2
        return (information + information.T) / 2

    def _gradient(self, answer: np.ndarray, of_border: np.ndarray) -> np.ndarray:
        n_probes = self.n_probes
        return np.concatenate(
            [
                self._in_noise(answer[:, :n_probes], of_border[:, :n_probes]),
                *self._in_processes(answer[:, n_probes:]),
                self._in_functions(),
            ]
        )

    def _in_noise(self, answer: np.ndarray, of_border: np.ndarray) -> np.ndarray:
        squares, leverage = self._of_values(answer, of_border)
        left = squares - 1 + leverage
        return np.array([left[self.problem.channel == c].sum() for c in self.channels])

    def _of_values(
        self, answer: np.ndarray, of_border: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Squared residuals in units of the noise, and leverages, (n_values,) each."""
        likelihood = self.likelihood
        root = np.sqrt(self.parts.weights)
        shown = likelihood.shown @ answer[: likelihood.n_unknowns]
        shown = root[:, None] * (shown + likelihood.border_in_shown @ of_border)
        leverage = np.mean(self.value_signs * shown, axis=1)
        return (root * self.residual) ** 2, leverage

    def _of_process(
        self, prior: _Prior, signs: np.ndarray, answer: np.ndarray
    ) -> tuple[float, float]:
        """Squared innovations, and how many of them the data leave to the prior."""
        squares = float(np.sum(prior.whitened(self.unknowns[prior.places]) ** 2))
        found = prior.whitened(answer[prior.places])
        return squares, float(np.mean(np.sum(signs * found, axis=0)))

    def _in_processes(self, answer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        by_size = []
        by_time = []
        for prior, signs in zip(self.priors, self.process_signs, strict=True):
            squares, left = self._of_process(prior, signs, answer)
            by_size.append(squares - prior.n + left)
            values = self.unknowns[prior.places]
            change = float(values @ prior.changed(values))
            changed = prior.changed(prior.coloured(signs))
            found = answer[prior.places]
            trace = float(np.mean(np.sum(found * changed, axis=0)))
            by_time.append(prior.d_log_det - (change + trace) / 2)
        return np.array(by_size), np.array(by_time)

    def _in_functions(self) -> np.ndarray:
        covariance = solve_border(self.information, np.eye(len(self.information)))
        slopes = []
        for number, size in enumerate(self.sizes):
            places = self.n_theta + np.flatnonzero(self.owner == number)
            squares = np.sum(self.step[places] ** 2)
            trace = np.sum(np.diag(covariance)[places])
            slopes.append((squares + trace) / size**2 - len(places))
        return np.array(slopes)
