"""The marginal likelihood beside a model, against other ways to the same numbers.

- dense Gaussian algebra on the same discrete model, for every kind of disturbance,
- the Kalman filter of statsmodels, of the continuous system.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, hadamard
from scipy.optimize import minimize
from statsmodels.tsa.statespace.initialization import Initialization
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

import phsi_opt as ph
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.identify import estimate_by
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.model_error import ascent
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.disturbances import (
    Coordinates,
    Disturbances,
    Process,
    StateFunction,
)
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border, MarginalLikelihood
from phsi_opt.model_error.standard_errors import covariance_under
from phsi_opt.optimization.bounded_step import REGULAR
from phsi_opt.transcription.grid import AlignedData

NOISE = 0.05
NONE = np.array([], dtype=int)  # parameters that move, where none does
# The dense algebra and the banded factors are the same model; what is left is rounding,
# and a ridge of 1e-10 on each parameter.
ROUNDING = 1e-7


# --- Records


def oscillator() -> ph.FirstOrder:
    return ph.FirstOrder(
        states=("q", "v"),
        inputs=("u",),
        F={
            "q": "v",
            "v": ph.formula("-k*q - c*v", k=ph.Parameter(3.5), c=ph.Parameter(0.4))
            + ph.formula("g*u", g=ph.Parameter(1.2)),
        },
    )


def record(
    lengths: Sequence[int], seed: int, gap: float = 0.0, with_v: bool = False
) -> ph.Measurements:
    """Noisy oscillations with an offset that wanders, at irregular times."""
    rng = np.random.default_rng(seed)
    times = []
    states = []
    inputs = []
    for n in lengths:
        t = np.cumsum(rng.uniform(0.1, 0.2, size=n))
        wandering = 0.03 * np.cumsum(rng.normal(size=n))
        phase = rng.uniform(0, 2 * np.pi)
        decaying = np.exp(-0.15 * t)
        q = decaying * np.cos(2 * t + phase) + wandering
        v = -2 * decaying * np.sin(2 * t + phase)
        x = np.column_stack([q, v]) + NOISE * rng.normal(size=(n, 2))
        if not with_v:
            x[:, 1] = np.nan
        is_missing = rng.uniform(size=n) < gap
        x[is_missing, 0] = np.nan
        times.append(t)
        states.append(x)
        inputs.append(np.sin(1.3 * t[:, None] + phase) / 3)
    return ph.Measurements.from_arrays(
        times, states, inputs, states=["q", "v"], inputs=["u"], hold="linear"
    )


def estimated(
    data: ph.Measurements, model: ph.FirstOrder, steps: int
) -> LikelihoodEstimate:
    task = Task(model, AlignedData.of(model, data), {}, None, ph.SolverSettings())
    estimate = estimate_by(ph.MaximumLikelihood(steps=steps), task, None)
    assert isinstance(estimate, LikelihoodEstimate)
    assert estimate.is_success
    return estimate


@cache
def estimate_of(name: str) -> LikelihoodEstimate:
    if name == "one run":
        return estimated(record([40], 1), oscillator(), steps=1)
    several = record([17, 25, 9], 2, gap=0.15, with_v=True)
    return estimated(several, oscillator(), steps=2)


@cache
def search_of(name: str) -> DisturbanceSearch:
    return estimate_of(name).plain_search


@cache
def problem_of(name: str) -> Linearization:
    """One interval between samples, or all the steps of the integration."""
    if name == "several runs, all steps":
        return estimate_of("several runs").linearized()
    return search_of(name).problem


# --- Dense algebra: shown = M (starting states, parameters) + Gaussian errors


@dataclass(frozen=True)
class Dense:
    """A linearised record with its dynamics solved for the states."""

    problem: Linearization
    y: np.ndarray
    of_start: np.ndarray
    of_theta: np.ndarray
    of_dynamics: np.ndarray

    @classmethod
    def of(cls, problem: Linearization, moving: np.ndarray) -> "Dense":
        grid = problem.grid
        n = problem.n_states
        first = (grid.first[:, None] * n + np.arange(n)).ravel()
        others = np.setdiff1d(np.arange(grid.n_nodes * n), first)
        dynamics = problem.dynamics_in_states.toarray()
        shown = problem.shown_in_states.toarray()
        to_shown = shown[:, others] @ np.linalg.inv(dynamics[:, others])
        in_theta = problem.shown_in_theta - to_shown @ problem.dynamics_in_theta
        return cls(
            problem=problem,
            y=problem.residual + to_shown @ problem.offset,
            of_start=shown[:, first] - to_shown @ dynamics[:, first],
            of_theta=in_theta[:, moving],
            of_dynamics=to_shown,
        )

    @property
    def design(self) -> np.ndarray:
        return np.hstack([self.of_start, self.of_theta])

    def force_slopes(self, equation: int) -> np.ndarray:
        """What a force of one in each interval shows, (n_values, n_intervals)."""
        problem = self.problem
        effects = problem.force_effects[:, equation :: problem.n_states].toarray()
        return np.asarray(self.of_dynamics @ effects)

    def force_covariance(self, d: Disturbances) -> np.ndarray:
        """Of the values of all forces."""
        problem = self.problem
        grid = problem.grid
        middles = (grid.t[grid.begin] + grid.t[grid.begin + 1]) / 2
        blocks = []
        for force in d.forces:
            blocks.append(kernel(force, middles, grid.trajectory[grid.begin]))
        covariance: np.ndarray = block_diag(*blocks)
        return covariance

    def errors(self, d: Disturbances) -> np.ndarray:
        """Covariance of what is shown under disturbances, (n_values, n_values)."""
        problem = self.problem
        grid = problem.grid
        run = grid.trajectory[problem.grid.node]
        covariance = np.diag(d.sigma[run, problem.grid.channel] ** 2)
        if d.forces:
            slopes = np.hstack([self.force_slopes(f.place) for f in d.forces])
            covariance += slopes @ self.force_covariance(d) @ slopes.T
        for sensor in d.sensors:
            values = np.flatnonzero(problem.grid.channel == sensor.place)
            t = grid.t[problem.grid.node[values]]
            wandering = kernel(sensor, t, run[values])
            covariance[np.ix_(values, values)] += wandering
        for function in d.functions:
            basis = problem.function_values[function.state]
            slopes = self.force_slopes(function.equation) @ basis
            covariance += function.size**2 * slopes @ slopes.T
        return covariance

    def log_evidence(self, d: Disturbances) -> float:
        """With starting states and parameters integrated out (REML)."""
        covariance = self.errors(d)
        log_det = np.linalg.slogdet(covariance)[1]
        inverse = np.linalg.inv(covariance)
        information = self.design.T @ inverse @ self.design
        log_det += np.linalg.slogdet(information)[1]
        right = self.design.T @ inverse @ self.y
        misfit = self.y @ inverse @ self.y
        misfit -= right @ np.linalg.solve(information, right)
        return float(-(misfit + log_det) / 2)

    def log_likelihood(self, d: Disturbances) -> float:
        """At the best parameters, with starting states integrated out."""
        inverse = np.linalg.inv(self.errors(d))
        of_all = np.linalg.slogdet(self.design.T @ inverse @ self.design)[1]
        of_start = np.linalg.slogdet(self.of_start.T @ inverse @ self.of_start)[1]
        return self.log_evidence(d) + float(of_all - of_start) / 2

    def to_theta(self, d: Disturbances) -> np.ndarray:
        """Generalised least squares: from values to parameters, (n_moving, n_values)."""
        inverse = np.linalg.inv(self.errors(d))
        information = self.design.T @ inverse @ self.design
        answer: np.ndarray = np.linalg.solve(information, self.design.T @ inverse)
        return answer[self.of_start.shape[1] :]


def kernel(process: Process, t: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Covariance of a process at times of several trajectories, (n, n)."""
    distance = np.abs(t[:, None] - t[None, :])
    if process.time > 0:
        correlation = np.exp(-distance / process.time)
    else:
        correlation = np.eye(len(t))
    same = run[:, None] == run[None, :]
    covariance: np.ndarray = process.size**2 * correlation * same
    return covariance


