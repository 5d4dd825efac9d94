"""Gradient descent: the solver's loss and its derivative, Adam with pruning, seeds,
refusals.
"""

import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch

import phsi_opt as ph
from phsi_opt.baselines.descent import Adam
from phsi_opt.baselines.gradient_descent import (
    Descent,
    DescentRun,
    gradient_descent,
    starting_values,
)
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.sweeps.local_workers import one_thread
from phsi_opt.transcription.defects import defects
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.integrators import INTEGRATORS
from phsi_opt.transcription.losses import complete_intervals
from problems.thesis.systems import SYSTEMS

HENON = SYSTEMS["henon_heiles"]


@pytest.fixture(autouse=True, scope="module")
def one_thread_of_torch() -> Iterator[None]:
    """Small tensors are slower with more threads."""
    with one_thread():
        yield


def everything() -> ph.PseudoHamiltonian:
    """Every kind of term: monomials, other functions and formulas, in H, R and F, with
    an input and fixed values.
    """
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], 4)
        + ph.formula("a*(1 - cos(q)) + p**2/(2*m)", a=Parameter(0.7), m=1.5)
        + Dictionary((Term("sin(w*q)", Parameter(0.2), {"w": Parameter(0.9)}),)),
        R={
            **ph.damping("p"),
            "q": ph.formula("c*(dH_dq**2 + 0.1)**(-1/4)", c=Parameter(0.3)),
        },
        F={
            "p": ph.polynomials(["t"], 2)
            + ph.trigonometric("t", frequency=2.0)
            + ph.formula("b*u", b=Parameter(0.9)),
            "q": ph.polynomials(["q", "u"], 2, constant=True)
            + ph.formula("d*min(max(p, -0.3), 0.3)", d=Parameter(0.5)),
        },
    )


def first_order() -> ph.FirstOrder:
    return ph.FirstOrder(
        ["q", "p"],
        {
            "q": ph.polynomials(["q", "p"], 2, constant=True),
            "p": ph.polynomials(["p", "t"], 3) + ph.formula("sin(q)*u"),
        },
        inputs=["u"],
        R=ph.damping("p"),
    )


MODELS: dict[str, Callable[[], Model]] = {
    "pseudo-Hamiltonian": everything,
    "first order": first_order,
    "only monomials": lambda: ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], 3),
        R=ph.damping("q", "p"),
    ),
}


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


def at_random(model: Model) -> Model:
    rng = np.random.default_rng(1)
    free = [name for name in model.free if not name.endswith(("omega_t", ".w"))]
    return model.with_values({name: 0.1 + 0.5 * rng.random() for name in free})


def solvers_loss(model: Model, data: ph.Measurements, scheme: str) -> float:
    grid = complete_intervals(model, grid_of(data))
    theta = np.array([model.values[name] for name in model.free])
    return float(
        np.mean(
            np.sum(
                np.square(
                    np.array(defects(model, grid, scheme, ca.DM(grid.y.T), theta))
                ),
                axis=0,
            )
        )
    )


def run_at(model: Model, data: ph.Measurements, scheme: str) -> DescentRun:
    """A descent that begins at the values of the model."""
    return DescentRun(model, data, Descent(integrator=scheme, start="model"), seed=0)


def henon_data(noise: float = 0.0, n: int = 400) -> ph.Measurements:
    return HENON.data(0, noise=noise, n=n)


FAST = Descent(learning_rate=1e-2, epochs=40, prune_every=10)


# the loss


@pytest.mark.parametrize("scheme", INTEGRATORS)
@pytest.mark.parametrize("kind", MODELS)
def test_the_loss_is_that_of_the_solver_at_the_same_point(
    kind: str, scheme: str
) -> None:
    model, data = (
        at_random(MODELS[kind]()),
        record("zero" if scheme == "midpoint" else "linear"),
    )
    run = run_at(model, data, scheme)
    value = float(run.loss(run.tables).detach())
    assert value == pytest.approx(
        solvers_loss(model, data, scheme), rel=1e-10
    )  # other order of sums: rounding


