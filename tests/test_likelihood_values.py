"""The likelihood in numbers: what its program says, value by value."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.initialization.scaling import first_point
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

SIGMA = np.array([0.05, 0.2])


def duffing(*, per_trajectory: bool = False, sensors: bool = False) -> ph.Model:
    shown = {
        "q": ph.formula("offset + 0.1*q**2", offset=ph.Parameter(0.1)),
        "p": ph.formula("gain*p", gain=ph.Parameter(0.2, per_trajectory=True)),
    }
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(
            "k*q**2/2 + a*q**4/4 + p**2/2",
            k=ph.Parameter(1.2, lower=0.0, per_trajectory=per_trajectory),
            a=ph.Parameter(0.5),
        ),
        R={"p": ph.formula("c", c=ph.Parameter(0.2, upper=3.0))},
        F={"p": ph.formula("u*cos(t)")},
        inputs=["u"],
        sensor=shown if sensors else {},
    )


def measurements() -> ph.Measurements:
    """Three runs with inputs; some values are missing."""
    rng = np.random.default_rng(0)
    times = [np.cumsum(rng.uniform(0.05, 0.2, n)) for n in (9, 7, 5)]
    values = [rng.normal(size=(len(t), 2)) for t in times]
    values[0][3, 0] = np.nan
    values[1][2:5, 1] = np.nan
    inputs = [rng.normal(size=(len(t), 1)) for t in times]
    return ph.Measurements.from_arrays(
        times, values, inputs, states=["q", "p"], inputs=["u"]
    )


def laid_out(model: ph.Model, steps: int = 1) -> LikelihoodValues:
    data = measurements()
    grid = grid_of(data, steps)
    unknown = Theta.of(model, [run.name for run in data.trajectories])
    point = first_point(model, grid)
    point = replace(
        point,
        theta=unknown.spread(point.theta),
        theta_scale=unknown.spread(point.theta_scale),
    )
    return LikelihoodValues(model, grid, "srk4", point, unknown)


MODELS = {
    "plain": duffing(),
    "a parameter per trajectory": duffing(per_trajectory=True),
    "sensors": duffing(sensors=True),
    "both": duffing(per_trajectory=True, sensors=True),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("steps", [1, 2])
def test_values_and_slopes_are_those_of_the_program(name: str, steps: int) -> None:
    likelihood = laid_out(MODELS[name], steps)
    program = MaximumLikelihood().program(likelihood, {}, SIGMA)
    rng = np.random.default_rng(1)
    z = program.start + 0.1 * rng.normal(size=program.start.size)
    values = likelihood.at(z)
    in_z = [ca.jacobian(part, program.z) for part in (program.residual, program.g)]
    expected = ca.Function(
        "expected",
        [program.z, program.settings],
        [program.residual, program.g, *in_z],
    )
    residual, g, of_residual, of_g = (np.array(part) for part in expected(z, SIGMA))
    weights = np.sqrt(2 / len(residual)) / SIGMA[likelihood.grid.channel]

    def check(found: np.ndarray, wanted: np.ndarray) -> None:
        np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-12)

    check(weights * values.misfit, residual.ravel())
    check(values.g, g.ravel())
    everything = slice(0, len(z))
    check(likelihood.jacobian.part(everything).dense(values.jacobian), of_g)
    shown = likelihood.shown.part(everything).dense(values.slopes)
    check(-weights[:, None] * shown, of_residual)


def test_variables_begin_and_end_where_those_of_the_program_do() -> None:
    free = laid_out(duffing(per_trajectory=True))
    bounds = np.full((2, *free.point.x.shape), [[[-np.inf]], [[np.inf]]])
    bounds[0, 0] = -2.0
    bounds[1, 3] = 4.0
    point = replace(free.point, x_bounds=bounds)
    bounded = LikelihoodValues(free.model, free.grid, "srk4", point, free.unknown)
    for one in (free, bounded):
        program = MaximumLikelihood().program(one, {}, SIGMA)
        np.testing.assert_array_equal(one.point.scaled, program.start)
        np.testing.assert_array_equal(one.point.scale, program.scale)
        np.testing.assert_array_equal([one.lower, one.upper], program.bounds)
        unscaled = one.point.unscaled(program.start)
        for block, values in program.values(program.start).items():
            np.testing.assert_array_equal(unscaled[block], values)