def cases(problem: Linearization) -> dict[str, Disturbances]:
    """Disturbances of every kind, and together."""
    rng = np.random.default_rng(5)
    sigma = NOISE * rng.uniform(0.7, 1.4, (problem.grid.n_trajectories, 2))
    force = Process(1, 0.4, 0.7)
    other = Process(1, 0.2, 0.0)
    in_q = Process(0, 0.05, 2.0)
    sensors = tuple(
        Process(k, 0.03, 0.5 + k) for k in np.unique(problem.grid.channel).tolist()
    )
    functions = (StateFunction(1, 0, 0.3), StateFunction(1, 1, 0.1))
    return {
        "white": Disturbances(sigma),
        "less white": Disturbances(sigma / 2),
        "force": Disturbances(sigma, (force,)),
        "longer force": Disturbances(sigma, (replace(force, time=5.0),)),
        "two forces": Disturbances(sigma, (force, other)),
        "forces in both": Disturbances(sigma, (in_q, force)),
        "sensors": Disturbances(sigma, sensors=sensors),
        "functions": Disturbances(sigma, functions=functions),
        "all": Disturbances(sigma, (in_q, force), sensors, functions),
    }


RECORDS = ("one run", "several runs", "several runs, all steps")
KINDS = (
    "less white",
    "force",
    "longer force",
    "two forces",
    "forces in both",
    "sensors",
    "functions",
    "all",
)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", RECORDS)
def test_the_evidence_is_that_of_dense_restricted_likelihood(name, kind) -> None:
    problem = problem_of(name)
    moving = np.arange(3)
    dense = Dense.of(problem, moving)
    white = cases(problem)["white"]
    d = cases(problem)[kind]
    one = MarginalLikelihood(problem, d, moving)
    other = MarginalLikelihood(problem, white, moving)

    gain = one.at(d).log_evidence - other.at(white).log_evidence
    expected = dense.log_evidence(d) - dense.log_evidence(white)
    assert gain == pytest.approx(expected, abs=ROUNDING)
    assert abs(expected) > 0.5  # the cases differ

    gain = one.at(d).log_likelihood - other.at(white).log_likelihood
    expected = dense.log_likelihood(d) - dense.log_likelihood(white)
    assert gain == pytest.approx(expected, abs=ROUNDING)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", RECORDS)