@pytest.mark.parametrize("scheme", INTEGRATORS)
@pytest.mark.parametrize("kind", MODELS)
def test_the_gradient_is_that_of_finite_differences(kind: str, scheme: str) -> None:
    run = run_at(at_random(MODELS[kind]()), record(), scheme)
    (gradient,) = torch.autograd.grad(run.loss(run.tables), run.theta)
    values = run.theta.detach()  # writing here moves the parameters
    for i in range(0, len(values), 2):
        ends = []
        for shift in (1e-6, -1e-6):
            values[i] += shift
            ends.append(float(run.loss(run.tables).detach()))
            values[i] -= shift
        # Central differences: rounding of about 1e-16 / 1e-6 of the loss.
        assert float(gradient[i]) == pytest.approx(
            (ends[0] - ends[1]) / 2e-6,
            rel=1e-5,
            abs=1e-7 * float(gradient.abs().max() + 1),
        )


def test_a_batch_has_the_loss_of_its_intervals() -> None:
    run = run_at(at_random(everything()), record(), "srk4")
    n = len(run.tables[0])
    parts = [
        float(run.loss([table[places] for table in run.tables]).detach()) * n_part
        for places, n_part in ((slice(2, 5), 3), ([0, 1, *range(5, n)], n - 3))
    ]
    whole = float(run.loss(run.tables).detach())
    assert sum(parts) == pytest.approx(n * whole, rel=1e-12)


@pytest.mark.parametrize(
    ("body", "start"),
    [
        ("q", 0.2),
        ("q**2 * p", 0.2),
        ("p*q*p", 0.2),
        ("q*u*t**12", 0.2),
        ("1", 0.2),
        ("q/p", 1.0),
        ("sin(q)", 1.0),
        ("q**-1", 1.0),
        ("q**p", 1.0),
        ("q**2.5", 1.0),
        ("2*q", 1.0),
        ("q + p", 1.0),
        ("q*pi", 1.0),
    ],
)
def test_only_products_of_powers_start_as_polynomials(body: str, start: float) -> None:
    terms = Dictionary((Term(body, Parameter()),))
    model = ph.FirstOrder(["q", "p"], {"q": terms}, inputs=["u"])
    assert starting_values(model, Descent(), 0).tolist() == [start]


# the descent


def test_adam_takes_the_steps_of_torchs_adam() -> None:
    rng = np.random.default_rng(0)
    start = torch.tensor(rng.normal(size=5))
    mine, theirs = start.clone().requires_grad_(), start.clone().requires_grad_()
    adam, reference = (
        Adam([mine], 0.01),
        torch.optim.Adam([theirs], lr=0.02, weight_decay=0.01),
    )
    for _ in range(20):
        adam.step(torch.autograd.grad((mine**4).sum(), mine), 0.02)
        reference.zero_grad()
        (theirs**4).sum().backward()
        reference.step()
    np.testing.assert_allclose(mine.detach(), theirs.detach(), rtol=1e-12)


def test_clean_data_give_the_true_terms_and_coefficients() -> None:
    fit = gradient_descent(HENON.model(), henon_data(), FAST)
    assert set(fit.values) == set(HENON.truth)
    assert (
        max(abs(fit.values[name] - value) for name, value in HENON.truth.items()) < 1e-4
    )  # 520 steps: not converged
    assert len(fit.removed) + len(fit.values) == 34
    assert list(fit.history.columns) == ["epoch", "loss", "n_terms"]
    assert fit.history["epoch"].tolist() == list(range(1, 41))
    assert fit.history["n_terms"].iloc[-1] == 6


def test_the_reported_loss_is_the_solvers_at_the_result() -> None:
    data = henon_data(noise=0.02)
    for model in (HENON.model(), HENON.first_order()):
        fit = gradient_descent(
            model, data, replace(FAST, epochs=10, dtype="float32", prune_every=5)
        )
        assert fit.loss_value == pytest.approx(
            solvers_loss(fit.model, data, "srk4"), rel=1e-10
        )  # rounding


def test_a_pruned_coefficient_stays_at_zero() -> None:
    lines: list[str] = []
    settings = replace(
        FAST,
        prune_every=2,
        threshold=0.15,
        epochs=12,
        l1={"H": 0.01},
        weight_decay=1e-3,
    )
    fit = gradient_descent(
        HENON.model(), henon_data(0.02, 100), settings, progress=lines.append
    )
    n_terms = fit.history["n_terms"].tolist()
    assert n_terms == sorted(n_terms, reverse=True) and n_terms[0] == 34 > n_terms[-1]
    assert not set(fit.removed) & set(fit.values)
    assert len(lines) == 12 and "terms" in lines[-1]


