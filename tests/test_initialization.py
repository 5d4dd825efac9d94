"""Where a solver begins: rough states, sizes, and formulas that have values."""

import cvxpy as cp
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.initialization.relative_guesses import fast_motion
from phsi_opt.initialization.scaling import kinematic_states
from phsi_opt.transcription.grid import Grid, grid_of
from tests import systems
from tests.systems import Number, pair, recorded

T = np.linspace(0.0, 20.0, 201)


def first_state(model: ph.Model, shown: np.ndarray, t: np.ndarray = T) -> Grid:
    """A record of the first state alone."""
    y = np.full((len(t), model.n_states), np.nan)
    y[:, 0] = shown
    data = ph.Measurements.from_arrays(t, y, states=list(model.states))
    return grid_of(data)


# ---- a start that is too fast for the samples ------------------------------------------


def spring_at(k: float | None, lower: float = 0.0, m: Number = 2.0) -> ph.Model:
    stiffness = ph.Parameter(k, lower=lower, unit="N/m")
    return systems.spring(stiffness, 0.3, m)


@pytest.fixture(scope="module")
def swing() -> ph.Measurements:
    """Two samples in 0.2 s: oscillations up to 5 Hz."""
    units = {"t": "s", "q": "m", "p": "kg m/s"}
    return recorded(spring_at(40.0), T, [1.0, 0.0], shown="q", units=units)


def test_a_motion_above_the_nyquist_frequency_is_told_before_all_else(swing) -> None:
    fit = ph.identify(spring_at(1e4, lower=5e3), swing, raise_on_failure=False)
    first, text = fit.caution, " ".join(str(fit).split())
    assert text.startswith(f"{first} Fit of ") and first == fit.warnings[0]
    k = fit.values["k"]
    hertz = np.sqrt(k / 2.0) / (2 * np.pi)
    told = f"k = {k:.4g} N/m let the model oscillate at {hertz:.3g} Hz"
    assert told in first and "limit, at 5 Hz" in first
    assert text.count("Nyquist") == 1 and "; see the first line" in text


def test_a_start_above_the_limit_is_not_told_of_a_fit_that_left_it(swing) -> None:
    start = spring_at(2100.0)
    assert fast_motion(start, grid_of(swing), swing.units)
    fit = ph.identify(start, swing)
    assert fit.values["k"] == pytest.approx(40.0, rel=0.02)
    assert not fit.caution and "Nyquist" not in str(fit)


# ---- states by kinematics ------------------------------------------------------------


def test_a_momentum_follows_from_the_rate_of_its_position() -> None:
    model = pair("1.7*q**2/2 + p**2/3", "0.15")
    x = ph.simulate(model, T, [1.0, 0.0])
    q = x[:, 0].copy()
    q[50:60] = np.nan  # a gap
    found, is_complete = kinematic_states(model, first_state(model, q))
    assert is_complete
    is_known = np.isfinite(q)
    np.testing.assert_array_equal(found[is_known, 0], q[is_known])
    inside = slice(70, 190)
    # Differences over two intervals of 0.1: the third derivative times h^2 / 6.
    np.testing.assert_allclose(found[inside, 1], x[inside, 1], atol=0.01)


# ---- formulas without values ---------------------------------------------------------


@pytest.mark.parametrize(("energy", "said"), [
    ("k*exp(1000*q) + p**2/(2*m)", "term .*exp.* in H .*at [0-9]+ of 100 samples"),
    ("k*log(q)+ p**2/(2*m)", "in H .*at 53 of 100 samples"),
    ("k*sqrt(q)+ p**2/(2*m)", "in H .*q = -0.0292"),
    ("k*q**2/2 + p**2/(2*zero)", "in H .*100 of 100 samples.*zero = 0"),
    ("k*q**2/2 + p**2/(2*m)", None),
])  # fmt: skip
def test_what_has_no_value_is_refused(energy: str, said: str | None) -> None:
    model = pair(energy, "0", k=ph.Parameter(1.0), m=1.0, zero=0.0)
    t = np.arange(0, 5, 0.05)
    x = np.column_stack([np.cos(2 * t), np.full(t.shape, np.nan)])
    data = ph.Measurements.from_arrays([t], [x], states=["q", "p"])
    if said is None:
        ph.identify(model, data, raise_on_failure=False)
        return
    with pytest.raises(ph.ModelError, match=f"(?s){said}"):
        ph.identify(model, data)


# ---- what a memory begins with


def spring(k: ph.Parameter | float = 1.5) -> ph.PseudoHamiltonian:
    return pair("k*q**2/2 + p**2/2", F="u", k=k)


@pytest.mark.parametrize("delay", [0.15, 0.4])
def test_a_sensor_that_is_late_is_found_without_a_value_to_start_from(delay) -> None:
    late = spring(ph.Parameter(1.0, lower=0.0)).add("sensor delay", "q")
    rng = np.random.default_rng(3)
    times = np.linspace(0.0, 20.0, 201)
    force = np.interp(times, times[::10], rng.normal(size=len(times[::10])))
    truth = {"k": 1.5, "sensor_delay_q": delay}
    known = late.with_values(truth)
    x = ph.simulate(known, times, [0.5, 0.0, 0.5, 0.0, 0.0], u=force[:, None])
    shown = known.output()(x.T, force[None, :], times[None, :], known.theta).full().T
    shown[:, 0] += 0.005 * rng.normal(size=len(times))
    shown[:, 1] = np.nan
    data = ph.Measurements.from_arrays(
        times, shown[:, :2], force[:, None], states=["q", "p"], inputs=["u"]
    )
    fit = ph.identify(late, data)
    for name, value in truth.items():
        allowed = 4 * max(fit.std_errors[name], 1e-3)
        assert fit.estimates[name] == pytest.approx(value, abs=allowed)


def test_a_start_needs_no_convex_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise cp.SolverError("no way")

    t = np.linspace(0, 10, 101)
    x = np.column_stack([np.cos(t), -np.sin(t)])
    data = ph.Measurements.from_arrays(t, x, states=["q", "p"])
    model = pair(ph.polynomials(["q", "p"], 2))
    expected = ph.identify(model, data, ph.PHSILoss(), l1=1e-4).estimates
    monkeypatch.setattr(cp.Problem, "solve", fails)
    found = ph.identify(model, data, ph.PHSILoss(), l1=1e-4).estimates
    assert list(found.values()) == pytest.approx(list(expected.values()), abs=1e-5)
