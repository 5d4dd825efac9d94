"""The missing force: what a model lacks, as an unknown function of time, estimated from
the data.

The states and the force are found by one program (`losses.MissingForce`); how large the
force is, and how large the noise, is chosen by marginal likelihood at the linearised
solution (Laplace's approximation). The updates are MacKay's: each variance becomes its
sum of squares over the number of its well-determined directions, whose trace is taken
with fixed random probes, so that the result is deterministic.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import block_diag, bmat, csc_matrix, diags, identity

from phsi_opt.errors import SolveError
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.initialization.scaling import first_point
from phsi_opt.model.model import Model
from phsi_opt.model.structure import forced_rows
from phsi_opt.optimization.banded import Banded
from phsi_opt.optimization.ipopt import Solution, Solver
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import time_order
from phsi_opt.transcription.force_prior import ForcePrior
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import MissingForce
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import SensorOutputs

Known = bool | np.ndarray  # whether the noise is known, of all states or of each
N_PROBES = 24
PROBED = 200_000  # values that all probes together look at, at least
SHRINKING = (
    1.0,
    0.1,
    0.01,
)  # sizes of the force while parameters and states are found together
# iterations while the force's size is still sought: beside sharp friction a generous
# force takes hundreds
ROUGH = 30
SETTLED = 0.02  # change of the logarithm of a variance at which its updates end
LARGEST_CHANGE = 10.0  # factor by which a variance may move in one update
# violation of the (scaled) dynamics beyond which a search that did not end well is of
# no use
LOST = 1e-2
GENEROUS = (
    100.0  # factor on the size of the force after a search from its usual size failed
)


@dataclass(frozen=True, eq=False)
class ForceEstimate:
    """States x (n_nodes, n_states), force w (n_intervals, n_forced), noise per state,
    prior, and their evidence.
    """

    x: np.ndarray
    w: np.ndarray
    sigma: np.ndarray
    prior: ForcePrior
    log_evidence: float
    grid: Grid
    linear: "Linearised"
    rounded: dict[str, float] = field(
        default_factory=dict
    )  # widths of corners that were too sharp for the search


def default_prior(model: Model, grid: Grid, point: Point) -> ForcePrior:
    """A generous prior: sizes from the states' own rates, correlation time a fraction
    of the records.
    """
    rows = forced_rows(model)
    last = np.r_[grid.first[1:] - 1, grid.n_nodes - 1]
    duration = float(np.mean(grid.t[last] - grid.t[grid.first]))
    rate = np.sqrt(np.mean(np.diff(point.x, axis=0) ** 2, axis=0)) / np.median(grid.h)
    size = np.maximum(rate, point.x_scale / duration)[list(rows)]
    return ForcePrior(rows, size, duration / 10)


def estimate_force(
    model: Model,
    grid: Grid,
    point: Point,
    sigma: np.ndarray,
    *,
    rounds: int = 3,
    known_noise: Known = False,
    prior: ForcePrior | None = None,
    integrator: str = "srk4",
) -> ForceEstimate:
    """Estimate states and missing force of ``model`` at ``point.theta``, with force
    size and unknown noise by evidence.

    ``point.theta`` is (n_free,), or (n_free, n_trajectories) where trajectories have
    parameters of their own.
    """
    prior = prior or default_prior(model, grid, point)
    theta = point.theta
    program = MissingForce(integrator).program(model, grid, point, prior, sigma)
    solver = Solver(program, SolverSettings(tolerance=1e-6, max_iterations=ROUGH))
    start, evidence = program.start, -np.inf
    for rest in reversed(range(rounds)):
        solution = solver.solve(start, np.r_[prior.size, sigma], raise_on_failure=False)
        if _is_lost(
            solution
        ):  # a force large enough lets the states follow the data, whatever the model
            prior = replace(prior, size=GENEROUS * prior.size)
            solution = solver.solve(
                program.start, np.r_[prior.size, sigma], raise_on_failure=False
            )
        if _is_lost(solution) or not (rest or solution.outcome.success):
            solver = Solver(program, SolverSettings(tolerance=1e-6, max_iterations=200))
            solution = solver.solve(
                solution.z, np.r_[prior.size, sigma], raise_on_failure=False
            )
        if _is_lost(solution):
            raise SolveError(
                f"The missing force could not be estimated: {solution.outcome}"
            )
        start = solution.z
        x = solution.values["x"].reshape(point.x.shape)
        w = solution.values["w"].reshape(grid.n_intervals, len(prior.rows))
        jacobian = csc_matrix(solution.kkt.jacobian @ diags(1 / program.scale))
        point = replace(point, x=x, w=w)
        sensed = SensorOutputs.at(model, grid, x, theta)
        old = sigma, prior
        sigma, prior, evidence, linear = _update(
            grid, point, jacobian, sigma, prior, known_noise, sensed
        )
        step = max(
            np.max(np.abs(np.log(sigma / old[0]))),
            np.max(np.abs(np.log(prior.size / old[1].size))),
        )
        if step < SETTLED and solution.outcome.success:
            break
    assert point.w is not None
    return ForceEstimate(point.x, point.w, sigma, prior, evidence, grid, linear)


def softened(
    model: Model,
    grid: Grid,
    unknown: Theta,
    point: Point,
    sigma: np.ndarray,
    integrator: str,
) -> Point:
    """Parameters and states together, with a missing force that is generous first and
    then shrinks.

    With the force free the dynamics hold softly: the states cannot run away while the
    parameters are still wrong, and the parameters are not confirmed by states that were
    smoothed with them.
    """
    prior = default_prior(model, grid, point)
    program = MissingForce(integrator).program(
        model, grid, point, prior, sigma, unknown
    )
    solver, start = (
        Solver(program, SolverSettings(tolerance=1e-4, max_iterations=60)),
        program.start,
    )
    for factor in SHRINKING:
        solution = solver.solve(
            start, np.r_[factor * prior.size, sigma], raise_on_failure=False
        )
        if _is_lost(solution):
            break
        start = solution.z
        point = replace(
            point,
            theta=solution.values["theta"],
            x=solution.values["x"].reshape(point.x.shape),
        )
    return point


def _is_lost(solution: Solution) -> bool:
    return not solution.outcome.success and solution.outcome.infeasibility > LOST


def _update(
    grid: Grid,
    point: Point,
    jacobian: csc_matrix,
    sigma: np.ndarray,
    prior: ForcePrior,
    known_noise: Known,
    sensed: SensorOutputs,
) -> "tuple[np.ndarray, ForcePrior, float, Linearised]":
    """Noise and force size of largest marginal likelihood in the problem linearised at
    the point.
    """
    evidence = -np.inf
    for _ in range(8):
        linear = Linearised(grid, point, jacobian, sigma, prior, sensed)
        evidence = linear.log_evidence()
        new_sigma, new_size = linear.improved(known_noise)
        step = max(
            np.max(np.abs(np.log(new_sigma / sigma))),
            np.max(np.abs(np.log(new_size / prior.size))),
        )
        sigma, prior = new_sigma, replace(prior, size=new_size)
        if step < SETTLED:
            break
    return sigma, prior, evidence, linear


def force_deviation(estimate: ForceEstimate, most: int = 400) -> np.ndarray:
    """Standard deviation of the force, (n_intervals, n_forced): exact up to ``most``
    intervals, else interpolated.
    """
    linear, (n_intervals, n_forced) = estimate.linear, estimate.w.shape
    chosen = np.unique(
        np.linspace(0, n_intervals - 1, min(most, n_intervals)).astype(int)
    )
    result = np.zeros((n_intervals, n_forced))
    for k in range(n_forced):
        at = linear.n_x + chosen * n_forced + k
        unit = np.zeros((linear.n_total, len(chosen)))
        unit[at, np.arange(len(chosen))] = 1.0
        variance = linear.factor.solve(unit)[at, np.arange(len(chosen))]
        result[:, k] = np.interp(
            np.arange(n_intervals), chosen, np.sqrt(np.maximum(variance, 0.0))
        )
    return result


class Linearised:
    """The missing-force problem linearised at a point: one factorisation, then means,
    variances and evidence.
    """

    def __init__(
        self,
        grid: Grid,
        point: Point,
        jacobian: csc_matrix,
        sigma: np.ndarray,
        prior: ForcePrior,
        sensed: SensorOutputs | None = None,
    ) -> None:
        assert point.w is not None
        sensed = sensed or SensorOutputs(point.x, identity(point.x.size, format="csc"))
        self.grid, self.point, self.sigma, self.prior = grid, point, sigma, prior
        self.n_x, self.n_w = point.x.size, point.w.size
        self.whiteners = [prior.whitener(grid, k) for k in range(len(prior.rows))]
        n_forced = len(prior.rows)
        order = (
            np.arange(self.n_w).reshape(-1, n_forced).T.ravel()
        )  # from force-major to interval-major
        self.L = block_diag(self.whiteners, format="csc")[:, np.argsort(order)]
        seen = grid.measured
        self.weight = np.where(seen, 1 / np.tile(sigma, (grid.n_nodes, 1)), 0.0).ravel()
        self.seen_of = (
            diags(self.weight) @ sensed.jacobian
        )  # from a change of the states to weighted values
        hessian = block_diag(
            [self.seen_of.T @ self.seen_of, self.L.T @ self.L], format="csc"
        )
        self.n_total = hessian.shape[0] + jacobian.shape[0]
        n = point.x.shape[1]
        along = time_order(grid, ("node", n), ("interval", n_forced), ("interval", n))
        self.factor = Banded(
            bmat([[hessian, jacobian.T], [jacobian, None]], format="coo"), along
        )
        residual = np.where(seen, grid.y - sensed.values, 0.0).ravel()
        gradient = np.r_[
            -self.seen_of.T @ (self.weight * residual),
            self.L.T @ (self.L @ point.w.ravel()),
        ]
        step = self.factor.solve(np.r_[-gradient, np.zeros(jacobian.shape[0])])
        self.residual = residual - sensed.jacobian @ step[: self.n_x]
        self.innovations = self.L @ (
            point.w.ravel() + step[self.n_x : self.n_x + self.n_w]
        )

    def log_evidence(self) -> float:
        """log p(y | noise, force size), up to a constant of the linearisation point."""
        misfit = np.sum((self.weight * self.residual) ** 2) + np.sum(
            self.innovations**2
        )
        log_det = self.factor.log_abs_det
        log_noise = np.sum(np.log(self.weight[self.weight > 0]))
        log_prior = sum(np.sum(np.log(L.diagonal())) for L in self.whiteners)
        return float(-misfit / 2 - log_det / 2 + log_noise + log_prior)

    def improved(self, known_noise: Known) -> tuple[np.ndarray, np.ndarray]:
        """MacKay's update of the noise and of the force size."""
        determined_y, determined_w = self._well_determined()
        sigma = self.sigma.copy()
        seen, squares = (
            self.grid.measured,
            self.residual.reshape(self.grid.y.shape) ** 2,
        )
        for k in np.flatnonzero(
            seen.any(axis=0) & ~np.broadcast_to(known_noise, len(sigma))
        ):
            free = max(seen[:, k].sum() - determined_y[k], 1.0)
            sigma[k] = np.sqrt(max(squares[:, k].sum() / free, TINY))
        per_force = self.innovations.reshape(len(self.prior.rows), -1)
        ratio = np.array([np.sum(r**2) for r in per_force]) / np.maximum(
            determined_w, 1e-3
        )
        size = self.prior.size * np.sqrt(
            np.clip(ratio, 1 / LARGEST_CHANGE, LARGEST_CHANGE)
        )
        return np.clip(
            sigma, self.sigma / LARGEST_CHANGE, self.sigma * LARGEST_CHANGE
        ), size

    def _well_determined(self) -> tuple[np.ndarray, np.ndarray]:
        """Number of well-determined directions per measured channel and per force."""
        rng = np.random.default_rng(0)
        n_probes = int(
            np.clip(PROBED // self.n_x, 2, N_PROBES)
        )  # the trace of a longer record needs fewer
        signs_y = (
            rng.choice([-1.0, 1.0], (self.n_x, n_probes)) * (self.weight > 0)[:, None]
        )
        signs_w = rng.choice([-1.0, 1.0], (self.n_w, n_probes))
        right = np.zeros((self.n_total, 2 * n_probes))
        right[: self.n_x, :n_probes] = self.seen_of.T @ signs_y
        right[self.n_x : self.n_x + self.n_w, n_probes:] = self.L.T @ signs_w
        left = self.factor.solve(right)
        along_y = signs_y * (self.seen_of @ left[: self.n_x, :n_probes])
        along_w = signs_w * (self.L @ left[self.n_x : self.n_x + self.n_w, n_probes:])
        n_forced = len(self.prior.rows)
        determined_y = along_y.mean(axis=1).reshape(self.grid.y.shape).sum(axis=0)
        determined_w = self.n_w / n_forced - along_w.mean(axis=1).reshape(
            n_forced, -1
        ).sum(axis=1)
        return determined_y, determined_w


ROUNDER = (1.0, 4.0, 16.0, 64.0)  # factors on the width of corners that are too sharp


def smoothed(
    model: Model,
    grid: Grid,
    sigma: np.ndarray,
    integrator: str,
    known_noise: Known,
    theta: np.ndarray | None = None,
    *,
    rounds: int = 3,
    prior: ForcePrior | None = None,
) -> ForceEstimate:
    """States, also unmeasured ones, by the missing-force program at the model's present
    values.

    ``theta``: other values, (n_free, n_trajectories) where trajectories have parameters
    of their own. Where a corner of dry friction is too sharp for the search, it is
    rounded.
    """
    point = first_point(model, grid)
    point = point if theta is None else replace(point, theta=theta)
    widths = {name: model.values[name] for name in corner_widths(model)}
    for factor in ROUNDER if widths else (1.0,):
        rounded = (
            {}
            if factor == 1
            else {name: factor * width for name, width in widths.items()}
        )
        try:
            found = estimate_force(
                model.with_values(rounded),
                grid,
                point,
                sigma,
                rounds=rounds,
                known_noise=known_noise,
                prior=prior,
                integrator=integrator,
            )
            return replace(found, rounded=rounded)
        except SolveError as error:
            failure = error
    raise failure
