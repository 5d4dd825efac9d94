"""PHNN and SSINN: derivatives, schemes against SciPy, recovery, records, refusals."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime

import phsi_opt as ph
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.transcription.grid import grid_of
from problems.peers.joint_force import JointForce
from problems.peers.phnn import PHNN, NetworkDescent, _Networks, phnn
from problems.peers.ssinn import SymplecticDescent, _Flow, separable, ssinn
from problems.peers.torch_steps import Steps
from problems.thesis.systems import SYSTEMS

SPRING = SYSTEMS["mass_spring"]
SMALL = NetworkDescent(
    epochs=4, hidden=(12, 12), force_hidden=(10,), learning_rate=5e-3
)


@pytest.fixture(autouse=True, scope="module")
def one_thread_of_torch() -> Iterator[None]:
    """Small tensors are slower with more threads."""
    with one_thread():
        yield


def data(n: int = 6) -> ph.Measurements:
    return SPRING.data(0, noise=0.0, n=n)


@pytest.fixture(scope="module")
def trained() -> PHNN:
    settings = NetworkDescent(
        epochs=10, hidden=(30, 30), force_hidden=(30, 30), learning_rate=5e-3
    )
    return phnn(
        data(12), ph.canonical(1), settings, damping=["p"], force=(["p"], ["t"])
    )


def test_the_gradient_of_the_loss_is_that_of_finite_differences() -> None:
    record = data(1)
    neural = JointForce(("p",), ("q", "t"), hidden=(4, 3))
    structured = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q"], 1)
    )
    settings = NetworkDescent(hidden=(5, 4, 3), dtype="float64")
    generator = torch.Generator().manual_seed(0)
    networks = _Networks(structured, ("p",), settings, neural, generator)
    steps = Steps(grid_of(record), "srk4", torch.float64)
    tables = steps.tables
    loss = networks.loss(steps, tables, 0.1)
    gradients = torch.autograd.grad(loss, networks.parameters, materialize_grads=True)
    for parameter, gradient in zip(networks.parameters, gradients, strict=True):
        values = parameter.detach().view(-1)  # writing here moves the parameter
        for i in range(0, len(values), 3):
            ends = []
            for shift in (1e-6, -1e-6):
                values[i] += shift
                ends.append(float(networks.loss(steps, tables, 0.1).detach()))
                values[i] -= shift
            # Central differences: rounding of about 1e-16 / 1e-6 of the loss.
            assert float(gradient.view(-1)[i]) == pytest.approx(
                (ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-7
            )


def test_the_efforts_are_the_gradient_of_the_energy(trained: PHNN) -> None:
    x = np.array([0.7, -1.2])
    slope = approx_fprime(x, lambda v: trained.energy(v)[0], 1e-7)
    np.testing.assert_allclose(
        trained.efforts(x)[0], slope, atol=1e-5
    )  # forward differences
    assert trained.energy(np.zeros(2)) == pytest.approx(0.0)


def test_without_force_and_damping_the_energy_is_kept() -> None:
    made = phnn(
        SYSTEMS["henon_heiles"].data(0, noise=0.0, n=60), ph.canonical(2), SMALL
    )
    x = made.simulate(np.linspace(0, 3, 31), [0.3, 0.0, 0.0, 0.3])
    assert np.ptp(made.energy(x)) < 1e-6  # the tolerance of SciPy's steps
    assert made.parameters.empty and not made.force(x).any()


def test_seeds_are_reproducible_to_the_bit_and_differ() -> None:
    one, again, other = (
        phnn(data(1), ph.canonical(1), SMALL, damping=["p"], seed=s) for s in (0, 0, 1)
    )
    assert one.loss_value == again.loss_value and one.damping == again.damping
    assert one.loss_value != other.loss_value


@pytest.mark.parametrize(("arguments", "message"), [
    ({"S": np.eye(2)}, "S is not skew-symmetric"),
    ({"damping": ["v"]}, "damping of 'v' is not a state"),
    ({"damping": ["p", "p"]}, "damping=.*only once"),
    ({"force": (["p"], ["v"])}, "variable 'v' of the neural force is unknown"),
    ({"force": ([], ["t"])}, "equations="),
])  # fmt: skip
def test_what_does_not_suit_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        phnn(data(1), **{"S": ph.canonical(1), "settings": SMALL, **arguments})


# ---- SSINN

HENON = SYSTEMS["henon_heiles"]
TRUTH = HENON.truth


def error_of_one_interval(h: float, steps: int) -> float:
    """Largest error of the scheme at the true coefficients over the interval h, against
    DOP853 at 1e-12.
    """
    model = separable(HENON.states, ["q1", "q2"], ["p1", "p2"], 3)
    theta = torch.tensor(
        [TRUTH.get(name, 0.0) for name in model.entries], dtype=torch.float64
    )
    flow = _Flow(
        model, ["q1", "q2"], ["p1", "p2"], SymplecticDescent(steps=steps), torch.float64
    )
    x0 = np.array([0.3, -0.2, 0.1, 0.25])
    x1 = HENON.solve(x0, np.array([0.0, h]))[-1]
    q0, p0, q1, p1 = (
        torch.tensor(v[None, :]) for v in (x0[:2], x0[2:], x1[:2], x1[2:])
    )
    tables = [p0, q0, q1, p1, torch.full((1, 1), h, dtype=torch.float64)]
    return float(flow.loss(theta, tables))


def test_the_scheme_is_of_fourth_order() -> None:
    errors = [error_of_one_interval(h, 1) for h in (0.1, 0.05)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(
        5, abs=0.4
    )  # one step: order plus one
    assert error_of_one_interval(0.1, 2) < errors[0] / 10


@pytest.fixture(scope="module")
def clean() -> Any:
    data = HENON.data(0, noise=0.0, n=300)
    return ssinn(
        data,
        ["q1", "q2"],
        ["p1", "p2"],
        3,
        SymplecticDescent(epochs=50, learning_rate=3e-2, steps=1),
    )


def test_clean_data_give_the_separable_energy(clean: Any) -> None:
    assert (
        max(abs(value - TRUTH.get(name, 0.0)) for name, value in clean.values.items())
        < 1e-3
    )  # 500 steps
    assert set(TRUTH) < set(clean.values)
    assert len(clean.values) == 18
    assert clean.history["loss"].iloc[-1] < 1e-3 * clean.history["loss"].iloc[0]
