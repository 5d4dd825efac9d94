"""Gradient descent: the solver's loss and its derivative, Adam with pruning, seeds,
refusals.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import (
    Baseline,
    Descent,
    gradient_descent,
    mean_loss,
    starting_values,
)
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.transcription.defects import interval_arguments, parameter_slopes
from phsi_opt.transcription.grid import aligned_once, grid_of
from phsi_opt.transcription.integrators import INTEGRATORS
from phsi_opt.transcription.losses import complete_intervals
from problems.thesis.systems import SYSTEMS

HENON = SYSTEMS["henon_heiles"]
FAST = Descent(learning_rate=1e-2, epochs=40, prune_every=10)


def hamiltonian(H: Dictionary, **slots: Any) -> ph.PseudoHamiltonian:
    about: Any = {"states": ["q", "p"], "inputs": ["u"], "S": ph.canonical(1)}
    return ph.PseudoHamiltonian(H=H, **about, **slots)


def everything() -> ph.PseudoHamiltonian:
    """Every kind of term: monomials, other functions and formulas, in H, R and F, with
    an input and fixed values.
    """

    def free(body: str, **values: float) -> Dictionary:
        known = {name: ph.Parameter(value) for name, value in values.items()}
        return ph.formula(body, **known)

    wave = Term("sin(w*q)", ph.Parameter(0.2), {"w": ph.Parameter(0.9)})
    push = ph.polynomials(["t"], 2) + ph.trigonometric("t", frequency=2.0)
    clipped = free("d*min(max(p, -0.3), 0.3)", d=0.5)
    return hamiltonian(
        ph.polynomials(["q", "p"], 4)
        + free("a*(1 - cos(q))", a=0.7)
        + ph.formula("p**2/(2*m)", m=1.5)
        + Dictionary((wave,)),
        R={**ph.damping("p"), "q": free("c*(dH_dq**2 + 0.1)**(-1/4)", c=0.3)},
        F={
            "p": push + free("b*u", b=0.9),
            "q": ph.polynomials(["q", "u"], 2, constant=True) + clipped,
        },
    )


def first_order() -> ph.FirstOrder:
    rates = {
        "q": ph.polynomials(["q", "p"], 2, constant=True),
        "p": ph.polynomials(["p", "t"], 3) + ph.formula("sin(q)*u"),
    }
    return ph.FirstOrder(["q", "p"], rates, inputs=["u"], R=ph.damping("p"))


def monomials() -> ph.PseudoHamiltonian:
    return hamiltonian(ph.polynomials(["q", "p"], 3), R=ph.damping("q", "p"))


MODELS = (everything, first_order, monomials)


def record(hold: str = "linear") -> ph.Measurements:
    """Two irregular runs with a gap, two states, one input."""
    rng = np.random.default_rng(0)
    ts = [np.cumsum(rng.uniform(0.05, 0.2, n)) for n in (9, 6)]
    xs = [rng.normal(size=(len(t), 2)) for t in ts]
    xs[0][4, 1] = np.nan
    us = [rng.normal(size=(len(t), 1)) for t in ts]
    return ph.Measurements.from_arrays(
        ts, xs, us, states=["q", "p"], inputs=["u"], hold=hold
    )


def at_random(model: ph.Model) -> ph.Model:
    rng = np.random.default_rng(1)
    free = [name for name in model.free if not name.endswith(("omega_t", ".w"))]
    return model.with_values({name: 0.1 + 0.5 * rng.random() for name in free})


def solvers_loss(model: ph.Model, data: ph.Measurements, scheme: str) -> float:
    grid = complete_intervals(model, grid_of(data))
    d = parameter_slopes(model, grid, scheme, model.theta).d
    return float(np.mean(np.sum(d**2, axis=1)))


def rows_of(model: ph.Model, data: ph.Measurements) -> np.ndarray:
    """What the loss needs of each interval."""
    grid = complete_intervals(model, grid_of(aligned_once(model, data)))
    grid = grid.driven(model, model.theta)
    return np.concatenate(interval_arguments(grid, grid.y.T)).T


def henon_data(noise: float = 0.0, n: int = 100) -> ph.Measurements:
    return HENON.data(0, noise=noise, n=n)


def descended(noise: float = 0.0, seed: int = 0, **settings: Any) -> Baseline:
    """From a hundred samples."""
    settings = {"epochs": 6, **settings}
    descent = replace(FAST, **settings)
    return gradient_descent(HENON.model(), henon_data(noise), descent, seed=seed)


# ---- the loss ------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", INTEGRATORS)
@pytest.mark.parametrize("make", MODELS)
def test_the_loss_is_that_of_the_solver_and_its_slopes_those_of_differences(
    make: Any, scheme: str
) -> None:
    model = at_random(make())
    data = record("zero" if scheme == "midpoint" else "linear")
    rows = rows_of(model, data)
    loss, *slopes = mean_loss(model, scheme, rows, model.theta)
    # Another order of sums: rounding.
    assert loss == pytest.approx(solvers_loss(model, data, scheme), rel=1e-10)
    # Central differences: rounding of about 1e-16 / 1e-6 of the loss.
    limit = 1e-7 * float(np.abs(slopes).max() + 1)
    for i in range(0, len(slopes), 2):
        ends = []
        for shift in (1e-6, -1e-6):
            theta = model.theta
            theta[i] += shift
            ends.append(mean_loss(model, scheme, rows, theta)[0])
        slope = pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=limit)
        assert slopes[i] == slope


# ---- where it starts -----------------------------------------------------------------


def test_the_starts_are_those_of_the_thesis() -> None:
    model = SYSTEMS["mass_spring"].model()
    start = dict(zip(model.free, starting_values(model, Descent(), 0), strict=True))
    assert start["H[q**2]"] == start["F_p[t]"] == 0.2
    assert start["F_p[sin(omega_t*t)]"] == start["F_p.omega_t"] == 1.0
    assert start["R_p"] == 0.0
    normal = Descent(start="normal")
    draws = [starting_values(HENON.model(), normal, seed) for seed in range(50)]
    # 1700 draws: a standard error of 2 %.
    assert np.std(draws) == pytest.approx(0.5, rel=0.1)
    given = HENON.model().with_values({"H[q1**2]": 0.4})
    values = starting_values(given, Descent(start="model"), 0)
    assert values[given.free.index("H[q1**2]")] == 0.4


# ---- the descent ---------------------------------------------------------------------


def test_clean_data_give_the_true_terms_and_coefficients() -> None:
    fit = gradient_descent(HENON.model(), henon_data(n=400), FAST)
    # 520 steps: not converged.
    assert fit.values == pytest.approx(HENON.truth, abs=1e-4)
    assert len(fit.removed) + len(fit.values) == 34
    assert list(fit.history.columns) == ["epoch", "loss", "n_terms"]
    assert fit.history["epoch"].tolist() == list(range(1, 41))
    assert fit.history["n_terms"].iloc[-1] == 6


def test_the_reported_loss_is_the_solvers_at_the_result() -> None:
    data = henon_data(noise=0.02)
    settings = replace(FAST, epochs=10, dtype="float32", prune_every=5)
    for model in (HENON.model(), HENON.first_order()):
        fit = gradient_descent(model, data, settings)
        expected = solvers_loss(fit.model, data, "srk4")
        assert fit.loss_value == pytest.approx(expected, rel=1e-10)  # rounding


def test_a_fixed_parameter_keeps_its_value_and_a_bound_is_kept() -> None:
    k = ph.Parameter(2.0, lower=1.9, upper=2.1)
    model = hamiltonian(ph.formula("k*q**2/2 + p**2/(2*m)", k=k, m=1.7))
    fit = gradient_descent(model, record(), Descent(learning_rate=0.1, epochs=20))
    assert fit.values["m"] == 1.7
    assert fit.values["k"] in (1.9, 2.1)


def test_the_same_seed_gives_the_same_bits_and_another_start_another_result() -> None:
    first, again, other = (
        descended(0.02, seed, start="normal", prune_every=None) for seed in (1, 1, 2)
    )
    assert first.values == again.values and first.history.equals(again.history)
    assert first.loss_value == again.loss_value
    assert all(first.values[name] != other.values[name] for name in first.values)


# ---- refusals and records ------------------------------------------------------------


@pytest.mark.parametrize(("settings", "message"), [
    ({"learning_rate": 0.0}, r"learning_rate=0.0 .* a number above 0"),
    ({"learning_rate": float("nan")}, "learning_rate=nan"),
    ({"epochs": 0}, "epochs=0 .* whole number of at least 1"),
    ({"batch": 2.5}, "batch=2.5"),
    ({"prune_every": 0}, "prune_every=0 .* at least 1"),
    ({"prune_from": 0}, "prune_from=0 .* at least 1"),
    ({"decay": "cosinus"}, "decay='cosinus'.*Did you mean 'cosine'"),
    ({"threshold": -1.0}, r"threshold=-1.0"),
    ({"prune_slots": ("H", "G")}, "prune_slots=.*'H', 'R' and 'F'"),
    ({"weight_decay": -0.1}, "weight_decay=-0.1"),
    ({"l1": {"X": 1.0}}, "l1 names slot 'X'"),
    ({"l1_off_after": 1.5}, "l1_off_after=1.5"),
    ({"integrator": "srk5"}, "integrator 'srk5' is unknown.*srk4"),
    ({"start": "norml"}, "start='norml'.*Did you mean 'normal'"),
    ({"dtype": "float16"}, "dtype='float16' .*float32, float64"),
])  # fmt: skip
def test_settings_that_make_no_sense_are_refused(settings, message) -> None:
    with pytest.raises(ph.ModelError, match=message):
        Descent(**settings)
