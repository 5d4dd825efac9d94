"""Other methods on the same data: SINDy, LASSO, PHNN, SSINN, and descent beside a network."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

pytest.importorskip("pysindy", reason="needs the extra 'peers'")
import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import Descent, gradient_descent
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.transcription.grid import grid_of
from problems.peers.joint_force import JointForce
from problems.peers.phnn import NetworkDescent, _Networks, phnn
from problems.peers.sindy import lasso, regressions, sindy
from problems.peers.ssinn import SymplecticDescent, _Flow, separable
from problems.peers.torch_networks import parameters_of
from problems.peers.torch_steps import Steps
from problems.thesis.joint_descent import _JointRun, joint_descent
from problems.thesis.systems import SYSTEMS

HENON = SYSTEMS["henon_heiles"]
SHORT = replace(HENON, n_trajectories=50, n_steps=20, step=0.02)
TRUTH = SHORT.truth_first_order
each_optimizer = pytest.mark.parametrize("optimizer", ["stlsq", "sr3"])


@pytest.fixture(autouse=True, scope="module")
def one_thread_of_torch() -> Iterator[None]:
    """Small tensors are slower with more threads."""
    with one_thread():
        yield


# ---- SINDy and LASSO


@cache
def henon_heiles(noise: float = 0.0) -> ph.Measurements:
    return SHORT.data(seed=1, noise=noise)


@each_optimizer
def test_clean_data_give_the_support_and_the_coefficients(optimizer: str) -> None:
    found = sindy(SHORT.first_order(), henon_heiles(), optimizer, 0.2)
    assert set(found.removed) == set(SHORT.first_order().entries) - set(TRUTH)
    # (h omega)^2/12 with h = 0.02 and omega of about 1 is 3e-5 in the midpoint, (h
    # omega)^2/6 to /3 in the differences.
    assert found.values == pytest.approx(TRUTH, rel=5e-4)


@each_optimizer
def test_without_threshold_and_ridge_it_is_plain_least_squares(optimizer: str) -> None:
    model, data = SHORT.first_order(), henon_heiles(noise=0.01)
    found = sindy(model, data, optimizer, threshold=0.0, ridge=0.0)
    loss = 0.0
    for problem in regressions(model, data):
        expected, squares, *_ = np.linalg.lstsq(problem.columns, problem.rates)
        ours = [found.values[name] for name in problem.names]
        # Two solvers of the same squares: rounding times a condition number of 100.
        np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-11)
        loss += squares[0] / len(problem.rates)
    assert found.loss_value == pytest.approx(loss, rel=1e-9)


def test_the_columns_are_the_terms_at_the_middle_of_each_interval() -> None:
    terms = ph.polynomials(["x", "t"], 2) + ph.formula("b*u + 3*x", b=ph.Parameter())
    model = ph.FirstOrder(["x"], {"x": terms}, ["u"])
    t, x, u = np.array([0.0, 1.0, 3.0]), [1.0, 3.0, 2.0], [0.0, 4.0, 2.0]
    for hold, inputs in (("linear", [2.0, 3.0]), ("zero", [0.0, 4.0])):
        # Two intervals are too few for six terms, so the record is given three times.
        data = ph.Measurements.from_arrays(
            [t] * 3, [x] * 3, [u] * 3, states=["x"], inputs=["u"], hold=hold
        )
        (problem,) = regressions(model, data)
        columns = dict(zip(problem.names, problem.columns[:2].T, strict=True))
        np.testing.assert_allclose(columns["F_x[x*t]"], [2.0 * 0.5, 2.5 * 2.0])
        np.testing.assert_allclose(columns["b"], inputs)
        known = np.array([3 * 2.0, 3 * 2.5])  # of 3*x, which is taken off
        np.testing.assert_allclose(problem.rates[:2], np.array([2.0, -0.5]) - known)


@pytest.mark.parametrize("weight", [0.3, 3.0, 30.0])
def test_the_lasso_satisfies_its_optimality_conditions(weight: float) -> None:
    """2 Theta'(Theta xi - dx) is -weight sign(xi), and at most weight where xi is 0."""
    model, data = SHORT.first_order(), henon_heiles(noise=0.005)
    found = lasso(model, data, weight)
    zeros = 0
    for problem in regressions(model, data):
        xi = np.array([found.values.get(name, 0.0) for name in problem.names])
        slope = 2 * problem.columns.T @ (problem.columns @ xi - problem.rates)
        expected = -weight * np.sign(xi[xi != 0])
        # A coefficient set to zero moves the slope by 1e-6 of it.
        np.testing.assert_allclose(slope[xi != 0], expected, rtol=1e-4)
        assert np.all(np.abs(slope[xi == 0]) <= weight * (1 + 1e-4))
        zeros += int(np.sum(xi == 0))
    assert zeros == len(found.removed) > 0


