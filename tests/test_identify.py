"""What `identify` promises: the truth within its own standard errors, whatever the
units, the same on every run.
"""

import pickle
from typing import Any

import numpy as np
import pytest

import phsi_opt
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError, SolveError
from phsi_opt.estimation import likelihood_estimate
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.model.model import FirstOrder, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import damping, formula, polynomials, trigonometric
from phsi_opt.model_error.standard_errors import (
    PlainEstimate,
    StandardErrors,
    standard_errors,
)
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.simulation.simulate import simulate
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss

K, M, D = 40.0, 2.5, 0.8  # N/m, kg, kg/s


def spring(k: Any = None, m: Any = M) -> PseudoHamiltonian:
    return PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula(
            "k*q**2/2 + p**2/(2*m)",
            k=Parameter(30.0, lower=0.0) if k is None else k,
            m=m,
        ),
        R=damping("p"),
    )


def positions_only(
    seed: int = 0, scale: float = 1.0, missing: int = 0, unit: str = "m"
) -> Measurements:
    """Two free decays of the damped spring, of which only the noisy position was
    recorded.
    """
    rng = np.random.default_rng(seed)
    truth = spring(K).with_values({"R_p": D})
    t = np.linspace(0.0, 4.0, 161)
    ts, xs = [], []
    for x0 in ([1.0, 0.0], [-0.5, 3.0]):
        q = simulate(truth, t, x0)[:, 0] + 0.01 * rng.normal(size=len(t))
        q[rng.choice(np.arange(1, len(t)), missing, replace=False)] = np.nan
        ts.append(t)
        xs.append(np.column_stack([scale * q, np.full(len(t), np.nan)]))
    return Measurements.from_arrays(
        ts, xs, states=["q", "p"], units={"q": unit, "t": "s"}
    )


@pytest.fixture(scope="module")
def position_fit() -> Fit:
    return identify(spring(), positions_only())


def deviations(fit: Fit, truth: dict[str, float]) -> dict[str, float]:
    return {
        name: abs(fit.values[name] - value) / fit.std_errors[name]
        for name, value in truth.items()
    }


# ---- recovery ------------------------------------------------------------------------


def test_stiffness_and_damping_are_recovered_from_positions_within_three_errors(
    position_fit: Fit,
) -> None:
    assert max(deviations(position_fit, {"k": K, "R_p": D}).values()) < 3
    assert (
        position_fit.std_errors["k"] < 0.01 * K
    )  # the interval is narrow, so that lying inside it means something
    assert position_fit.std_errors["R_p"] < 0.1 * D
    # 320 values tell a standard deviation to 1/sqrt(640) = 4 %; three of those.
    assert position_fit.noise["q"] == pytest.approx(0.01, rel=0.12)
    assert position_fit.warnings == ()
    assert position_fit.outcome.success


def test_the_standard_error_agrees_with_the_scatter_over_seeds() -> None:
    fits = [identify(spring(), positions_only(seed)) for seed in range(8)]
    scores = [(fit.values["k"] - K) / fit.std_errors["k"] for fit in fits]
    # Eight standard normal numbers have a root mean square between 0.42 and 1.65 in 99
    # of 100 cases (chi-square).
    assert 0.42 < np.sqrt(np.mean(np.square(scores))) < 1.65


def test_missing_samples_are_no_obstacle() -> None:
    fit = identify(spring(), positions_only(missing=60))
    assert max(deviations(fit, {"k": K, "R_p": D}).values()) < 3
    assert fit.n_values == 2 * (161 - 60)


def test_the_estimated_momentum_is_the_true_one_though_nobody_measured_it(
    position_fit: Fit,
) -> None:
    truth = simulate(
        spring(K).with_values({"R_p": D}), np.linspace(0.0, 4.0, 161), [1.0, 0.0]
    )
    # Noise of 1 % of the amplitude, averaged over 320 samples: well below 1 % of the
    # largest momentum.
    np.testing.assert_allclose(
        position_fit.states[0][:, 1],
        truth[:, 1],
        atol=0.01 * np.max(np.abs(truth[:, 1])),
    )


def test_pruning_recovers_the_support_of_a_driven_spring_from_clean_data() -> None:
    t = np.linspace(0.0, 10.0, 401)
    truth = PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=1.5, m=0.5),
        R={"p": formula("d", d=0.3)},
        F={"p": formula("1.2*sin(2.5*t)")},
    )
    xs = [simulate(truth, t, x0) for x0 in ([1.0, 0.0], [-0.7, 1.1])]
    candidates = PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=polynomials(["q", "p"], 3),
        R=damping("p"),
        F={
            "p": trigonometric("t", frequency=2.4)
            + polynomials(["q"], 1, constant=True)
        },
    )
    data = Measurements.from_arrays([t, t], xs, states=["q", "p"])
    fit = identify(
        candidates, data, PHSILoss(), l1=1e-3, pruning=Pruning(threshold=0.05)
    )
    assert {name for name, e in fit.model.entries.items() if e.prunable} == {
        "H[q**2]",
        "H[p**2]",
        "R_p",
        "F_p[sin(omega_t*t)]",
    }
    expected = {
        "H[q**2]": 0.75,
        "H[p**2]": 1.0,
        "R_p": 0.3,
        "F_p[sin(omega_t*t)]": 1.2,
        "F_p.omega_t": 2.5,
    }
    # The defect of SRK4 at h = 0.025 is h^4 omega^4, about 1e-5 of the rates.
    assert {name: fit.values[name] for name in expected} == pytest.approx(
        expected, rel=1e-4
    )


# ---- invariance ----------------------------------------------------------------------


