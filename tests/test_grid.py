"""The grid: which node is which, and defects whose derivatives are those of finite
differences.
"""

from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.model.model import FirstOrder, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import damping, formula, trigonometric
from phsi_opt.optimization.column_function import AT_ONCE
from phsi_opt.transcription.defects import (
    KnownDefects,
    between_samples,
    defect,
    defects,
)
from phsi_opt.transcription.grid import grid_of, steps_per_gap
from phsi_opt.transcription.integrators import INTEGRATORS


def data(hold: str = "linear") -> Measurements:
    """Two irregular runs with a gap, two states, one input."""
    rng = np.random.default_rng(0)
    ts = [np.cumsum(rng.uniform(0.05, 0.2, n)) for n in (6, 4)]
    xs = [rng.normal(size=(len(t), 2)) for t in ts]
    xs[0][2, 1] = np.nan
    us = [rng.normal(size=(len(t), 1)) for t in ts]
    return Measurements.from_arrays(
        ts, xs, us, states=["q", "p"], inputs=["u"], hold=hold
    )


def model() -> PseudoHamiltonian:
    made = PseudoHamiltonian(
        states=("q", "p"),
        inputs=("u",),
        S=canonical(1),
        R=damping("p"),
        H=formula(
            "k*q**2/2 + a*q**4 + p**2/(2*m)", k=Parameter(3.0), a=Parameter(0.4), m=1.5
        ),
        F={"p": formula("b*u", b=Parameter(0.9)) + trigonometric("t", frequency=2.0)},
    )
    values = {"R_p": 0.3, "F_p[sin(omega_t*t)]": 0.5, "F_p[cos(omega_t*t)]": -0.2}
    return made.with_values(values)


# ---- layout


def test_states_between_samples_follow_the_model_from_the_sample_before() -> None:
    runs = data()
    own = model()
    theta = own.theta
    grid = grid_of(runs, [np.full(5, 4), np.full(3, 4)])
    x = np.random.default_rng(1).normal(size=(10, 2))
    nodes = between_samples(own, grid, x, theta)
    assert np.array_equal(nodes[grid.sample], x)
    within = grid.intervals(np.flatnonzero(~grid.sample[grid.begin + 1]))
    left = np.array(defects(own, within, "srk4", nodes.T, theta))
    assert len(within.h) == 3 * 8
    assert np.max(np.abs(left)) < 1e-5  # of the scheme
    across = grid.intervals(np.flatnonzero(grid.sample[grid.begin + 1]))
    assert np.max(np.abs(np.array(defects(own, across, "srk4", nodes.T, theta)))) > 0.1


def test_states_that_would_run_away_between_samples_stay_where_they_were() -> None:
    runs = Measurements.from_arrays(
        [0.0, 1.0, 2.0], [[1.0], [2.0], [1.5]], states=["x"]
    )
    growing = FirstOrder(["x"], {"x": formula("a*x", a=Parameter(400.0))})
    grid = grid_of(runs, [np.full(2, 3)])
    nodes = between_samples(
        growing, grid, np.array([[1.0], [2.0], [1.5]]), np.r_[400.0]
    )
    assert nodes[:, 0].tolist() == [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1.5]


def test_measured_values_are_counted_once_and_by_their_state() -> None:
    grid = grid_of(data())
    assert grid.measured is grid.measured
    assert not grid.measured.flags.writeable
    assert grid.channel.tolist() == [0, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, *[0, 1] * 4]
    values = np.arange(len(grid.channel), dtype=float)
    expected = [np.sqrt(np.mean(values[grid.channel == k] ** 2)) for k in (0, 1)]
    np.testing.assert_allclose(grid.rms_by_channel(values), expected)


def test_steps_of_a_gap_are_counted_by_trajectory() -> None:
    steps = [np.array([1, 2, 1, 3, 1]), np.array([2, 1, 4])]
    found = steps_per_gap(grid_of(data(), steps))
    assert [of_run.tolist() for of_run in found] == [of.tolist() for of in steps]


@pytest.mark.parametrize("steps", [1, 2, 3, 7])
def test_every_sample_is_a_node_and_no_interval_leaves_its_trajectory(
    steps: int,
) -> None:
    record = data()
    grid = grid_of(record, steps)
    assert grid.n_nodes == (5 + 3) * steps + 2
    assert grid.n_intervals == (5 + 3) * steps
    np.testing.assert_array_equal(
        grid.y[grid.sample], np.concatenate([run.x for run in record.trajectories])
    )
    assert np.isnan(grid.y[~grid.sample]).all()
    # A node's time is left + fraction * step, which rounds once or twice.
    np.testing.assert_allclose(
        grid.t[grid.sample],
        np.concatenate([r.t for r in record.trajectories]),
        rtol=1e-15,
    )
    np.testing.assert_array_equal(
        grid.trajectory[grid.begin], grid.trajectory[grid.begin + 1]
    )
    np.testing.assert_array_equal(grid.h, grid.t[grid.begin + 1] - grid.t[grid.begin])
    np.testing.assert_array_equal(
        grid.t[grid.first], [run.t[0] for run in record.trajectories]
    )


