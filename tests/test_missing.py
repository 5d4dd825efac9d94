"""The missing force: what a model lacks is found in positions alone, together with the
noise.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.data.noise import difference_noise
from phsi_opt.estimation.missing_force import ForceEstimate, estimate_force
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.parameter_vector import Point
from problems.examples.friction_spring import CSV

K, M, D, FRICTION, NOISE = 40.0, 2.5, 0.8, 3.0, 0.02
START = ([1.0, 0.0], [-0.8, 0.0], [0.6, 1.5])


def spring() -> ph.PseudoHamiltonian:
    model = ph.PseudoHamiltonian(
        states=("q", "p"),
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=K, m=M),
        R=ph.damping("p"),
    )
    return model.with_values({"R_p": D})


def rubbing_spring(t: np.ndarray, x0: list[float]) -> np.ndarray:
    def f(at: float, x: np.ndarray) -> list[float]:
        v = x[1] / M
        return [v, -K * x[0] - D * v - FRICTION * np.tanh(v / 1e-3)]

    return solve_ivp(
        f, (t[0], t[-1]), x0, "LSODA", t_eval=t, rtol=1e-8, atol=1e-9, max_step=0.02
    ).y.T


@pytest.fixture(scope="module")
def case() -> tuple[ForceEstimate, np.ndarray]:
    """Positions of a spring with Coulomb friction, seen through the model of a spring
    without; and the true states.
    """
    rng, t = np.random.default_rng(0), np.linspace(0.0, 4.0, 161)
    truth = [rubbing_spring(t, x0) for x0 in START]
    noisy = [
        np.column_stack(
            [x[:, 0] + NOISE * rng.normal(size=len(t)), np.full(len(t), np.nan)]
        )
        for x in truth
    ]
    data = ph.Measurements.from_arrays([t] * 3, noisy, states=["q", "p"])
    grid = grid_of(data)
    point = Point(
        np.array([D]), np.nan_to_num(grid.y), np.ones(1), np.array([0.5, 5.0])
    )
    sigma = np.array([difference_noise(data)[0], 1.0])
    return estimate_force(spring(), grid, point, sigma), np.concatenate(truth)


def test_hidden_friction_is_recovered_from_positions(
    case: tuple[ForceEstimate, np.ndarray],
) -> None:
    estimate, truth = case
    middle = (truth[estimate.grid.begin] + truth[estimate.grid.begin + 1]) / 2
    moving = np.abs(middle[:, 1]) > 0.3 * np.max(
        np.abs(middle[:, 1])
    )  # away from the reversals, where it jumps
    friction = -FRICTION * np.sign(middle[:, 1])
    # A force that jumps, seen through twice differentiated noise: the sign is sure, the
    # size is good to a half.
    assert np.mean(np.sign(estimate.w[moving, 0]) == np.sign(friction[moving])) > 0.95
    assert (
        np.sqrt(np.mean((estimate.w[moving, 0] - friction[moving]) ** 2))
        < 0.5 * FRICTION
    )


def test_the_hidden_momentum_is_recovered(
    case: tuple[ForceEstimate, np.ndarray],
) -> None:
    estimate, truth = case
    error = np.sqrt(np.mean((estimate.x - truth) ** 2, axis=0))
    assert error[0] < NOISE  # smoothing beats the single measurement
    assert error[1] < 0.1 * np.std(
        truth[:, 1]
    )  # the noise of 2 % of the amplitude costs a derivative


def test_the_noise_is_estimated_within_ten_per_cent(
    case: tuple[ForceEstimate, np.ndarray],
) -> None:
    # 483 values tell a standard deviation to 1/sqrt(966) = 3.2 %; ten per cent are
    # three of those.
    assert case[0].sigma[0] == pytest.approx(NOISE, rel=0.1)


def test_the_evidence_is_larger_for_the_right_size_of_the_force_than_for_far_ones(
    case: tuple[ForceEstimate, np.ndarray],
) -> None:
    estimate, _ = case
    assert 0.3 * FRICTION < estimate.size[0] < 3 * FRICTION  # of the friction's order
    likelihood = estimate.posterior.likelihood

    def evidence(factor: float) -> float:
        (force,) = estimate.disturbances.forces
        other = replace(force, size=factor * force.size)
        return likelihood.at(
            replace(estimate.disturbances, forces=(other,))
        ).log_evidence

    assert evidence(1.0) > max(evidence(0.2), evidence(5.0))


def test_nothing_is_missing_on_data_held_out_beside_a_sharp_corner() -> None:
    # A search from a generous force does not end beside it.
    data = ph.Measurements.from_csv(
        CSV, states={"q": "position_m", "p": None}, time="t_s", trajectory="run"
    )
    _, held_out = data.split(0.7)
    known = {"c": 0.836825, "f": 1.92092, "v0": 0.00493531}
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=39.9625, m=2.5),
        R={"p": ph.formula("c + f*(dH_dp**4 + v0**4)**(-0.25)", **known)},
    )
    compared = ph.compare(model, held_out)
    assert compared.rmse == pytest.approx(0.0427, abs=0.0005)
    force = compared.record.estimate.w
    assert np.sqrt(np.mean(force**2)) < 0.05  # N; the friction is 1.9 N
