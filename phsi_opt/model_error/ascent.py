"""Slopes of the log evidence in the sizes and times of disturbances, and steps uphill.

With V the covariance of the data, V_i its slope in a size or time, y the data and P the
inverse of V with unknown parameters and starting states projected out::

    slope         y'P V_i P y / 2 - trace(P V_i) / 2
    information   y'P V_i P V_j P y / 2

the latter on average (Gilmour, Thompson and Cullis, Biometrics 51, 1995); traces are
estimated by random signs from a fixed seed (Hutchinson 1990). Solutions for a few
further right-hand sides are all that is needed, however many sizes there are: a step
uphill costs about two evaluations of the evidence.

For processes that are not there yet, the slopes at size zero and the Newton step that
they promise say whether a search is worth its time (a score test of variance
components: Lin, Biometrika 84, 1997).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from phsi_opt.errors import SolveError
from phsi_opt.model_error.disturbances import (
    Coordinates,
    Disturbances,
    Process,
    Whitener,
    random_signs,
)
from phsi_opt.model_error.linearization import Site
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    OptimalitySystem,
)
from phsi_opt.statistics import TINY

PROBES = (6, 24)  # random vectors for traces, at least and at most
LEAST_INFORMATION = 0.1  # of a coordinate: a size without information moves freely
# Gain by better sizes, of a record linearised where others led, at which these stay: it
# makes no difference to a verdict.
SETTLED_EVIDENCE = 0.1


# --- Slopes


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes of the log evidence in logarithms, or sums of them.

    In the order: noise of each channel, size of each process, time of each process,
    size of each function.
    """

    log_evidence: float  # where they were taken
    gradient: np.ndarray  # (n,)
    information: np.ndarray  # (n, n) average information, a curvature


