"""Measurements in the order of the model and laid out; defects and one-step schemes."""

from functools import partial
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.transcription.defects import (
    between_samples,
)
from phsi_opt.transcription.grid import AlignedData, aligned, grid_of
from phsi_opt.transcription.integrators import INTEGRATORS, Integrator


def data(hold: str = "linear") -> ph.Measurements:
    """Two irregular runs with a gap, two states, one input."""
    rng = np.random.default_rng(0)
    ts = [np.cumsum(rng.uniform(0.05, 0.2, n)) for n in (6, 4)]
    xs = [rng.normal(size=(len(t), 2)) for t in ts]
    xs[0][2, 1] = np.nan
    us = [rng.normal(size=(len(t), 1)) for t in ts]
    return ph.Measurements.from_arrays(
        ts, xs, us, states=["q", "p"], inputs=["u"], hold=hold
    )


def model() -> ph.PseudoHamiltonian:
    energy = "k*q**2/2 + a*q**4 + p**2/(2*m)"
    made = ph.PseudoHamiltonian(
        states=("q", "p"),
        inputs=("u",),
        S=ph.canonical(1),
        R=ph.damping("p"),
        H=ph.formula(energy, k=ph.Parameter(3.0), a=ph.Parameter(0.4), m=1.5),
        F={
            "p": ph.formula("b*u", b=ph.Parameter(0.9))
            + ph.trigonometric("t", frequency=2.0)
        },
    )
    values = {"R_p": 0.3, "F_p[sin(omega_t*t)]": 0.5, "F_p[cos(omega_t*t)]": -0.2}
    return made.with_values(values)


# ---- layout


def test_a_defect_is_named_by_trajectory_times_and_row() -> None:
    grid = grid_of(data(), 2)
    label = partial(grid.interval_label, 2)
    t = grid.t[grid.begin]
    assert label(0).startswith(f"trajectory 1, t = {t[0]:g} to ")
    assert label(0).endswith("row 1")
    assert label(2 * 10 + 1).startswith(f"trajectory 2, t = {t[10]:g} to ")
    assert label(2 * 10 + 1).endswith("row 2")


# ---- the model's order

T, X, U = (
    np.arange(6.0),
    np.arange(12.0).reshape(6, 2),
    np.arange(12.0, 24).reshape(6, 2),
)


def record(states: str, inputs: str = "", **options: Any) -> ph.Measurements:
    x, u = X[:, : len(states)], U[:, : len(inputs)]
    options |= {"states": list(states), "inputs": list(inputs)}
    return ph.Measurements.from_arrays(T, x, u if inputs else None, **options)


def bare(inputs: str = "") -> ph.PseudoHamiltonian:
    energy = ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0))
    return ph.PseudoHamiltonian(
        states=("q", "p"), inputs=list(inputs), S=ph.canonical(1), H=energy
    )


def test_columns_and_units_follow_the_names_of_states_and_inputs() -> None:
    same = record("qp")
    assert aligned(bare(), same) is same
    run = aligned(bare("uv"), record("pq", "vu")).trajectories[0]
    np.testing.assert_array_equal(run.x, X[:, ::-1])
    np.testing.assert_array_equal(run.u, U[:, ::-1])
    units = {"t": "s", "q": "m", "p": "kg m/s", "v": "V", "w": "A"}
    fewer = aligned(bare("v"), record("pq", "wv", units=units))
    assert fewer.inputs == ("v",)
    assert fewer.units == {"t": "s", "q": "m", "p": "kg m/s", "v": "V"}
    np.testing.assert_array_equal(fewer.trajectories[0].u, U[:, 1:])


def test_an_input_that_the_model_does_not_have_is_noted() -> None:
    t = np.linspace(0.0, 1.0, 11)
    u = np.column_stack([np.sin(t), np.cos(t)])
    data = ph.Measurements.from_arrays(t, t, u, states=["T"], inputs=["P", "Ta"])
    for inputs, noted in ((["P"], ["input Ta was measured"]), (["P", "Ta"], [])):
        heated = ph.FirstOrder(["T"], {"T": "P/C"}, inputs=inputs)
        notes = AlignedData.of(heated, data).notes
        assert [note[:21] for note in notes] == noted


def test_the_memory_of_an_effect_is_added_as_never_measured() -> None:
    larger = bare().add("hysteresis", "p")
    extended = aligned(larger, record("qp"))
    assert extended.states == larger.states
    assert np.isnan(extended.trajectories[0].x[:, 2:]).all()
    assert aligned(larger, extended) is extended


