"""What the memory of an effect may begin with: such as the records show later on."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.transcription.augmented_states import (
    memory_start_bounds,
    with_memory,
)
from phsi_opt.transcription.grid import AlignedData, Grid

T = np.linspace(0.0, 4.0, 401)
LAG = 0.5
STEP = 2.0  # of the input, at the time 1


def pushed() -> ph.PseudoHamiltonian:
    """A mass pushed by an input, whose force lags behind it."""
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=1.5),
        F={"p": ph.formula("u")},
    )
    return model.add("input lag", "p").with_values({"lag_u_p": LAG})


def grid_of_inputs(model: ph.Model, *inputs: np.ndarray) -> Grid:
    """A record per input, its states of no account."""
    runs = [np.zeros((len(T), 2)) for _ in inputs]
    data = ph.Measurements.from_arrays(
        [T] * len(inputs),
        runs,
        [u[:, None] for u in inputs],
        states=["q", "p"],
        inputs=["u"],
        hold="linear",
    )
    return AlignedData.of(model, data).grid


def test_a_memory_begins_within_what_it_is_later_and_its_range_to_both_sides() -> None:
    model = pushed()
    grid = grid_of_inputs(model, np.where(T > 1.0, STEP, 0.0))
    x = np.zeros((grid.n_nodes, 3))
    bounds = memory_start_bounds(model, grid, x, model.theta)
    # At rest it is 0, at the end 2 (1 - exp(-3/0.5)).
    highest = STEP * (1 - np.exp(-3.0 / LAG))
    first = grid.first[0]
    assert bounds[0, first, 2] == pytest.approx(-highest, rel=1e-2)
    assert bounds[1, first, 2] == pytest.approx(2 * highest, rel=1e-2)


def test_other_states_and_later_nodes_have_no_bounds() -> None:
    model = pushed()
    grid = grid_of_inputs(model, np.sin(T), np.cos(T))
    bounds = memory_start_bounds(model, grid, np.zeros((grid.n_nodes, 3)), model.theta)
    is_bounded, is_bounded_above = np.isfinite(bounds)
    np.testing.assert_array_equal(is_bounded, is_bounded_above)
    expected = np.zeros_like(is_bounded)
    expected[grid.first, 2] = True
    np.testing.assert_array_equal(is_bounded, expected)


def test_the_records_share_what_their_memory_may_begin_with() -> None:
    model = pushed()
    grid = grid_of_inputs(model, np.full(len(T), -1.0), np.full(len(T), 3.0))
    bounds = memory_start_bounds(model, grid, np.zeros((grid.n_nodes, 3)), model.theta)
    np.testing.assert_allclose(bounds[0, grid.first, 2], -1.0 - 4.0, atol=1e-9)
    np.testing.assert_allclose(bounds[1, grid.first, 2], 3.0 + 4.0, atol=1e-9)


def test_a_memory_that_never_changes_may_begin_anywhere() -> None:
    model = pushed()
    grid = grid_of_inputs(model, np.full(len(T), 1.0))
    bounds = memory_start_bounds(model, grid, np.zeros((grid.n_nodes, 3)), model.theta)
    assert not np.isfinite(bounds).any()


def test_without_memory_there_are_no_bounds() -> None:
    bare = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.5)),
        F={"p": ph.formula("u")},
    )
    grid = grid_of_inputs(bare, np.sin(T))
    bounds = memory_start_bounds(bare, grid, np.zeros((len(T), 2)), bare.theta)
    assert not np.isfinite(bounds).any()


def test_the_fit_begins_within_these_bounds() -> None:
    # Of a lag shorter than a sample the first residual alone could tell the start.
    model = pushed()
    rng = np.random.default_rng(0)
    slow = T[::40]
    force = rng.normal(size=len(slow))
    moved = ph.simulate(model, slow, [0.5, 0.0, 0.0], u=force[:, None])
    shown = moved[:, :2] + 0.01 * rng.normal(size=(len(slow), 2))
    data = ph.Measurements.from_arrays(
        slow, shown, force[:, None], states=["q", "p"], inputs=["u"], hold="linear"
    )
    fit = ph.identify(model.with_values({"lag_u_p": 0.02}), data)
    began = fit.states[0][0, 2]
    span = np.ptp(force)
    assert force.min() - span <= began <= force.max() + span


def test_the_memory_of_a_lag_is_that_of_its_equation() -> None:
    model = pushed()
    grid = grid_of_inputs(model, np.sin(T))
    states = with_memory(model, grid, np.zeros((len(T), 2)), model.theta)
    # lag z' = sin(t) - z from z(0) = 0.
    gain = 1 / (1 + LAG**2)
    decay = LAG * gain * np.exp(-T / LAG)
    expected = gain * (np.sin(T) - LAG * np.cos(T)) + decay
    np.testing.assert_allclose(states[:, 2], expected, atol=1e-4)


def delayed(delay: float) -> tuple[ph.Model, ph.Measurements]:
    """A driven spring whose sensor is late, without a value for how late."""
    late = pushed_at_once().add("sensor delay", "q")
    rng = np.random.default_rng(3)
    times = np.linspace(0.0, 20.0, 201)
    force = np.interp(times, times[::10], rng.normal(size=len(times[::10])))
    known = late.with_values({"k": 1.5, "sensor_delay_q": delay})
    start = [0.5, 0.0, 0.5, 0.0, 0.0]
    x = ph.simulate(known, times, start, u=force[:, None])
    shown = known.output()(x.T, force[None, :], times[None, :], known.theta).full().T
    shown[:, 0] += 0.005 * rng.normal(size=len(times))
    shown[:, 1] = np.nan
    data = ph.Measurements.from_arrays(
        times,
        shown[:, :2],
        force[:, None],
        states=["q", "p"],
        inputs=["u"],
        hold="linear",
    )
    return late, data


def pushed_at_once() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0, lower=0.0)),
        F={"p": ph.formula("u")},
    )


@pytest.mark.parametrize("delay", [0.15, 0.4])
def test_a_sensor_that_is_late_is_found_without_a_value_to_start_from(
    delay: float,
) -> None:
    model, data = delayed(delay)
    fit = ph.identify(model, data)
    assert abs(fit.estimates["sensor_delay_q"] - delay) < 4 * max(
        fit.std_errors["sensor_delay_q"], 1e-3
    )
    assert abs(fit.estimates["k"] - 1.5) < 4 * max(fit.std_errors["k"], 1e-3)