def test_pruning_waits_for_its_first_epoch() -> None:
    data, settings = (
        henon_data(n=100),
        replace(FAST, epochs=6, prune_every=2, threshold=0.15),
    )
    early, late = (
        gradient_descent(HENON.model(), data, replace(settings, prune_from=first))
        .history["n_terms"]
        .tolist()
        for first in (None, 5)
    )
    assert early[1] < 34
    assert late[:5] == [34] * 5 and late[5] < 34


def test_the_rate_falls_along_a_cosine() -> None:
    settings = Descent(learning_rate=2.0, epochs=4, decay="cosine")
    assert [settings.rate(epoch) for epoch in (1, 3)] == pytest.approx(
        [2.0, 1.0], rel=1e-14
    )
    assert settings.rate(4) == pytest.approx(1 + np.cos(0.75 * np.pi), rel=1e-14)
    assert replace(settings, decay="none").rate(4) == 2.0


def test_a_relative_rate_scales_the_step() -> None:
    def moved(relative: list[float] | None, rate: float) -> list[float]:
        parameters = [torch.ones(1, dtype=torch.float64) for _ in range(2)]
        adam = Adam(parameters, relative=relative)
        for _ in range(3):
            adam.step([torch.ones(1, dtype=torch.float64) for _ in range(2)], rate)
        return [float(parameter) for parameter in parameters]

    both = moved([1.0, 0.1], 0.01)
    expected = [moved(None, 0.01)[0], moved(None, 0.001)[1]]
    np.testing.assert_allclose(both, expected, rtol=1e-12)


def test_a_removed_term_does_not_move_even_with_momentum() -> None:
    settings = Descent(weight_decay=0.1, l1={"H": 1.0}, prune_every=None, epochs=1)
    run = DescentRun(HENON.model(), henon_data(n=40), settings, seed=0)
    gradients = [torch.ones_like(run.theta)]
    run.step(gradients, 0.01)
    run.remove({"H[q1**2]"})
    for _ in range(5):
        run.step([torch.ones_like(run.theta)], 0.01)
    assert run.values["H[q1**2]"] == 0.0
    assert run.values["H[q2**2]"] < 0.16  # it began at 0.2


def test_a_fixed_parameter_keeps_its_value_and_a_bound_is_kept() -> None:
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula(
            "k*q**2/2 + p**2/(2*m)", k=Parameter(2.0, lower=1.9, upper=2.1), m=1.7
        ),
    )
    fit = gradient_descent(model, record(), Descent(learning_rate=0.1, epochs=20))
    assert fit.values["m"] == 1.7
    assert fit.values["k"] in (1.9, 2.1)


def test_damping_may_go_negative_unless_it_is_kept_positive() -> None:
    t = np.linspace(0, 6, 61)
    growing = np.exp(0.2 * t)[:, None] * np.column_stack([np.cos(t), -np.sin(t)])
    data = ph.Measurements.from_arrays([t], [growing], states=["q", "p"])
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], 2),
        R=ph.damping("p"),
    )
    free, kept = (
        gradient_descent(
            model,
            data,
            Descent(learning_rate=0.02, epochs=40, keep_damping_positive=keep),
        )
        for keep in (False, True)
    )
    assert free.values["R_p"] < -0.1
    assert kept.values["R_p"] == 0.0
    assert free.loss_value < kept.loss_value
    assert free.loss_value == pytest.approx(
        solvers_loss(free.model, data, "srk4"), rel=1e-10
    )


def test_the_same_seed_gives_the_same_bits_and_another_start_another_result() -> None:
    data, settings = (
        henon_data(0.02, 100),
        replace(FAST, epochs=6, start="normal", prune_every=None),
    )
    first, again, other = (
        gradient_descent(HENON.model(), data, settings, seed=s) for s in (1, 1, 2)
    )
    assert first.values == again.values and first.history.equals(again.history)
    assert first.loss_value == again.loss_value
    assert all(first.values[name] != other.values[name] for name in first.values)


def test_a_model_of_time_and_of_an_input_descends() -> None:
    """Their columns at the stages come from NumPy column by column, not by row."""
    settings = Descent(learning_rate=1e-3, epochs=3, batch=4, start="normal")
    loss = gradient_descent(everything(), record(), settings).history["loss"]
    assert loss.iloc[-1] < loss.iloc[0]


