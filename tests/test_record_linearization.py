"""The linearised likelihood of a record, against finite differences and dense algebra."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.measurements import Measurements
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.defects import defects
from phsi_opt.transcription.elimination import REGULAR
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import outputs

SCHEME = "srk4"
RUNS = ("run 1", "run 2")


def spring(sensor: Mapping[str, Dictionary] | None = None) -> Model:
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
        F={"p": ph.formula("u")},
        sensor=sensor or {},
    )


def with_sensor() -> Model:
    """The position is shown with an offset of every trajectory's own, and a gain."""
    offset = ph.Parameter(0.3, per_trajectory=True)
    shown = ph.formula("g*q + c", g=ph.Parameter(0.2), c=offset)
    return spring(sensor={"q": shown})


def with_memory() -> Model:
    """The force acts late: three states more, which nobody measures."""
    model = spring()
    return model.add(effect_named(model, "input delay", "p"))


def grid_of_two_runs(model: Model) -> Grid:
    """Position measured everywhere but once, momentum nowhere in the second run."""
    rng = np.random.default_rng(0)
    times = [np.linspace(0, 2, 9), np.linspace(0, 1, 6)]
    states = [rng.normal(size=(len(t), 2)) for t in times]
    states[0][3, 0] = np.nan
    states[1][:, 1] = np.nan
    inputs = [rng.normal(size=(len(t), 1)) for t in times]
    data = Measurements.from_arrays(
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
        d = np.array(defects(self.at.model, grid, SCHEME, x.T, theta)).T
        return (d * grid.h[:, None] / self.at.point.x_scale).ravel()

    def residual(self, z: np.ndarray) -> np.ndarray:
        x, theta = self._split(z)
        grid = self.at.grid
        shown = np.array(outputs(self.at.model, grid, x.T, theta)).T
        return ((grid.y - shown) / self.sigma)[grid.measured]

    def _split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = self.at.point.unscaled(z)
        theta = values["theta"][self.at.unknown.table]
        return values["x"].reshape(self.at.grid.y.shape), theta

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
    squares = likelihood.standardized(there, sigma)
    dense = Dense(likelihood, sigma)
    np.testing.assert_allclose(there.g, dense.defects(z), atol=1e-10)
    np.testing.assert_allclose(squares.residual, dense.residual(z), atol=1e-10)
    C = likelihood.shown.filled(squares.slopes).toarray()
    J = likelihood.jacobian.filled(there.jacobian).toarray()
    # Central differences: the steps cut off 1e-10, and round at 1e-16/1e-5.
    np.testing.assert_allclose(C, -dense.slopes("residual", z), atol=1e-7)
    np.testing.assert_allclose(J, dense.slopes("defects", z), atol=1e-7)
    pull = C.T @ squares.residual
    np.testing.assert_allclose(-squares.gradient, pull, atol=1e-10)
    n, n_z = len(theta), len(z)
    H = C.T @ C
    H[range(n, n_z), range(n, n_z)] += REGULAR * np.max(np.diag(H)[n:])
    kkt = np.block([[H, J.T], [J, np.zeros((len(J), len(J)))]])
    reduced = likelihood.reduced(there, squares)
    inverse = np.linalg.inv(kkt)
    covariance = inverse[:n, :n]
    close = partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-8)
    close(reduced.information @ covariance, np.eye(n))
    step = reduced.solve(pull[n:], -there.g, covariance, pull[:n])
    expected = np.linalg.solve(kkt, np.r_[pull, -there.g])
    close(step.joined, expected[:n_z])
    multipliers = reduced.multipliers(pull[n:], covariance, pull[:n])
    alone = np.linalg.solve(kkt, np.r_[pull, np.zeros(len(J))])
    close(multipliers, alone[n_z:])
