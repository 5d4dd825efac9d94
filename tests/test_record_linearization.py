"""The likelihood of a record and its linearisation: values and slopes against those of
the program, finite differences and dense algebra.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.terms import Dictionary
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import MarginalLikelihood, white_system
from phsi_opt.optimization.bounded_step import REGULAR, RIDGE, Room
from phsi_opt.transcription.defects import parameter_slopes
from phsi_opt.transcription.grid import Grid, aligned, grid_of
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Point, Theta
from phsi_opt.transcription.sensors import outputs

SCHEME = "srk4"
RUNS = ("run 1", "run 2")


def spring(sensor: Mapping[str, Dictionary] | None = None) -> ph.Model:
    """With a mass of every trajectory's own."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula(
            "k*q**2/2 + p**2/(2*m)",
            k=ph.Parameter(2.0),
            m=ph.Parameter(1.5, per_trajectory=True),
        ),
        R=ph.damping("p"),
        F={"p": "u"},
        sensor=sensor or {},
    )


def with_sensor() -> ph.Model:
    """The position is shown with an offset of every trajectory's own, and a gain."""
    offset = ph.Parameter(0.3, per_trajectory=True)
    shown = ph.formula("g*q + c", g=ph.Parameter(0.2), c=offset)
    return spring(sensor={"q": shown})


def with_memory() -> ph.Model:
    """The force acts late: three states more, which nobody measures."""
    model = spring()
    return model.add(effect_named(model, "input delay", "p"))


def grid_of_two_runs(model: ph.Model) -> Grid:
    """Position measured everywhere but once, momentum nowhere in the second run."""
    rng = np.random.default_rng(0)
    times = [np.linspace(0, 2, 9), np.linspace(0, 1, 6)]
    states = [rng.normal(size=(len(t), 2)) for t in times]
    states[0][3, 0] = np.nan
    states[1][:, 1] = np.nan
    inputs = [rng.normal(size=(len(t), 1)) for t in times]
    data = ph.Measurements.from_arrays(
        times, states, inputs, states=["q", "p"], inputs=["u"]
    )
    return grid_of(aligned(model, data))


class Dense:
    """Residuals in units of the noise, and defects, with slopes by differences."""

    def __init__(self, likelihood: LikelihoodValues, sigma: np.ndarray) -> None:
        self.at = likelihood
        self.sigma = sigma

    def defects(self, z: np.ndarray) -> np.ndarray:
        """As changes of the scaled states by one interval."""
        x, theta = self._split(z)
        grid = self.at.grid
        d = parameter_slopes(self.at.model, grid, SCHEME, theta, x).d
        return (d * grid.h[:, None] / self.at.point.x_scale).ravel()

    def residual(self, z: np.ndarray) -> np.ndarray:
        x, theta = self._split(z)
        grid = self.at.grid
        shown = outputs(self.at.model, grid, x, theta)
        return ((grid.y - shown) / self.sigma)[grid.measured]

    def _split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = self.at.point.unscaled(z)
        theta = values["theta"][self.at.unknown.table]
        return values["x"], theta

    def slopes(self, name: str, z: np.ndarray) -> np.ndarray:
        function, step = getattr(self, name), 1e-5
        columns = []
        for direction in step * np.eye(len(z)):
            change = function(z + direction) - function(z - direction)
            columns.append(change / (2 * step))
        return np.array(columns).T


MODELS = {"plain": spring(), "sensor": with_sensor(), "memory": with_memory()}