def test_measuring_in_millimetres_changes_only_the_units(position_fit: Fit) -> None:
    # q in mm, p in kg mm/s and H in uJ: the numbers of k, m and d stay the same.
    fit = identify(spring(), positions_only(scale=1e3, unit="mm"))
    for name in ("k", "R_p"):
        # The solver stops at 1e-8 of the scaled conditions and the noise rounds at 0.5
        # %; both leave 1e-5 at most.
        assert fit.values[name] == pytest.approx(position_fit.values[name], rel=1e-4)
        assert fit.std_errors[name] == pytest.approx(
            position_fit.std_errors[name], rel=1e-4
        )
    assert fit.noise["q"] == pytest.approx(1e3 * position_fit.noise["q"], rel=1e-4)


def test_two_runs_agree_to_the_last_bit(position_fit: Fit) -> None:
    again = identify(spring(), positions_only())
    assert again.values == position_fit.values
    assert again.covariance.tobytes() == position_fit.covariance.tobytes()
    assert again.loss_value == position_fit.loss_value


def test_standard_errors_are_worked_out_when_they_are_asked_for(
    position_fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def counted(plain: PlainEstimate) -> StandardErrors:
        calls.append(1)
        return standard_errors(plain)

    monkeypatch.setattr(likelihood_estimate, "standard_errors", counted)
    fit = identify(spring(), positions_only())
    assert fit.values == position_fit.values
    assert calls == []
    assert fit.std_errors == position_fit.std_errors
    assert "+-" in str(fit)
    assert calls == [1]


def test_a_pickled_fit_holds_its_standard_errors(position_fit: Fit) -> None:
    fit = pickle.loads(pickle.dumps(identify(spring(), positions_only())))
    assert fit.covariance.tobytes() == position_fit.covariance.tobytes()


def test_the_order_of_trajectories_and_columns_does_not_matter(
    position_fit: Fit,
) -> None:
    data = positions_only()
    runs = data.trajectories[::-1]
    swapped = Measurements.from_arrays(
        [run.t for run in runs],
        [run.x[:, ::-1] for run in runs],
        states=["p", "q"],
        units=data.units,
    )
    fit = identify(spring(), swapped)
    # The same sums in another order, solved to 1e-8 of scaled conditions.
    assert fit.values["k"] == pytest.approx(position_fit.values["k"], rel=1e-5)
    assert fit.values["R_p"] == pytest.approx(position_fit.values["R_p"], rel=1e-5)


# ---- what the data cannot tell -------------------------------------------------------


def test_stiffness_and_mass_that_cannot_be_told_apart_are_flagged() -> None:
    fit = identify(spring(m=Parameter(2.0, lower=0.1)), positions_only())
    assert any("k" in w and "m" in w and "cannot tell" in w for w in fit.warnings)


# ---- refusals ------------------------------------------------------------------------


def test_a_state_that_is_not_in_the_data_is_refused() -> None:
    t = np.linspace(0.0, 1.0, 20)
    data = Measurements.from_arrays([t], [np.cos(t)[:, None]], states=["q"])
    with pytest.raises(
        DataError,
        match=r"state 'p' of the model is not in the measurements \(q\); declare it",
    ):
        identify(spring(), data)


def test_the_phsi_loss_refuses_a_state_that_nobody_measured() -> None:
    with pytest.raises(
        DataError,
        match="'p' was never measured, but PHSILoss takes the states from the data",
    ):
        identify(spring(), positions_only(), PHSILoss())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"l1": {"G": 1.0}}, "l1 names slot 'G'"),
        ({"l1": -1.0}, "expected a finite number of at least 0"),
        ({"loss": "phsi"}, "is not a loss"),
        (
            {"loss": MaximumLikelihood(noise={"p": 0.1})},
            "noise of the measured state 'q' is None",
        ),
        ({"loss": MaximumLikelihood(integrator="rk5")}, "integrator 'rk5' is unknown"),
    ],
)
def test_options_that_mean_nothing_are_refused(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises((DataError, ModelError), match=message):
        identify(spring(), positions_only(), **options)


def test_a_solve_that_is_cut_short_raises_and_says_what_to_do() -> None:
    t = np.linspace(0.0, 5.0, 101)
    x = np.column_stack([np.cos(3 * t), -3 * np.sin(3 * t)])
    model = FirstOrder(
        states=("q", "v"),
        F={
            "q": formula("v"),
            "v": formula("-a*sin(b*q)", a=Parameter(2.0), b=Parameter(0.5)),
        },
    )
    data = Measurements.from_arrays([t], [x], states=["q", "v"])
    with pytest.raises(
        SolveError, match=r"iteration limit was reached.*allow more iterations"
    ):
        identify(model, data, PHSILoss(), settings=SolverSettings(max_iterations=1))
    fit = identify(
        model,
        data,
        PHSILoss(),
        settings=SolverSettings(max_iterations=1),
        raise_on_failure=False,
    )
    assert not fit.outcome.success
    assert all(np.isnan(error) for error in fit.std_errors.values())


def test_pruning_everything_away_is_refused() -> None:
    t = np.linspace(0.0, 5.0, 101)
    data = Measurements.from_arrays(
        [t], [np.column_stack([np.cos(t), -np.sin(t)])], states=["q", "p"]
    )
    model = PseudoHamiltonian(
        states=("q", "p"), S=canonical(1), H=polynomials(["q", "p"], 2)
    )
    with pytest.raises(ModelError, match=r"removes every term|no term"):
        identify(model, data, PHSILoss(), pruning=Pruning(threshold=1e3))


def test_the_package_offers_what_a_user_writes() -> None:
    assert {
        "identify",
        "Measurements",
        "PseudoHamiltonian",
        "FirstOrder",
        "PHSILoss",
    } <= set(dir(phsi_opt))