def test_the_starts_are_those_of_the_thesis() -> None:
    model = SYSTEMS["mass_spring"].model()
    start = dict(zip(model.free, starting_values(model, Descent(), 0), strict=True))
    assert start["H[q**2]"] == start["F_p[t]"] == 0.2
    assert start["F_p[sin(omega_t*t)]"] == start["F_p.omega_t"] == 1.0
    assert start["R_p"] == 0.0
    draws = [
        starting_values(HENON.model(), Descent(start="normal"), seed)
        for seed in range(50)
    ]
    assert np.std(draws) == pytest.approx(
        0.5, rel=0.1
    )  # 1700 draws: a standard error of 2 %
    given = HENON.model().with_values({"H[q1**2]": 0.4})
    assert (
        starting_values(given, Descent(start="model"), 0)[given.free.index("H[q1**2]")]
        == 0.4
    )


def test_the_threads_of_torch_are_restored() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        gradient_descent(HENON.model(), henon_data(n=40), replace(FAST, epochs=1))
        assert torch.get_num_threads() == 2

        def stop(line: str) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            gradient_descent(
                HENON.model(), henon_data(n=40), replace(FAST, epochs=1), progress=stop
            )
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# refusals and records


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"learning_rate": 0.0}, r"learning_rate=0.0 .* a number above 0"),
        ({"learning_rate": float("nan")}, "learning_rate=nan"),
        ({"epochs": 0}, "epochs=0 .* whole number of at least 1"),
        ({"batch": 2.5}, "batch=2.5"),
        ({"prune_every": 0}, "prune_every=0 .* or None"),
        ({"prune_from": 0}, "prune_from=0 .* or None"),
        ({"decay": "cosinus"}, "decay='cosinus'.*Did you mean 'cosine'"),
        ({"threshold": -1.0}, r"threshold=-1.0"),
        ({"prune_slots": ("H", "G")}, "prune_slots=.*'H', 'R' and 'F'"),
        ({"weight_decay": -0.1}, "weight_decay=-0.1"),
        ({"l1": {"X": 1.0}}, "l1 names slot 'X'"),
        ({"l1_off_after": 1.5}, "l1_off_after=1.5"),
        ({"integrator": "srk5"}, "integrator 'srk5' is unknown.*srk4"),
        ({"start": "norml"}, "start='norml'.*Did you mean 'normal'"),
        ({"dtype": "float16"}, "dtype='float16' .*float32, float64"),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ph.ModelError, match=message):
        Descent(**settings)


def test_a_descent_that_diverges_says_what_to_do() -> None:
    with pytest.raises(ph.SolveError, match="learning_rate below"):
        gradient_descent(
            HENON.first_order(),
            henon_data(n=60),
            Descent(learning_rate=1e200, epochs=4),
        )


def test_an_energy_that_is_pruned_away_is_refused() -> None:
    with pytest.raises(ph.SolveError, match="removed every term of H"):
        gradient_descent(
            HENON.model(),
            henon_data(n=60),
            replace(FAST, epochs=1, prune_every=1, threshold=9.0),
        )


def test_data_that_do_not_match_and_a_model_without_parameters_are_refused() -> None:
    with pytest.raises(
        ph.DataError, match="state 'q1' of the model is not in the measurements"
    ):
        gradient_descent(HENON.model(), record())
    with pytest.raises(ph.ModelError, match="no free parameter"):
        gradient_descent(HENON.model().frozen(), henon_data(n=40))


def test_a_result_and_its_settings_can_be_printed_and_pickled() -> None:
    fit = gradient_descent(HENON.model(), henon_data(n=40), replace(FAST, epochs=1))
    assert pickle.loads(pickle.dumps(fit)).values == fit.values
    text = str(fit)
    assert text.startswith("gradient descent: loss ")
    assert "dp1/dt" in text and " s\n" in text
    assert pickle.loads(pickle.dumps(Descent(l1={"H": 0.1}))) == Descent(l1={"H": 0.1})


def test_importing_the_package_does_not_import_torch() -> None:
    code = (
        "import sys, phsi_opt, phsi_opt.baselines, phsi_opt.baselines.result; "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_settings_are_made_without_torch() -> None:
    code = (
        "import sys, phsi_opt.baselines.descent, "
        "problems.peers.joint_force, problems.peers.phnn_model; "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