# ---- networks


def assert_gradient(
    loss: Callable[[], torch.Tensor], parameters: Sequence[torch.Tensor]
) -> None:
    """Of every third value it is that of central differences."""
    gradients = torch.autograd.grad(loss(), parameters, materialize_grads=True)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        values = parameter.detach().view(-1)  # writing here moves the parameter
        for i in range(0, len(values), 3):
            ends = []
            for shift in (1e-6, -1e-6):
                values[i] += shift
                ends.append(float(loss().detach()))
                values[i] -= shift
            # Rounding of about 1e-16 / 1e-6 of the loss.
            slope = pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-6)
            assert float(gradient.view(-1)[i]) == slope


def test_the_gradient_of_a_hamiltonian_network_is_that_of_differences() -> None:
    structured = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q"], 1)
    )
    neural = JointForce(("p",), ("q", "t"), hidden=(4, 3))
    settings = NetworkDescent(hidden=(5, 4, 3), dtype="float64")
    generator = torch.Generator().manual_seed(0)
    networks = _Networks(structured, ("p",), settings, neural, generator)
    record = SYSTEMS["mass_spring"].data(0, noise=0.0, n=1)
    steps = Steps(grid_of(record), "srk4", torch.float64)
    assert_gradient(
        lambda: networks.loss(steps, steps.tables, 0.1), networks.parameters
    )


def test_the_gradient_beside_a_neural_force_is_that_of_differences() -> None:
    rates = {
        "q": ph.polynomials(["q", "p"], 2, constant=True),
        "p": ph.polynomials(["p", "t"], 3) + ph.formula("sin(q)*u"),
    }
    model = ph.FirstOrder(["q", "p"], rates, inputs=["u"], R=ph.damping("p"))
    rng = np.random.default_rng(0)
    ts = [np.cumsum(rng.uniform(0.05, 0.2, n)) for n in (9, 6)]
    xs, us = ([rng.normal(size=(len(t), k)) for t in ts] for k in (2, 1))
    data = ph.Measurements.from_arrays(ts, xs, us, states=["q", "p"], inputs=["u"])
    force = JointForce(("q", "p"), ("q", "u", "t"), hidden=(5, 4), penalty=0.3)
    run = _JointRun(model, data, Descent(), 3, None, force)
    trained = [run.theta, *parameters_of(run.layers)]
    assert_gradient(lambda: run.loss(run.tables), trained)


def test_without_force_and_damping_a_network_keeps_its_energy() -> None:
    settings = NetworkDescent(epochs=4, hidden=(12, 12), learning_rate=5e-3)
    made = phnn(HENON.data(0, noise=0.0, n=60), ph.canonical(2), settings)
    x = made.simulate(np.linspace(0, 3, 31), [0.3, 0.0, 0.0, 0.3])
    assert np.ptp(made.energy(x)) < 1e-6  # the tolerance of SciPy's steps
    assert not made.damping and not made.force(x).any()


def error_of_one_interval(h: float, steps: int) -> float:
    """Of the symplectic scheme at the true coefficients, against DOP853 at 1e-12."""
    q, p = ["q1", "q2"], ["p1", "p2"]
    model = separable(HENON.states, q, p, 3)
    values = [HENON.truth.get(name, 0.0) for name in model.entries]
    flow = _Flow(model, q, p, SymplecticDescent(steps=steps), torch.float64)
    x0 = np.array([0.3, -0.2, 0.1, 0.25])
    x1 = HENON.solve(x0, np.array([0.0, h]))[-1]
    columns = [torch.tensor(x[None, :]) for x in (x0[2:], x0[:2], x1[:2], x1[2:])]
    length = torch.full((1, 1), h, dtype=torch.float64)
    return float(
        flow.loss(torch.tensor(values, dtype=torch.float64), [*columns, length])
    )


def test_the_symplectic_scheme_is_of_fourth_order() -> None:
    errors = [error_of_one_interval(h, 1) for h in (0.1, 0.05)]
    # One step: order plus one.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(5, abs=0.4)
    assert error_of_one_interval(0.1, 2) < errors[0] / 10


def test_significance_removes_what_the_size_keeps_of_noisy_data() -> None:
    data = HENON.data(0, noise=0.02, n=400)
    settings = Descent(learning_rate=1e-2, epochs=40, prune_every=5, threshold=0.05)
    by_size = gradient_descent(HENON.model(), data, settings)
    both = joint_descent(HENON.model(), data, settings, significance=0.01)
    assert set(HENON.truth) <= set(both.values) < set(by_size.values)
    assert len(both.values) <= len(HENON.truth) + 1