@dataclass(frozen=True, eq=False)
class Component:
    """A process as a component of the variance of data and dynamics."""

    process: Process  # with its size and time
    site: Site  # where it acts
    whitener: Whitener  # of its values at size one
    # F with F'F what its prior of size one makes of the projected data.
    normals: np.ndarray
    log_step: float = 1e-4  # of the time, for slopes of the prior

    @classmethod
    def of(
        cls, process: Process, site: Site, projected_data: np.ndarray
    ) -> "Component":
        whitener = site.whitener(process.time)
        normals = whitener.factor_of(site.effects.T @ projected_data[:, None])
        return cls(process, site, whitener, normals)

    @property
    def squares(self) -> float:
        """y'P V P y with V the variance by the process."""
        return float(self.process.size**2 * np.sum(self.normals**2))

    @cached_property
    def mean(self) -> np.ndarray:
        """Its most likely values, (n,); of a small size, if it is not there yet."""
        return self.process.size**2 * self.whitener.coloured(self.normals)[:, 0]

    def signal(self, signs: np.ndarray) -> np.ndarray:
        """What random values (signs, (n, k)) do to data and dynamics."""
        values = self.process.size * self.whitener.coloured(signs)
        return np.asarray(self.site.effects @ values)

    def pulled(self, projected: np.ndarray) -> np.ndarray:
        """What projected shifts ask of its whitened values, (n, k)."""
        pull = self.whitener.factor_of(self.site.effects.T @ projected)
        return self.process.size * pull

    def slope_of_precision(self, values: np.ndarray) -> np.ndarray:
        """Slope of the inverse covariance in the log time, times values (n, ...)."""
        diagonal, below = self._slopes_of_precision
        result: np.ndarray = (diagonal * values.T).T
        result[1:] += (below * values[:-1].T).T
        result[:-1] += (below * values[1:].T).T
        return result

    @cached_property
    def _slopes_of_precision(self) -> tuple[np.ndarray, np.ndarray]:
        """Of its two diagonals."""
        diagonal, below = self.whitener.precision
        later, later_below = self._later.precision
        scale = self.process.size**2 * self.log_step
        return (later - diagonal) / scale, (later_below - below) / scale

    @cached_property
    def _later(self) -> Whitener:
        """Of a time that is a little longer."""
        return self.site.whitener(self.process.time * float(np.exp(self.log_step)))

    @property
    def moved_by_time(self) -> np.ndarray:
        """Change of its most likely values with the log time, (n,)."""
        normals = self.whitener.factor_of(self.slope_of_precision(self.mean))
        return -(self.process.size**2) * self.whitener.coloured(normals)

    def slope_in_time(self, signs: np.ndarray, pulled: np.ndarray) -> float:
        """Of the log evidence, from what random values leave (n, k)."""
        change = float(self.mean @ self.slope_of_precision(self.mean))
        size = self.process.size
        found = size * self.whitener.coloured(signs - pulled)
        of_signs = self.slope_of_precision(self.whitener.coloured(signs) * size)
        trace = float(np.mean(np.sum(found * of_signs, axis=0)))
        d_log_det = (self._later.log_det - self.whitener.log_det) / self.log_step
        return d_log_det - (change + trace) / 2


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
    system = likelihood.at(disturbances)
    problem = system.problem
    log_evidence = system.log_evidence
    components = []
    for process, site in zip(disturbances.processes, likelihood.sites, strict=True):
        components.append(Component.of(process, site, system.projected_data))
    # Places of each function's coefficients in the border.
    owner = np.r_[np.full(system.border.n_theta, -1), system.border.owner]
    n_functions = len(disturbances.functions)
    coefficients = [np.flatnonzero(owner == k) for k in range(n_functions)]
    changes = [_shifts_by_noise(system, channels)]
    for one in components:
        changes.append((one.site.effects @ (2 * one.mean))[:, None])
    for one in components:
        changes.append((one.site.effects @ one.moved_by_time)[:, None])
    for places in coefficients:
        step = likelihood.border_in_dynamics[:, places] @ system.border.estimate[places]
        changes.append(np.concatenate([np.zeros(problem.n_values), 2 * step])[:, None])
    columns = np.hstack(changes)
    shifts = columns if sums is None else columns @ sums.T

    # As many as together look at 8000 values.
    n_probes = int(np.clip(8_000 // problem.n_values, *PROBES))
    lengths = (problem.n_values, *(len(one.normals) for one in components))
    of_values, *of_components = random_signs(lengths, n_probes)
    root = np.sqrt(system.weights)[:, None]
    noises = np.zeros((len(columns), n_probes))
    noises[: problem.n_values] = of_values / root
    signals = np.zeros((len(columns), n_probes))
    for one, signs in zip(components, of_components, strict=True):
        signals += one.signal(signs)
    left = system.projected(np.hstack([shifts, noises, signals]))
    k = shifts.shape[1]
    information = shifts.T @ left[:, :k] / 2

    left_of_values = left[: problem.n_values, k : k + n_probes] / root
    by_value = (root[:, 0] * system.residual) ** 2
    by_value -= np.mean(of_values * left_of_values, axis=1)
    gradient = [by_value[problem.grid.channel == channel].sum() for channel in channels]
    by_time = []
    for one, signs in zip(components, of_components, strict=True):
        pulled = one.pulled(left[:, k + n_probes :])
        gradient.append(one.squares - np.mean(np.sum(signs * pulled, axis=0)))
        by_time.append(one.slope_in_time(signs, pulled))
    gradient += by_time
    variance = np.diag(system.border.covariance)
    for function, places in zip(disturbances.functions, coefficients, strict=True):
        squares = np.sum(system.border.estimate[places] ** 2 + variance[places])
        gradient.append(squares / function.size**2 - len(places))
    total = np.array(gradient) if sums is None else sums @ np.array(gradient)
    return Slopes(log_evidence, total, (information + information.T) / 2)


def _shifts_by_noise(system: OptimalitySystem, channels: Sequence[int]) -> np.ndarray:
    """How the data would move with the log noise of each channel."""
    problem = system.problem
    is_own = problem.grid.channel[:, None] == np.array(channels, dtype=int)
    shifts = np.where(is_own, 2 * system.residual[:, None], 0.0)
    return np.pad(shifts, ((0, len(problem.offset)), (0, 0)))


# --- Steps


@dataclass(frozen=True, eq=False)
class Evidence:
    """Disturbances with the logarithm of their marginal likelihood."""

    disturbances: Disturbances  # with their sizes
    log_evidence: float  # up to a constant of the record
    gain: float = 0.0  # of it since the origin of an ascent
    # About these disturbances, where an ascent found them.
    coordinates: Coordinates | None = None
    # Of the coordinates, (n_coordinates, n_coordinates), about the curvature.
    information: np.ndarray | None = None


def climbed(
    likelihood: MarginalLikelihood,
    coordinates: Coordinates,
    most_steps: int,
    worth: float = -np.inf,
    least_gain: float = 0.03,
) -> Evidence:
    """The largest log evidence, by damped Newton steps from the coordinates' origin.

    Args:
        likelihood: of the structure of the origin.
        coordinates: with their bounds.
        most_steps: uphill, at most.
        worth: log evidence below which what is found is of no use; an ascent ends where
            it promises no more.
        least_gain: of the log evidence by a step, at which they end. The default is far
            below what makes a difference to a standard error, and about what the random
            signs leave open.
    """
    lower, upper = coordinates.bounds
    sums = coordinates.among_slopes()

    def slopes_at(vector: np.ndarray) -> Slopes | None:
        """None where the states do not follow from the data."""
        disturbances = coordinates.at(vector)
        try:
            found = slopes(likelihood, disturbances, coordinates.channels, sums)
        except SolveError:
            return None
        return found if np.isfinite(found.log_evidence) else None

    vector = np.zeros(len(lower))
    # Share of the information that is added to it (Levenberg 1944, Marquardt 1963).
    damping = 0.1
    here = slopes_at(vector)
    if here is None:
        none = np.zeros((len(vector), len(vector)))
        return Evidence(coordinates.origin, -np.inf, 0.0, coordinates, none)
    first = here.log_evidence
    for _ in range(most_steps):
        leads_out = (vector <= lower) & (here.gradient < 0)
        leads_out |= (vector >= upper) & (here.gradient > 0)
        # The evidence is steeper than a quadratic in logarithms of sizes that are far
        # too small or too large.
        hope = 3 * _promise(here, ~leads_out)
        if hope < least_gain or here.log_evidence + hope < worth:
            break
        step = _newton_step(here, ~leads_out, damping)
        trial = np.clip(vector + step, lower, upper)
        there = slopes_at(trial)
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
    disturbances = coordinates.at(vector)
    return Evidence(
        disturbances=disturbances,
        log_evidence=here.log_evidence,
        gain=here.log_evidence - first,
        coordinates=replace(coordinates, origin=disturbances),
        information=here.information,
    )


def _promise(here: Slopes, moves: np.ndarray) -> float:
    """What the quadratic at a place rises by, where some coordinates may move."""
    inner = here.information[np.ix_(moves, moves)]
    curvature = inner + LEAST_INFORMATION * np.eye(len(inner))
    gradient = here.gradient[moves]
    return float(gradient @ np.linalg.solve(curvature, gradient)) / 2


def _newton_step(here: Slopes, moves: np.ndarray, damping: float) -> np.ndarray:
    """A step uphill, no coordinate (a logarithm) by more than two."""
    step = np.zeros(len(here.gradient))
    inner = here.information[np.ix_(moves, moves)]
    diagonal = np.maximum(np.diag(inner), LEAST_INFORMATION)
    damped = inner + np.diag(damping * diagonal + LEAST_INFORMATION)
    step[moves] = np.linalg.solve(damped, here.gradient[moves])
    longest = np.max(np.abs(step))
    return step * min(1.0, 2.0 / max(longest, TINY))


# --- Processes that are not there yet


def first_gains(
    system: OptimalitySystem,
    channels: Sequence[int],
    disturbances: Disturbances,
    is_tied: bool,
) -> tuple[float, float]:
    """Gain of the log evidence by the first step, by forces, and by sensors.

    Args:
        system: white noise, without processes or functions.
        channels: states whose noise is estimated, and follows the processes.
        disturbances: forces and errors of sensors that could act; sizes matter only
            beside each other, where tied.
        is_tied: whether the sizes of one kind share a factor, as in a search over many.
    """
    problem = system.problem
    forces = disturbances.forces
    sensors = disturbances.sensors
    components = []
    sites = problem.sites(disturbances)
    for process, site in zip(disturbances.processes, sites, strict=True):
        components.append(Component.of(process, site, system.projected_data))
    if not components:
        return 0.0, 0.0
    # Of every kind the first component; what shares a factor follows it.
    n_forces = len(_firsts(forces, is_tied))
    firsts = np.r_[_firsts(forces, is_tied), len(forces) + _firsts(sensors, is_tied)]
    noises = _shifts_by_noise(system, channels)
    if is_tied:
        noises = noises.sum(axis=1, keepdims=True)
    information = _information(system, components, firsts, noises)
    sizes = np.sqrt(np.maximum(np.diag(information), TINY))
    slopes = _slopes_at_zero(system, components, firsts, sizes)
    with np.errstate(over="ignore"):  # a component that leaves no trace
        correlation = np.clip(information / np.outer(sizes, sizes), -1.0, 1.0)
    return (
        _gain(slopes[:n_forces], correlation[:n_forces, :n_forces]),
        _gain(slopes[n_forces:], correlation[n_forces:, n_forces:]),
    )


def _firsts(members: Sequence[Process], is_tied: bool) -> np.ndarray:
    """Places of the members with which a kind begins: where tied they are one kind."""
    return np.arange(len(members[:1] if is_tied else members))


def _information(
    system: OptimalitySystem,
    components: Sequence[Component],
    firsts: np.ndarray,
    noises: np.ndarray,
) -> np.ndarray:
    """Average information about the variance of each kind, noises following."""
    shifts = np.array([one.site.effects @ one.mean for one in components])
    columns = np.hstack([noises, np.add.reduceat(shifts, firsts).T])
    products = columns.T @ system.projected(columns)
    products = (products + products.T) / 4
    n = noises.shape[1]
    of_noise = np.linalg.pinv(products[:n, :n], hermitian=True)
    mixed = products[n:, :n]
    information: np.ndarray = products[n:, n:] - mixed @ of_noise @ mixed.T
    return information


def _slopes_at_zero(
    system: OptimalitySystem,
    components: Sequence[Component],
    firsts: np.ndarray,
    sizes: np.ndarray,
) -> np.ndarray:
    """Slopes of the log evidence in the variance of each kind, over given sizes."""
    # Each is then known to about a third of its standard deviation.
    n_signs = 8
    signs = random_signs(tuple(len(one.normals) for one in components), n_signs)
    owner = np.searchsorted(firsts, np.arange(len(components)), side="right") - 1
    roots = np.sqrt(sizes[owner])
    signals = 0.0
    for one, drawn, root in zip(components, signs, roots, strict=True):
        signals = signals + one.signal(drawn) / root
    projected = system.projected(np.asarray(signals))
    by_chance = []
    for one, drawn in zip(components, signs, strict=True):
        by_chance.append(np.sum(drawn * one.pulled(projected)) / n_signs)
    squares = np.add.reduceat([one.squares for one in components], firsts) / sizes
    found = (squares - np.add.reduceat(by_chance / roots, firsts)) / 2
    # That of a channel whose residuals are zero is beyond numbers.
    return np.maximum(found, -1e6)


def _gain(slopes: np.ndarray, information: np.ndarray) -> float:
    """The most that a quadratic rises by variances (n,) that are not negative."""
    if not np.any(slopes > 0):
        return 0.0
    regular = information + 1e-9 * np.eye(len(slopes))  # where there is none
    found = np.linalg.solve(regular, slopes)
    if np.any(found < 0):
        lower = np.linalg.cholesky(regular)
        found, _ = scipy.optimize.nnls(lower.T, np.linalg.solve(lower, slopes))
    return float(slopes @ found - found @ information @ found / 2)
