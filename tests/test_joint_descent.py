"""Gradient descent beside a force network, and with the test of significance."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import Descent, gradient_descent
from phsi_opt.sweeps.local_workers import one_thread
from problems.peers.joint_force import JointForce
from problems.thesis.joint_descent import _JointRun, joint_descent
from problems.thesis.systems import SYSTEMS

HENON = SYSTEMS["henon_heiles"]
FAST = Descent(learning_rate=1e-2, epochs=40, prune_every=10)


@pytest.fixture(autouse=True, scope="module")
def one_thread_of_torch() -> Iterator[None]:
    """Small tensors are slower with more threads."""
    with one_thread():
        yield


def driven() -> ph.FirstOrder:
    return ph.FirstOrder(
        ["q", "p"],
        {
            "q": ph.polynomials(["q", "p"], 2, constant=True),
            "p": ph.polynomials(["p", "t"], 3) + ph.formula("sin(q)*u"),
        },
        inputs=["u"],
        R=ph.damping("p"),
    )


def record() -> ph.Measurements:
    """Two irregular runs, two states, one input."""
    rng = np.random.default_rng(0)
    ts = [np.cumsum(rng.uniform(0.05, 0.2, n)) for n in (9, 6)]
    xs = [rng.normal(size=(len(t), 2)) for t in ts]
    us = [rng.normal(size=(len(t), 1)) for t in ts]
    return ph.Measurements.from_arrays(ts, xs, us, states=["q", "p"], inputs=["u"])


def test_the_gradient_of_a_neural_force_is_that_of_finite_differences() -> None:
    force = JointForce(("q", "p"), ("q", "u", "t"), hidden=(5, 4), penalty=0.3)
    run = _JointRun(driven(), record(), Descent(), 3, None, force)
    gradients = torch.autograd.grad(run.loss(run.tables), run.parameters)
    for parameter, gradient in zip(run.parameters, gradients, strict=True):
        values = parameter.detach().view(-1)  # writing here moves the parameter
        for i in range(0, len(values), 3):
            ends = []
            for shift in (1e-6, -1e-6):
                values[i] += shift
                ends.append(float(run.loss(run.tables).detach()))
                values[i] -= shift
            # Central differences: rounding of about 1e-16 / 1e-6 of the loss.
            slope = (ends[0] - ends[1]) / 2e-6
            assert float(gradient.view(-1)[i]) == pytest.approx(
                slope, rel=1e-5, abs=1e-6
            )


def test_significance_removes_what_the_size_keeps_of_noisy_data() -> None:
    data = HENON.data(0, noise=0.02, n=400)
    settings = replace(FAST, prune_every=5, threshold=0.05)
    by_size = gradient_descent(HENON.model(), data, settings)
    both = joint_descent(HENON.model(), data, settings, significance=0.01)
    assert set(HENON.truth) <= set(both.values) < set(by_size.values)
    assert len(both.values) <= len(HENON.truth) + 1
    first_half = both.history["n_terms"].iloc[: FAST.epochs // 2 - 1].tolist()
    assert first_half == by_size.history["n_terms"].iloc[: len(first_half)].tolist()
