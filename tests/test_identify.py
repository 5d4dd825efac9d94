"""What `identify` promises: the truth within its own standard errors, whatever the
units, the same on every run.
"""

import pickle
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation import likelihood_estimate
from phsi_opt.model_error.standard_errors import (
    StandardErrors,
    standard_errors,
)
from tests import systems
from tests.systems import Number, pair, positive, recorded

K, M, D = 40.0, 2.5, 0.8  # N/m, kg, kg/s
T = np.linspace(0.0, 4.0, 161)


def spring(k: Number | None = None, m: Number = M) -> ph.PseudoHamiltonian:
    return systems.spring(k or positive(30.0), m=m)


TRUTH = spring(K).with_values({"R_p": D})


def positions_only(
    seed: int = 0, scale: float = 1.0, missing: int = 0, unit: str = "m"
) -> ph.Measurements:
    """Two free decays of the damped spring, of which only the noisy position was
    recorded.
    """
    rng = np.random.default_rng(seed)
    xs = []
    for x0 in ([1.0, 0.0], [-0.5, 3.0]):
        q = ph.simulate(TRUTH, T, x0)[:, 0] + 0.01 * rng.normal(size=len(T))
        q[rng.choice(np.arange(1, len(T)), missing, replace=False)] = np.nan
        xs.append(np.column_stack([scale * q, np.full(len(T), np.nan)]))
    units = {"q": unit, "t": "s"}
    return ph.Measurements.from_arrays([T, T], xs, states=["q", "p"], units=units)


@pytest.fixture(scope="module")
def position_fit() -> ph.Fit:
    return ph.identify(spring(), positions_only())


def largest_deviation(fit: ph.Fit) -> float:
    """Of stiffness and damping, in standard errors."""
    truth = {"k": K, "R_p": D}
    return max(abs(fit.values[n] - v) / fit.std_errors[n] for n, v in truth.items())


# ---- recovery ------------------------------------------------------------------------


def test_stiffness_and_damping_are_recovered_from_positions_within_three_errors(
    position_fit: ph.Fit,
) -> None:
    assert largest_deviation(position_fit) < 3
    # The interval is narrow, so that lying inside it means something.
    assert position_fit.std_errors["k"] < 0.01 * K
    assert position_fit.std_errors["R_p"] < 0.1 * D
    # 320 values tell a standard deviation to 1/sqrt(640) = 4 %; three of those.
    assert position_fit.noise["q"] == pytest.approx(0.01, rel=0.12)
    assert position_fit.warnings == ()
    assert position_fit.outcome.success
    # The momentum that nobody measured: noise of 1 % of the amplitude, averaged over
    # 320 samples, is well below 1 % of the largest momentum.
    p = ph.simulate(TRUTH, T, [1.0, 0.0])[:, 1]
    found = position_fit.states[0][:, 1]
    np.testing.assert_allclose(found, p, atol=0.01 * np.max(np.abs(p)))


def test_the_standard_error_agrees_with_the_scatter_over_seeds() -> None:
    fits = [ph.identify(spring(), positions_only(seed)) for seed in range(8)]
    scores = [(fit.values["k"] - K) / fit.std_errors["k"] for fit in fits]
    # Eight standard normal numbers have a root mean square between 0.42 and 1.65 in 99
    # of 100 cases (chi-square).
    assert 0.42 < np.sqrt(np.mean(np.square(scores))) < 1.65


@pytest.mark.slow
def test_pruning_recovers_the_support_of_a_driven_spring_from_clean_data() -> None:
    t = np.linspace(0.0, 10.0, 401)
    truth = pair("1.5*q**2/2 + p**2/(2*0.5)", "0.3", "1.2*sin(2.5*t)")
    data = recorded(truth, t, [1.0, 0.0], [-0.7, 1.1], noise=0.0)
    wave = ph.trigonometric("t", frequency=2.4)
    candidates = pair(
        ph.polynomials(["q", "p"], 3),
        ph.damping("p"),
        wave + ph.polynomials(["q"], 1, constant=True),
    )
    pruning = ph.Pruning(threshold=0.05)
    fit = ph.identify(candidates, data, ph.PHSILoss(), l1=1e-3, pruning=pruning)
    terms = {"H[q**2]": 0.75, "H[p**2]": 1.0, "R_p": 0.3, "F_p[sin(omega_t*t)]": 1.2}
    entries = fit.model.entries
    assert {name for name in entries if entries[name].prunable} == set(terms)
    expected = {**terms, "F_p.omega_t": 2.5}
    # The defect of SRK4 at h = 0.025 is h^4 omega^4, about 1e-5 of the rates.
    found = {name: fit.values[name] for name in expected}
    assert found == pytest.approx(expected, rel=1e-4)