def test_a_momentum_is_added_as_never_measured_where_its_position_is() -> None:
    extended = aligned(bare(), record("q"))
    assert extended.states == ("q", "p") and extended.measured == ("q",)
    with pytest.raises(ph.DataError, match="state 'v' of the measurements is not"):
        aligned(bare(), record("qv"))


ONLY_Q = ph.FirstOrder(("q",), {"q": "-q"})


@pytest.mark.parametrize(("model", "measured", "error", "message"), [
    (
        bare(),
        record("p"),
        ph.DataError,
        r"state 'q' of the model is not in the measurements \(p\); declare it as "
        r"not measured: states=\{\.\.\., 'q': None\}",
    ),
    (bare(), record("pz"), ph.DataError, r"state 'q' .* measurements \(p, z\)"),
    (bare("u"), record("qp", "vw"), ph.DataError, r"input 'u' of the model is not in the measurements \(v, w\)"),
    (ONLY_Q, record("qp"), ph.DataError, "state 'p' of the measurements is not in the model; leave"),
    ("spring", record("qp"), ph.ModelError, "model='spring' .* is a PseudoHamiltonian or a FirstOrder"),
    (bare(), "a.csv", ph.DataError, r"data='a\.csv' .* expected Measurements. Create these with from_csv"),
])  # fmt: skip
def test_what_does_not_match_is_named(model, measured, error, message) -> None:
    with pytest.raises(error, match=f"^{message}"):
        AlignedData.of(model, measured)


# ---- one-step schemes

SCHEMES = list(INTEGRATORS.values())
each_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=[s.name for s in SCHEMES])


def pendulum(t: float, x: np.ndarray) -> np.ndarray:
    """A driven, damped pendulum: nonlinear and dependent on the time."""
    return np.array([x[1], -np.sin(x[0]) - 0.3 * x[1] ** 3 + 0.5 * np.cos(1.3 * t)])


def logistic(t: float, x: np.ndarray) -> np.ndarray:
    """dx/dt = -2 t x^2 with the exact solution x = 1 / (1 + t^2)."""
    return -2 * t * x**2


def logistic_solution(t: float) -> np.ndarray:
    return np.array([1 / (1 + t**2)])


def size_of_defect(
    scheme: Integrator, f: Any, t0: float, h: float, x0: np.ndarray, x1: np.ndarray
) -> float:
    psi = scheme.psi(lambda x, c: f(t0 + c * h, x), x0, x1, h)
    return float(np.max(np.abs((x1 - x0) / h - psi)))


@each_scheme
def test_the_defect_of_an_exact_solution_shrinks_with_the_claimed_order(scheme) -> None:
    sizes = []
    for h in (0.1 / 4, 0.1 / 8):
        ends = logistic_solution(0.5), logistic_solution(0.5 + h)
        sizes.append(size_of_defect(scheme, logistic, 0.5, h, *ends))
    # The next term of the expansion moves the observed order by O(h); at these steps
    # that is less than 0.25.
    assert np.log2(sizes[0] / sizes[1]) == pytest.approx(scheme.order, abs=0.25)


@each_scheme
def test_a_scheme_is_symmetric_exactly_where_it_says_so(scheme: Integrator) -> None:
    rng = np.random.default_rng(0)
    x0, x1, t0, h = rng.normal(size=2), rng.normal(size=2), 0.3, 0.4

    def forward(x: np.ndarray, c: float) -> np.ndarray:
        return pendulum(t0 + c * h, x)

    def backward(x: np.ndarray, c: float) -> np.ndarray:
        return pendulum(t0 + h - c * h, x)

    difference = np.max(
        np.abs(scheme.psi(forward, x0, x1, h) - scheme.psi(backward, x1, x0, -h))
    )
    # Rounding of a handful of operations on numbers near one; an asymmetric scheme
    # differs by O(h).
    assert (difference < 1e-14) == scheme.symmetric
    assert scheme.symmetric or difference > 1e-3


def test_states_that_would_run_away_between_samples_stay_where_they_were() -> None:
    x = np.array([[1.0], [2.0], [1.5]])
    runs = ph.Measurements.from_arrays([0.0, 1.0, 2.0], x, states=["x"])
    growing = ph.FirstOrder(["x"], {"x": ph.formula("a*x", a=ph.Parameter(400.0))})
    nodes = between_samples(growing, grid_of(runs, [np.full(2, 3)]), x, np.r_[400.0])
    assert nodes[:, 0].tolist() == [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1.5]
