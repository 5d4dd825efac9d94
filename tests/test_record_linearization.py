"""The linearised likelihood of a record, against finite differences and dense algebra."""

from collections.abc import Mapping

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.measurements import Measurements
from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary
from phsi_opt.screening.pair_search import JointRegression
from phsi_opt.transcription.defects import defects
from phsi_opt.transcription.elimination import Step
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.record_linearization import RecordLinearization
from phsi_opt.transcription.sensors import outputs

SCHEME = "srk4"
SIGMA = np.array([0.1, 0.2])
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


def grid_of_two_runs() -> Grid:
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
    return grid_of(data)


class Dense:
    """Weighted residuals and defects of a model, their slopes by differences."""

    def __init__(self, model: Model, grid: Grid, unknown: Theta) -> None:
        self.model = model
        self.grid = grid
        self.unknown = unknown
        self.weight = np.where(grid.measured, 1 / SIGMA, 0.0)

    def defects(self, z: np.ndarray) -> np.ndarray:
        x, theta = self._split(z)
        return np.array(defects(self.model, self.grid, SCHEME, x.T, theta)).T.ravel()

    def residual(self, z: np.ndarray) -> np.ndarray:
        x, theta = self._split(z)
        shown = np.array(outputs(self.model, self.grid, x.T, theta)).T
        left = np.where(self.grid.measured, self.grid.y - shown, 0.0)
        return (self.weight * left).ravel()

    def _split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = len(self.unknown)
        return z[n:].reshape(self.grid.y.shape), z[:n][self.unknown.table]

    def slopes(self, name: str, z: np.ndarray) -> np.ndarray:
        function, step = getattr(self, name), 1e-5
        columns = []
        for direction in step * np.eye(len(z)):
            change = function(z + direction) - function(z - direction)
            columns.append(change / (2 * step))
        return np.array(columns).T


@pytest.mark.parametrize("model", [spring(), with_sensor()], ids=["plain", "sensor"])
def test_the_band_that_is_filled_is_the_likelihood_linearised(model: Model) -> None:
    grid = grid_of_two_runs()
    unknown = Theta.of(model, RUNS)
    rng = np.random.default_rng(1)
    linearization = RecordLinearization(unknown, grid, SCHEME, SIGMA)
    linearization.at(rng.normal(size=grid.y.shape), rng.uniform(1, 2, len(unknown)))
    x = rng.normal(size=grid.y.shape)  # what another point left is written over
    theta = rng.uniform(1, 2, len(unknown))
    point = linearization.at(x, theta)
    scale = np.r_[point.scale, np.ones(x.size)]
    z = np.r_[theta, x.ravel()]
    dense = Dense(model, grid, unknown)
    C = -dense.slopes("residual", z) * scale
    J = dense.slopes("defects", z) * scale
    np.testing.assert_allclose(point.defects, dense.defects(z), atol=1e-10)
    np.testing.assert_allclose(point.outputs.residual, dense.residual(z), atol=1e-10)
    n = len(unknown)
    squares = np.sum(C[:, :n] ** 2, axis=0) + np.sum(J[:, :n] ** 2, axis=0)
    np.testing.assert_allclose(squares, 1.0, rtol=1e-6)
    some = rng.normal(size=(len(z), 2))
    of_some = point.outputs.change(Step(some[:n], some[n:]))
    np.testing.assert_allclose(of_some, C @ some, atol=1e-7)
    back = point.outputs.gradient(of_some)
    np.testing.assert_allclose(back.joined, C.T @ of_some, atol=1e-6)
    # The least squares with dynamics hard: by a basis of what obeys them.
    kkt = np.block([[C.T @ C, J.T], [J, np.zeros((len(J), len(J)))]])
    kkt[range(len(z)), range(len(z))] += np.r_[np.zeros(n), np.full(x.size, 1e-9)]
    inverse = np.linalg.inv(kkt)
    covariance = np.linalg.inv(point.reduced.information)
    np.testing.assert_allclose(covariance, inverse[:n, :n], rtol=1e-3, atol=1e-8)
    gradient = point.outputs.gradient(point.outputs.residual)
    step = point.reduced.solve(gradient.x, -point.defects, covariance, gradient.theta)
    right = np.r_[C.T @ dense.residual(z), -dense.defects(z)]
    expected = (inverse @ right)[: len(z)]
    np.testing.assert_allclose(step.joined, expected, rtol=1e-3, atol=1e-5)


def joint(bounds: np.ndarray, n_of: list[int]) -> tuple[JointRegression, np.ndarray]:
    """Random traces of points with these numbers of columns, and the residual."""
    rng = np.random.default_rng(2)
    traces = rng.normal(size=(50, sum(n_of)))
    residual = traces @ rng.normal(size=sum(n_of)) + rng.normal(size=50)
    size = np.linalg.norm(traces, axis=0)
    columns = traces / size
    regression = JointRegression(
        size=size,
        gram=columns.T @ columns,
        right=columns.T @ residual,
        bounds=bounds * size[:, None],
        edges=np.cumsum([0, *n_of]),
    )
    return regression, np.column_stack([traces, residual])


def test_what_two_points_explain_is_what_their_regression_explains() -> None:
    n_of = [1, 2, 1, 3]
    free = np.tile([-np.inf, np.inf], (sum(n_of), 1))
    regression, table = joint(free, n_of)
    a, b = np.triu_indices(4, k=1)
    drops = regression.drops(a, b)
    for i, j, drop in zip(a, b, drops, strict=True):
        of_both = [*range(*regression.edges[i : i + 2])]
        of_both += range(*regression.edges[j : j + 2])
        traces, residual = table[:, of_both], table[:, -1]
        c = np.linalg.lstsq(traces, residual, rcond=None)[0]
        left = residual - traces @ c
        assert drop == pytest.approx(residual @ residual - left @ left, rel=1e-9)
        found = np.concatenate(regression.coefficients(int(i), int(j)))
        np.testing.assert_allclose(found, c, rtol=1e-9)


def test_a_point_whose_coefficient_is_held_at_zero_makes_no_pair() -> None:
    least = np.array([[-np.inf, np.inf], [0.0, 0.0], [1.0, 1.0]])
    regression, table = joint(least, [1, 1, 1])
    drops = regression.drops(np.array([0, 0, 1]), np.array([1, 2, 2]))
    assert drops[0] == 0
    assert drops[2] == 0
    # The third is there as a whole; the first makes the best of it.
    first, third, residual = table[:, 0], table[:, 2], table[:, -1]
    c = first @ (residual - third) / (first @ first)
    left = residual - third - c * first
    assert drops[1] == pytest.approx(residual @ residual - left @ left, rel=1e-9)