# ---- invariance ----------------------------------------------------------------------


def test_measuring_in_millimetres_changes_only_the_units(position_fit: ph.Fit) -> None:
    # q in mm, p in kg mm/s and H in uJ: the numbers of k, m and d stay the same.
    fit = ph.identify(spring(), positions_only(scale=1e3, unit="mm"))
    # The solver stops at 1e-8 of the scaled conditions and the noise rounds at 0.5 %;
    # both leave 1e-5 at most.
    assert fit.values == pytest.approx(position_fit.values, rel=1e-4)
    for name in ("k", "R_p"):
        expected = position_fit.std_errors[name]
        assert fit.std_errors[name] == pytest.approx(expected, rel=1e-4)
    assert fit.noise["q"] == pytest.approx(1e3 * position_fit.noise["q"], rel=1e-4)


def test_two_runs_agree_to_the_last_bit_and_work_out_errors_when_they_are_asked_for(
    position_fit: ph.Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def counted(**known: Any) -> StandardErrors:
        calls.append(1)
        return standard_errors(**known)

    monkeypatch.setattr(likelihood_estimate, "standard_errors", counted)
    fit = ph.identify(spring(), positions_only())
    assert fit.values == position_fit.values
    assert fit.loss_value == position_fit.loss_value
    assert calls == []
    assert fit.covariance.tobytes() == position_fit.covariance.tobytes()
    assert "+-" in str(fit)
    assert calls == [1]
    # A pickle holds them, not the work.
    again: ph.Fit = pickle.loads(pickle.dumps(ph.identify(spring(), positions_only())))
    assert again.covariance.tobytes() == position_fit.covariance.tobytes()


# ---- refusals ------------------------------------------------------------------------


def test_stiffness_and_mass_that_cannot_be_told_apart_are_flagged() -> None:
    fit = ph.identify(spring(m=ph.Parameter(2.0, lower=0.1)), positions_only())
    assert any(
        "k" in w and "m" in w and "cannot distinguish" in w for w in fit.warnings
    )


@pytest.mark.parametrize(("options", "message"), [
    ({"l1": {"G": 1.0}}, "l1 names slot 'G'"),
    ({"l1": -1.0}, "expected a finite number of at least 0"),
    ({"loss": "phsi"}, "loss='phsi' is not possible; expected PHSILoss"),
    ({"loss": ph.PHSILoss()}, "'p' was never measured, but PHSILoss takes the"),
    ({"loss": ph.MaximumLikelihood(noise={"p": 0.1})}, "noise of the measured state 'q' is None"),
    ({"loss": ph.MaximumLikelihood(integrator="rk5")}, "integrator 'rk5' is unknown"),
])  # fmt: skip
def test_options_that_mean_nothing_are_refused(options, message) -> None:
    with pytest.raises((ph.DataError, ph.ModelError), match=message):
        ph.identify(spring(), positions_only(), **options)


def test_a_solve_that_is_cut_short_raises_and_says_what_to_do() -> None:
    t = np.linspace(0.0, 5.0, 101)
    x = np.column_stack([np.cos(3 * t), -3 * np.sin(3 * t)])
    sine = ph.formula("-a*sin(b*q)", a=ph.Parameter(2.0), b=ph.Parameter(0.5))
    model = ph.FirstOrder(states=("q", "v"), F={"q": "v", "v": sine})
    data = ph.Measurements.from_arrays([t], [x], states=["q", "v"])
    options: Any = {"settings": ph.SolverSettings(max_iterations=1)}
    said = r"iteration limit was reached.*allow more iterations"
    with pytest.raises(ph.SolveError, match=said):
        ph.identify(model, data, ph.PHSILoss(), **options)
    fit = ph.identify(model, data, ph.PHSILoss(), raise_on_failure=False, **options)
    assert not fit.outcome.success
    assert all(np.isnan(error) for error in fit.std_errors.values())