@pytest.mark.parametrize("name", MODELS)
def test_the_likelihood_linearised_is_that_of_dense_algebra(name: str) -> None:
    model = MODELS[name]
    grid = grid_of_two_runs(model)
    unknown = Theta.of(model, RUNS)
    rng = np.random.default_rng(1)
    theta = rng.uniform(1, 2, len(unknown))
    x = rng.normal(size=grid.y.shape)
    sizes = rng.uniform(0.5, 2, len(unknown)), rng.uniform(0.5, 2, model.n_states)
    point = Point(theta, x, *sizes)
    likelihood = LikelihoodValues(model, grid, SCHEME, point, unknown)
    sigma = np.r_[0.1, 0.2, np.ones(model.n_states - 2)]
    z = point.scaled
    there = likelihood.at(z)
    linear = Linearizer(likelihood).at(z)
    weights = 1 / sigma[linear.grid.channel]
    dense = Dense(likelihood, sigma)
    np.testing.assert_allclose(there.g, dense.defects(z), atol=1e-10)
    np.testing.assert_allclose(weights * there.misfit, dense.residual(z), atol=1e-10)
    n, n_z = len(theta), len(z)
    C = np.hstack([linear.shown_in_theta, linear.shown_in_states.toarray()])
    C = weights[:, None] * C
    J = np.hstack([linear.dynamics_in_theta, linear.dynamics_in_states.toarray()])
    # Central differences: the steps cut off 1e-10, and round at 1e-16/1e-5.
    np.testing.assert_allclose(C, -dense.slopes("residual", z), atol=1e-7)
    np.testing.assert_allclose(J, dense.slopes("defects", z), atol=1e-7)
    H = C.T @ C
    H[range(n, n_z), range(n, n_z)] += REGULAR * np.max(np.diag(H)[n:])
    kkt = np.block([[H, J.T], [J, np.zeros((len(J), len(J)))]])
    inverse = np.linalg.inv(kkt)
    covariance = inverse[:n, :n]
    close = partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-8)

    def alike(found: np.ndarray, wanted: np.ndarray) -> None:
        close(found, wanted, atol=1e-6 * np.max(np.abs(wanted)))

    eliminated = white_system(linear, sigma)
    close(eliminated.information @ covariance, np.eye(n))
    e = rng.normal(size=len(J))
    x, theta = eliminated.solve(np.zeros((len(C), 1)), e[:, None])
    found = np.r_[theta, x[: n_z - n]].ravel()
    close(found, (inverse @ np.r_[np.zeros(n_z), e])[:n_z])
    # Its variances are those of the parameters, carried along, and of the starts.
    following = eliminated.following
    variances = np.einsum("aij,jk,aik->ai", following, covariance, following)
    left = eliminated.start_covariances()
    variances = variances + np.einsum("aii->ai", left)
    np.testing.assert_allclose(
        variances.ravel(), np.diag(inverse)[n:n_z], rtol=1e-5, atol=1e-9
    )
    # A step of the kernel goes to the optimum of what is linear.
    pull = C.T @ (weights * there.misfit)
    whole = np.linalg.solve(kkt, np.r_[pull, -there.g])
    noise = Disturbances(np.tile(sigma, (len(RUNS), 1)))
    kernel = MarginalLikelihood(linear, noise, np.arange(n))
    found = kernel.at(noise, REGULAR).smoothed()
    close(np.r_[found.theta, found.x.ravel()], whole[:n_z])
    alike(found.multipliers, whole[n_z:])
    # So it does where a state, or a parameter, does not move.
    held = n + 1
    kkt[held, held] += 1e9 * np.max(np.diag(H)[n:])
    room = Room(np.r_[0.0, np.full(n - 1, -1e3)], np.r_[0.0, np.full(n - 1, 1e3)])
    kkt[0, :] = kkt[:, 0] = 0.0
    kkt[0, 0] = 1.0
    whole = np.linalg.solve(kkt, np.r_[0.0, pull[1:], -there.g])
    found = kernel.at(noise, REGULAR, np.array([1])).smoothed(room=room)
    close(np.r_[found.theta, found.x.ravel()], whole[:n_z])
    alike(found.multipliers, whole[n_z:])
    # And beside a white force, whose variance softens the dynamics.
    softness = rng.uniform(0.1, 1.0, len(J))
    linear = replace(linear, softness=softness)
    soft = MarginalLikelihood(linear, noise, np.arange(n))
    found = soft.at(noise, REGULAR).smoothed()
    H[range(n), range(n)] += RIDGE
    by_force = J.T / softness
    direct = np.linalg.solve(H + by_force @ J, pull - by_force @ there.g)
    close(np.r_[found.theta, found.x.ravel()], direct)
    excess = there.g + J @ direct
    alike(found.multipliers, excess / softness)