@pytest.mark.parametrize("steps", [1, 3])
def test_a_linear_input_is_interpolated_between_the_samples(steps: int) -> None:
    record = data()
    grid = grid_of(record, steps)
    for k, run in enumerate(record.trajectories):
        node = grid.trajectory == k
        # Interpolation in another order of operations: rounding only.
        np.testing.assert_allclose(
            grid.u[node, 0], np.interp(grid.t[node], run.t, run.u[:, 0]), atol=1e-14
        )
    np.testing.assert_array_equal(grid.u0, grid.u[grid.begin])
    np.testing.assert_array_equal(grid.u1, grid.u[grid.begin + 1])


@pytest.mark.parametrize("steps", [1, 3])
def test_a_held_input_keeps_the_value_of_the_sample_before(steps: int) -> None:
    record = data("zero")
    grid = grid_of(record, steps)
    expected = np.concatenate(
        [np.repeat(run.u[:-1], steps, axis=0) for run in record.trajectories]
    )
    np.testing.assert_array_equal(grid.u0, expected)
    np.testing.assert_array_equal(grid.u1, expected)


def test_a_defect_is_named_by_trajectory_times_and_row() -> None:
    grid = grid_of(data(), 2)
    label = partial(grid.interval_label, 2)
    t = grid.t[grid.begin]
    assert label(0).startswith(f"trajectory 1, t = {t[0]:g} to ")
    assert label(0).endswith("row 1")
    assert label(2 * 10 + 1).startswith(f"trajectory 2, t = {t[10]:g} to ")
    assert label(2 * 10 + 1).endswith("row 2")
    assert label(2 * 15).startswith(f"trajectory 2, t = {t[15]:g} to ")


# ---- defects


def complete() -> tuple[Any, np.ndarray]:
    grid = grid_of(data())
    return grid, np.nan_to_num(grid.y)


@pytest.mark.parametrize("scheme", INTEGRATORS)
def test_the_jacobian_of_the_defects_is_that_of_finite_differences(scheme: str) -> None:
    made, (grid, x) = model(), complete()
    theta, step = made.theta, 1e-6
    jacobian = KnownDefects(made, grid, scheme, x).at(theta).slopes

    def flat(at: np.ndarray) -> np.ndarray:
        return np.array(defects(made, grid, scheme, x.T, at)).T.ravel()

    numeric = np.column_stack(
        [
            (flat(theta + e) - flat(theta - e)) / (2 * step)
            for e in step * np.eye(len(theta))
        ]
    )
    # Central differences: rounding of defects near 10 over the step, 1e-15 * 10 / 1e-6.
    np.testing.assert_allclose(jacobian, numeric, atol=1e-7)


@pytest.mark.parametrize("scheme", INTEGRATORS)
def test_all_defects_are_those_of_the_intervals_one_by_one(scheme: str) -> None:
    made, (grid, x) = model(), complete()
    theta, one = made.theta, defect(model(), scheme)
    together = np.array(defects(made, grid, scheme, x.T, theta)).T
    for k, i in enumerate(grid.begin):
        alone = np.array(
            one(x[i], x[i + 1], grid.t[i], grid.h[k], grid.u0[k], grid.u1[k], theta)
        ).ravel()
        np.testing.assert_array_equal(together[k], alone)


def test_chosen_columns_are_those_of_the_whole_jacobian() -> None:
    made, (grid, x) = model(), complete()
    whole = KnownDefects(made, grid, "srk4", x).at(made.theta).slopes
    some = KnownDefects(made, grid, "srk4", x, only=[4, 1]).at(made.theta).slopes
    np.testing.assert_allclose(
        some, whole[:, [4, 1]], rtol=1e-13
    )  # the same derivatives, perhaps reordered sums


def test_intervals_that_are_left_out_take_their_defects_with_them() -> None:
    made, (grid, x) = model(), complete()
    keep = np.array([0, 3, 6])
    fewer = np.array(defects(made, grid.intervals(keep), "rk4", x.T, made.theta))
    np.testing.assert_array_equal(
        fewer, np.array(defects(made, grid, "rk4", x.T, made.theta))[:, keep]
    )


@pytest.mark.parametrize("only", [None, [1]])
def test_defects_of_known_states_are_those_of_the_symbols(
    only: list[int] | None,
) -> None:
    start = Parameter(0.5)
    model = FirstOrder(["x"], F={"x": formula("-a*x + b*x**3", a=start, b=start)})
    rng = np.random.default_rng(1)
    t = np.cumsum(0.1 + 0.05 * rng.random(AT_ONCE + 7))
    record = Measurements.from_arrays([t], [rng.normal(size=(len(t), 1))], states=["x"])
    grid = grid_of(record)
    theta = np.array([0.4, 0.3])
    found = KnownDefects(model, grid, "srk4", only=only).at(theta)
    d = defects(model, grid, "srk4", ca.DM(grid.y.T), theta)
    symbol = ca.SX.sym("theta", 2)
    in_symbols = ca.vec(defects(model, grid, "srk4", ca.DM(grid.y.T), symbol))
    slopes = ca.Function("J", [symbol], [ca.jacobian(in_symbols, symbol)])(theta)
    slopes = np.array(slopes)[:, [0, 1] if only is None else only]
    np.testing.assert_allclose(found.d, np.array(d).T, rtol=1e-13)
    np.testing.assert_allclose(found.slopes, np.array(slopes), rtol=1e-12)