@pytest.mark.parametrize("moving", [[0, 1, 2], [0, 2]])
def test_estimate_and_covariance_are_those_of_generalised_least_squares(
    name: str, kind: str, moving: list[int]
) -> None:
    problem = problem_of(name)
    places = np.array(moving)
    dense = Dense.of(problem, places)
    d = cases(problem)[kind]
    found = MarginalLikelihood(problem, d, places).at(d)
    to_theta = dense.to_theta(d)
    covariance = to_theta @ dense.errors(d) @ to_theta.T
    std_error = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        found.theta, to_theta @ dense.y, atol=ROUNDING * std_error.min()
    )
    np.testing.assert_allclose(found.covariance, covariance, rtol=ROUNDING)


@pytest.mark.parametrize("taken", ["white", "longer force", "all"])
@pytest.mark.parametrize("name", RECORDS)
def test_the_sandwich_of_an_estimate_is_that_of_dense_matrices(name, taken) -> None:
    """P Sigma P' with P the least squares of the estimate, Sigma of all errors."""
    problem = problem_of(name)
    moving = np.array([0, 2])
    dense = Dense.of(problem, moving)
    estimate = cases(problem)[taken]
    truth = cases(problem)["all"]
    to_theta = dense.to_theta(estimate)
    expected = np.zeros((3, 3))
    expected[np.ix_(moving, moving)] = to_theta @ dense.errors(truth) @ to_theta.T
    response = MarginalLikelihood(problem, estimate, moving).at(estimate).response
    found = covariance_under(problem, response, truth)
    np.testing.assert_allclose(found, expected, rtol=ROUNDING, atol=1e-20)


