"""Inputs that are smooth between their samples (`hold="cubic"`)."""

from itertools import pairwise

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.trajectory import SmoothInputs
from phsi_opt.simulation.simulate import free_run
from phsi_opt.transcription.grid import grid_of
from tests.pushed_mass import pushed_mass

MASS = 2.0
OMEGA = 6.0  # rad/s of the faster wave of the push; six samples a period
NOISE = 1e-4  # m


def push(t: np.ndarray) -> np.ndarray:
    return 3 * np.sin(OMEGA * t) + 2 * np.cos(OMEGA / 2 * t + 1)


def place(t: np.ndarray) -> np.ndarray:
    """Where a free mass is that the push moves from rest."""
    slow = OMEGA / 2
    fast_part = 3 / OMEGA * (t - np.sin(OMEGA * t) / OMEGA)
    turned = np.cos(1) - np.cos(slow * t + 1)
    slow_part = 2 / slow * (turned / slow - np.sin(1) * t)
    return np.asarray((fast_part + slow_part) / MASS)


def times(step: float = 0.17) -> np.ndarray:
    return np.arange(0.0, 6.4, step)


def record(hold: str) -> ph.Measurements:
    t = times()
    q = place(t) + NOISE * np.random.default_rng(0).normal(size=len(t))
    x = np.column_stack([q, np.full(len(t), np.nan)])
    return ph.Measurements.from_arrays(
        t, x, push(t), states=["q", "p"], inputs=["u"], hold=hold
    )


def test_between_and_beyond_the_samples() -> None:
    t = np.sort(np.random.default_rng(1).uniform(0, 5, 40))
    smooth = SmoothInputs(t, np.column_stack([t**3 - t, np.cos(t)]))
    at = np.linspace(t[0], t[-1], 7)
    np.testing.assert_allclose(smooth(at)[:, 0], at**3 - at, atol=1e-10)
    np.testing.assert_array_equal(smooth(np.array([-9.0, 99.0])), smooth(t[[0, -1]]))


def test_a_line_has_the_mean_and_the_first_moment_of_the_spline() -> None:
    t = np.array([0.0, 0.7, 1.0, 2.2, 3.0])
    smooth = SmoothInputs(t, np.exp(t)[:, None])
    begin, end = t[:-1], t[1:]
    first, last = smooth.lines(begin, end)
    s, weight = np.polynomial.legendre.leggauss(4)  # exact for these polynomials
    for k, (a, b) in enumerate(pairwise(t)):
        spline = smooth((a + b) / 2 + (b - a) / 2 * s)[:, 0]
        line = (first[k, 0] + last[k, 0]) / 2 + (last[k, 0] - first[k, 0]) / 2 * s
        np.testing.assert_allclose(weight @ spline, weight @ line, rtol=1e-12)
        np.testing.assert_allclose(weight @ (spline * s), weight @ (line * s))


@pytest.mark.parametrize("n_samples", [2, 3])
def test_few_samples_make_a_line_or_a_parabola(n_samples: int) -> None:
    t = np.arange(float(n_samples))
    first, last = SmoothInputs(t, t[:, None] ** 2).lines(t[:-1], t[1:])
    expected = 1 / 2 if n_samples == 2 else 1 / 3
    np.testing.assert_allclose((first[0, 0] + last[0, 0]) / 2, expected)


def test_simulate_free_run_and_closed_form_agree() -> None:
    t = times()
    u = push(t)[:, None]
    x = ph.simulate(pushed_mass(MASS), t, [0.0, 0.0], u, hold="cubic")
    y = free_run(pushed_mass(MASS), t, np.zeros(2), u, "cubic")
    np.testing.assert_allclose(y, x, atol=1e-6)
    lines = ph.simulate(pushed_mass(MASS), t, [0.0, 0.0], u)
    error = np.max(np.abs(x[:, 0] - place(t)))
    assert error < 0.2 * np.max(np.abs(lines[:, 0] - place(t)))


def test_the_mass_is_found_from_six_samples_a_period() -> None:
    model = pushed_mass(ph.Parameter(1.0, lower=0))
    smooth = ph.identify(model, record("cubic"))
    straight = ph.identify(model, record("linear"))
    assert smooth.values["m"] == pytest.approx(MASS, abs=3e-3)
    assert abs(straight.values["m"] - MASS) > 0.03
    assert smooth.noise["q"] < 0.1 * straight.noise["q"]
    assert ph.compare(smooth, record("cubic")).rmse < 3 * NOISE


@pytest.mark.parametrize("steps", [1, 3])
def test_nodes_between_samples_lie_on_the_spline(steps: int) -> None:
    data = record("cubic")
    grid = grid_of(data, steps)
    smooth = SmoothInputs(data.trajectories[0].t, data.trajectories[0].u)
    np.testing.assert_allclose(grid.u, smooth(grid.t))
    first, last = smooth.lines(grid.t[grid.begin], grid.t[grid.begin + 1])
    np.testing.assert_array_equal(grid.u0, first)
    np.testing.assert_array_equal(grid.u1, last)


def test_every_trajectory_has_its_own_spline() -> None:
    t = times()
    data = ph.Measurements.from_arrays(
        [t, t[:9]],
        [np.zeros((len(t), 1)), np.zeros((9, 1))],
        [push(t), -push(t[:9])],
        states=["q"],
        inputs=["u"],
        hold="cubic",
    )
    grid = grid_of(data)
    alone = grid_of(data["run 2"])
    np.testing.assert_array_equal(grid.u0[-8:], alone.u0)
    np.testing.assert_array_equal(grid.u1[-8:], alone.u1)


def test_a_model_without_inputs_takes_it() -> None:
    t = times()
    data = ph.Measurements.from_arrays(t, np.exp(-t), states=["a"], hold="cubic")
    assert grid_of(data).u0.shape == (len(t) - 1, 0)
    model = ph.FirstOrder(["a"], {"a": ph.formula("-k*a", k=ph.Parameter(0.5))})
    fit = ph.identify(model, data)
    assert fit.values["k"] == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(fit.simulate(t, [1.0])[:, 0], np.exp(-t), atol=1e-6)