@pytest.mark.parametrize("kind", ["white", *KINDS])
@pytest.mark.parametrize("name", RECORDS)
def test_smoothed_is_the_best_linear_prediction(name: str, kind: str) -> None:
    """Also beside dynamics that the linearisation does not obey (an offset)."""
    problem = problem_of(name)
    rng = np.random.default_rng(7)
    offset = 0.01 * rng.normal(size=problem.dynamics_in_states.shape[0])
    problem = replace(problem, offset=offset)
    moving = np.arange(3)
    dense = Dense.of(problem, moving)
    d = cases(problem)[kind]
    found = MarginalLikelihood(problem, d, moving).at(d, REGULAR).smoothed()

    inverse = np.linalg.inv(dense.errors(d))
    design = dense.design
    known = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ dense.y)
    pull = inverse @ (dense.y - design @ known)
    n_starting = dense.of_start.shape[1]
    np.testing.assert_allclose(found.theta, known[n_starting:], rtol=1e-6, atol=1e-9)
    first = problem.grid.first
    np.testing.assert_allclose(
        found.x[first].ravel(), known[:n_starting], rtol=1e-6, atol=1e-9
    )

    expected = []
    if d.forces:
        slopes = np.hstack([dense.force_slopes(f.place) for f in d.forces])
        prior = dense.force_covariance(d)
        expected += np.split(prior @ slopes.T @ pull, len(d.forces))
    run = problem.grid.trajectory[problem.grid.node]
    for sensor in d.sensors:
        values = np.flatnonzero(problem.grid.channel == sensor.place)
        t = problem.grid.t[problem.grid.node[values]]
        expected.append(kernel(sensor, t, run[values]) @ pull[values])
    wanted = np.concatenate([np.zeros(0), *expected])
    np.testing.assert_allclose(found.processes, wanted, rtol=1e-6, atol=1e-9)
    expected = []
    for function in d.functions:
        basis = problem.function_values[function.state]
        slopes = dense.force_slopes(function.equation) @ basis
        expected.append(function.size**2 * slopes.T @ pull)
    wanted = np.concatenate([np.zeros(0), *expected])
    np.testing.assert_allclose(found.coefficients, wanted, rtol=1e-6, atol=1e-9)


# --- Slopes of the evidence, against differences of the dense one


SLOPE_STEP = 1e-4  # of a logarithm, for central differences


N_SIGNS = 1024  # more than the rows that a test asks for


class OrthogonalSigns:
    """A generator of signs whose rows are orthogonal: those of a Hadamard matrix."""

    def __init__(self) -> None:
        self._rows = iter(hadamard(N_SIGNS).astype(float))

    def choice(self, _: list[float], shape: tuple[int, int]) -> np.ndarray:
        assert shape[1] == N_SIGNS
        return np.array([next(self._rows) for _ in range(shape[0])])


def moved(
    d: Disturbances, logarithms: np.ndarray, channels: Sequence[int]
) -> Disturbances:
    """In the order of the slopes: noises, sizes and times of processes, functions."""
    factors = np.exp(logarithms).tolist()
    sigma = d.sigma.copy()
    for channel in channels:
        sigma[:, channel] *= factors.pop(0)
    processes = [*d.forces, *d.sensors]
    sizes = [process.size * factors.pop(0) for process in processes]
    times = [process.time * factors.pop(0) for process in processes]
    others = []
    for process, size, time in zip(processes, sizes, times, strict=True):
        others.append(replace(process, size=size, time=time))
    functions = [replace(f, size=f.size * factors.pop(0)) for f in d.functions]
    assert not factors
    n = len(d.forces)
    return replace(
        d,
        sigma=sigma,
        forces=tuple(others[:n]),
        sensors=tuple(others[n:]),
        functions=tuple(functions),
    )


@pytest.mark.parametrize("kind", ["white", *KINDS])
@pytest.mark.parametrize("name", RECORDS)
def test_slopes_and_average_information_are_those_of_dense_algebra(
    name: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With orthogonal signs in place of random ones, with which traces are exact."""
    problem = problem_of(name)
    moving = np.arange(3)
    dense = Dense.of(problem, moving)
    channels = tuple(np.unique(problem.grid.channel).tolist())
    d = cases(problem)[kind]
    if kind == "two forces":  # a time of its own, however short, has a slope
        d = replace(d, forces=(d.forces[0], replace(d.forces[1], time=0.05)))
    likelihood = MarginalLikelihood(problem, d, moving)
    monkeypatch.setattr(ascent, "PROBES", (N_SIGNS, N_SIGNS))
    monkeypatch.setattr(np.random, "default_rng", lambda _: OrthogonalSigns())
    found = ascent.slopes(likelihood, d, channels)

    n = len(found.gradient)
    gradient = []
    in_errors = []
    for unit in SLOPE_STEP * np.eye(n):
        above = moved(d, unit, channels)
        below = moved(d, -unit, channels)
        rise = dense.log_evidence(above) - dense.log_evidence(below)
        gradient.append(rise / (2 * SLOPE_STEP))
        change = dense.errors(above) - dense.errors(below)
        in_errors.append(change / (2 * SLOPE_STEP))
    # Slopes of priors are differences over 1e-4.
    np.testing.assert_allclose(found.gradient, gradient, rtol=1e-3, atol=5e-3)

    # Gilmour, Thompson and Cullis (1995): y'P V_i P V_j P y/2.
    inverse = np.linalg.inv(dense.errors(d))
    to_design = dense.design.T @ inverse
    projection = inverse - to_design.T @ np.linalg.solve(
        to_design @ dense.design, to_design
    )
    pulled = projection @ dense.y
    answers = np.array([change @ pulled for change in in_errors])
    expected = answers @ projection @ answers.T / 2
    largest = np.abs(expected).max()
    np.testing.assert_allclose(found.information, expected, atol=1e-4 * largest)


def coordinates_of(d: Disturbances, channels: tuple[int, ...]) -> Coordinates:
    return Coordinates(
        origin=d,
        channels=channels,
        least_noise=np.full(2, NOISE / 100),
        shortest=0.05,
        longest=50.0,
        largest_functions=tuple(100 * f.size for f in d.functions),
    )


@pytest.mark.parametrize("kind", ["force", "sensors", "functions"])
def test_an_ascent_ends_where_a_search_without_slopes_does(kind: str) -> None:
    problem = problem_of("one run")
    moving = np.arange(3)
    d = cases(problem)[kind]
    coordinates = coordinates_of(d, (0,))
    likelihood = MarginalLikelihood(problem, d, moving)
    found = ascent.climbed(likelihood, coordinates, 25)
    about = found.coordinates
    dense = Dense.of(problem, moving)
    white = cases(problem)["white"]
    constant = MarginalLikelihood(problem, white, moving).at(white).log_evidence
    constant -= dense.log_evidence(white)
    zeros = np.zeros(len(coordinates.bounds[0]))

    def negative_of(around: Coordinates) -> Callable[[np.ndarray], float]:
        lower, upper = around.bounds

        def negative(vector: np.ndarray) -> float:
            there = around.at(np.clip(vector, lower, upper))
            return -dense.log_evidence(there)

        return negative

    assert about is not None
    here = dense.log_evidence(found.disturbances)
    assert found.log_evidence - constant == pytest.approx(here)
    best = minimize(negative_of(about), zeros, method="Nelder-Mead")
    from_start = minimize(negative_of(coordinates), zeros, method="Nelder-Mead")
    highest = -min(best.fun, from_start.fun)
    # An ascent ends at gains of 0.03, and with slopes from few random signs.
    assert highest - (found.log_evidence - constant) < 0.2
    # That of a brief re-fit gives a few of its steps away, and little evidence.
    brief = ascent.climbed(likelihood, coordinates, 25, least_gain=0.2)
    assert found.log_evidence - 0.4 < brief.log_evidence
    assert brief.log_evidence <= found.log_evidence


def test_a_function_gains_what_the_evidence_rises_by() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(30, 10))
    data = rng.normal(size=30) + root @ rng.normal(size=10)
    normal, gradient = root.T @ root, root.T @ data
    owner = np.repeat([0, 1], 4)
    tried = np.array([0.3, 2.0])
    for number, others in ((0, 0.7), (1, 0.7), (1, 0.0)):
        sizes = np.full(2, others)
        border = Border(
            normal, gradient, float(data @ data), 0.0, 2, owner, sizes, np.zeros(2)
        )
        evidences = []
        for size in (1e-4, *tried):
            sizes = np.full(2, max(others, 1e-4))
            sizes[number] = size
            evidences.append(replace(border, sizes=sizes).log_evidence)
        expected = np.array(evidences[1:]) - evidences[0]
        gains = border.gains_by_function(number, tried)
        np.testing.assert_allclose(gains, expected, atol=1e-4)


# --- The Kalman filter of statsmodels, of the continuous system


@dataclass(frozen=True)
class Continuous:
    """q' = v, v' = -k q - c v + w, w an Ornstein-Uhlenbeck process; q with noise."""

    k: float
    c: float
    force: Process

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Transition and covariance of what is new (Van Loan 1978)."""
        drift = np.array(
            [[0, 1, 0], [-self.k, -self.c, 1], [0, 0, -1 / self.force.time]]
        )
        density = np.zeros((3, 3))
        density[2, 2] = 2 * self.force.size**2 / self.force.time
        both = np.block([[-drift, density], [np.zeros((3, 3)), drift.T]])
        exponential = expm(both * dt)
        transition = exponential[3:, 3:].T
        new = transition @ exponential[:3, 3:]
        return transition, (new + new.T) / 2

    def log_likelihood(self, t: np.ndarray, y: np.ndarray, sigma: float) -> float:
        """Of positions y (n,) with NaN where there is none, states flat at first."""
        steps = [self.step(dt) for dt in np.diff(t)] + [self.step(1.0)]
        transition, new = (
            np.stack(parts, axis=-1) for parts in zip(*steps, strict=True)
        )
        starting = Initialization(3, approximate_diffuse_variance=VARIANCE)
        starting.set((0, 2), "approximate_diffuse")
        known = [[self.force.size**2]]
        starting.set(2, "known", constant=[0.0], stationary_cov=known)
        kalman = KalmanFilter(k_endog=1, k_states=3, k_posdef=3)
        kalman.bind(np.ascontiguousarray(y[:, None]))
        kalman["design"] = np.array([[1.0, 0.0, 0.0]])
        kalman["transition"] = transition
        kalman["selection"] = np.eye(3)
        kalman["state_cov"] = new
        kalman["obs_cov"] = np.array([[sigma**2]])
        kalman.initialize(starting)
        return float(kalman.loglike())


VARIANCE = 1e7  # of the starting states, whose natural size is one


def forced_record() -> ph.Measurements:
    """60 samples of the oscillator beside a force that lasts two units of time."""
    rng = np.random.default_rng(3)
    system = Continuous(4.0, 0.3, Process(1, 0.5, 2.0))
    t = np.cumsum(rng.uniform(0.1, 0.3, size=60))
    x = np.array([1.0, 0.0, 0.5 * rng.normal()])
    q = []
    for i in range(len(t)):
        if i:
            transition, new = system.step(t[i] - t[i - 1])
            x = rng.multivariate_normal(transition @ x, new, method="eigh")
        q.append(x[0] + NOISE * rng.normal())
    y = np.column_stack([q, np.full(len(t), np.nan)])
    y[[7, 30, 31], 0] = np.nan
    return ph.Measurements.from_arrays(t, y, states=["q", "v"])


def test_the_likelihood_of_different_models_is_that_of_a_kalman_filter() -> None:
    """Of a free and of a damped oscillator, not up to a constant but whole."""
    data = forced_record()
    (run,) = data.trajectories
    force = Process(1, 0.5, 2.0)
    d = Disturbances(np.full((1, 2), NOISE), (force,))
    flat = np.log(2 * np.pi * VARIANCE)  # of two starting states
    for damping in (0.0, 0.3, 3.0):
        F = {
            "q": ph.formula("v"),
            "v": ph.formula(f"-k*q - {damping}*v", k=ph.Parameter(4.0)),
        }
        estimate = estimated(data, ph.FirstOrder(states=("q", "v"), F=F), steps=16)
        problem = estimate.linearized()
        k = float(estimate.theta[0])
        ours = MarginalLikelihood(problem, d, NONE).at(d).log_likelihood
        system = Continuous(k, damping, force)
        there = system.log_likelihood(run.t, run.x[:, 0], NOISE)
        assert ours == pytest.approx(there + flat, abs=0.02)  # held over a step
