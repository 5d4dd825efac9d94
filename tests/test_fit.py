"""What a Fit promises: its forms agree with each other, its file gives it back, and no
file is ever run.
"""

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import sympy as sp

from phsi_opt.errors import DataError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import FitUncertainty
from phsi_opt.later import Later
from phsi_opt.model.expressions import NUMPY, evaluate
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter, Scan, Share
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import damping, formula, polynomials, trigonometric
from phsi_opt.optimization.ipopt import Outcome

OUTCOME = Outcome(
    True,
    "Solve_Succeeded",
    "a local optimum was found",
    "",
    7,
    0.25,
    1.5,
    1e-12,
    ("R_p",),
)


def known(covariance: np.ndarray, *warnings: str) -> Later[FitUncertainty]:
    return Later.known(FitUncertainty(covariance=covariance, warnings=warnings))


def fit_of(model: Model, **values: float) -> Fit:
    model = model.with_values(values)
    n = len(model.free)
    covariance = np.diag(np.linspace(0.01, 0.1, n) ** 2)
    covariance[-1, -1] = np.nan
    return Fit(
        model=model,
        loss="MaximumLikelihood",
        loss_value=1.25,
        uncertainty=known(covariance, "take care"),
        noise={"q": 0.01},
        outcome=OUTCOME,
        n_values=320,
        bic=-12.5,
        hold="zero",
        seconds=0.5,
        units={"q": "m", "t": "s"},
        removed=("H[p]",),
        provenance={"phsi_opt": "0.1.0"},
    )


def rich_fit() -> Fit:
    """Every kind of part: formula, dictionary, damping, trigonometric, efforts, an
    input, guesses and bounds.
    """
    model = PseudoHamiltonian(
        states=("q", "p"),
        inputs=("u",),
        S=canonical(1),
        H=formula(
            "k*abs(q)**3 + p**2/(2*m)", k=Parameter(2.0, lower=0.0, unit="N/m^2"), m=2.5
        )
        + polynomials(["q"], 2),
        R=damping("p"),
        F={
            "p": formula(
                "b*u - c*tanh(dH_dp/eps)",
                b=1.5,
                c=Parameter(0.3),
                eps=Parameter(guess=Share("dH_dp", 0.05)),
            )
            + trigonometric("t")
        },
    )
    return fit_of(
        model,
        **{
            "k": 1.875,
            "R_p": 0.7,
            "c": 0.3,
            "eps": 0.1,
            "H[q]": 1e-9,
            "H[q**2]": -0.2,
            "F_p[sin(omega_t*t)]": 0.9,
            "F_p[cos(omega_t*t)]": -0.4,
            "F_p.omega_t": 3.1,
        },
    )


def points(n: int = 20) -> list[tuple[np.ndarray, np.ndarray, float]]:
    rng = np.random.default_rng(0)
    return [
        (rng.normal(size=2), rng.normal(size=1), float(rng.uniform(0, 5)))
        for _ in range(n)
    ]


def rate(fit: Fit, x: np.ndarray, u: np.ndarray, t: float) -> np.ndarray:
    theta = [fit.values[name] for name in fit.model.free]
    return np.array(fit.model.rhs()(x, u, t, theta)).ravel()


# ---- forms ---------------------------------------------------------------------------


def test_sympy_and_casadi_give_the_right_hand_side_of_the_model() -> None:
    fit = rich_fit()
    exact, function = fit.sympy(), fit.casadi()
    symbols = sp.symbols(["q", "p", "u", "t"])
    numeric = sp.lambdify(symbols, [exact["dq/dt"], exact["dp/dt"]])
    for x, u, t in points():
        expected = rate(fit, x, u, t)
        # The same formula in another order of operations: rounding only.
        np.testing.assert_allclose(numeric(*x, *u, t), expected, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(
            np.array(function(x, u, t)).ravel(), expected, rtol=1e-14
        )


def test_the_parts_in_sympy_add_up_to_the_equations() -> None:
    exact = rich_fit().sympy()
    q, p = sp.symbols("q p")
    efforts = {s: exact["H"].subs(sp.Abs(q), sp.Symbol("a")).diff(s) for s in (p,)}
    assert sp.simplify(exact["dq/dt"] - efforts[p]) == 0
    assert exact["R_q"] == 0
    assert exact["F_q"] == 0
    assert exact["R_p"] == sp.Float(0.7)


def test_equations_keep_every_term_however_small() -> None:
    model = PseudoHamiltonian(
        states=("q", "p"), S=canonical(1), H=polynomials(["q", "p"], 4)
    )
    values = {name: 10.0 ** -(k + 1) for k, name in enumerate(model.free)}
    fit = fit_of(model, **values)
    dq, dp = fit.equations()
    q, p = np.array([0.7, -1.3]), np.array([0.4, 0.9])
    for text, row in ((dq, 0), (dp, 1)):
        assert text.startswith(("dq/dt = ", "dp/dt = ")[row])
        # One monomial per coefficient whose derivative does not vanish: 10 of the 14.
        assert len(re.findall(r" [+-] ", text.split(" = ")[1])) + 1 == 10
        for at in zip(q, p, strict=True):
            found = float(
                evaluate(text.split(" = ")[1], {"q": at[0], "p": at[1]}, NUMPY)
            )
            # Six digits are printed.
            assert found == pytest.approx(
                rate(fit, np.array(at), np.zeros(0), 0.0)[row], rel=2e-6
            )


def test_what_would_be_endless_multiplied_out_is_left_as_it_is() -> None:
    nested = "q"
    for _ in range(6):  # 2**6 - 1 powers of q, with as many of p each
        nested = f"({nested} + p)**2"
    model = PseudoHamiltonian(
        states=("q", "p"), S=canonical(1), H=formula(f"c*{nested}", c=Parameter(0.1))
    )
    fit = fit_of(model, c=0.1)
    _, dp = fit.equations()
    assert len(dp) < 2_000
    found = float(evaluate(dp.split(" = ")[1], {"q": 0.3, "p": 0.2}, NUMPY))
    expected = rate(fit, np.array([0.3, 0.2]), np.zeros(0), 0.0)[1]
    assert found == pytest.approx(expected, rel=1e-5)


def test_latex_holds_the_same_numbers_as_the_equations() -> None:
    model = PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=2.5),
    )
    fit = fit_of(replace_free(model))
    rows = re.findall(r"\\dot\{(\w)\} &= (.*?)(?: \\\\)?\n", fit.latex())
    assert [name for name, _ in rows] == ["q", "p"]
    x = np.array([0.3, -0.8])
    found = [
        float(
            evaluate(
                re.sub(r"(\d) ([a-z])", r"\1*\2", row), {"q": x[0], "p": x[1]}, NUMPY
            )
        )
        for _, row in rows
    ]
    np.testing.assert_allclose(
        found, rate(fit, x, np.zeros(0), 0.0), rtol=1e-5
    )  # six digits are printed


def replace_free(model: PseudoHamiltonian) -> PseudoHamiltonian:
    return PseudoHamiltonian(
        states=model.states, S=model.S, H=model.H, R=damping("p")
    ).with_values({"R_p": 0.0})


def test_the_report_names_every_parameter_with_its_error_and_every_warning() -> None:
    text = str(rich_fit())
    for part in (
        "1.875 +- ",
        "N/m^2",
        "H[p]",
        "take care",
        "R_p",
        "b = 1.5 (fixed)",
        "q 0.01 m",
        "local optimum",
    ):
        assert part in text


def test_the_parameter_table_has_a_row_per_parameter() -> None:
    fit = rich_fit()
    table = fit.parameters.set_index("name")
    assert list(table.index) == list(fit.model.entries)
    assert table.loc["k", "value"] == 1.875
    assert table.loc["k", "unit"] == "N/m^2"
    assert bool(table.loc["m", "fixed"])
    assert table["std_error"].isna()["m"]


def test_the_table_of_limits_and_that_of_bounds_have_different_columns() -> None:
    fit = rich_fit()
    intervals = fit.intervals(0.9)
    assert list(intervals.columns) == ["value", "ci_lower", "ci_upper"]
    assert list(intervals.index) == list(fit.names)
    assert fit.parameters.set_index("name")["lower"]["k"] == 0.0
    assert 1.8 < intervals["ci_lower"]["k"] < 1.875 < intervals["ci_upper"]["k"]
    with pytest.raises(DataError, match="level=1 must lie between 0 and 1"):
        fit.intervals(1)


def loaded_fit() -> Fit:
    """A mass that differs between two runs."""
    mass = Parameter(2.0, lower=0.0, unit="kg", per_trajectory=True)
    model = PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=mass),
    )
    return replace(
        fit_of(model),
        names=("m[run 1]", "m[run 2]"),
        by_trajectory={"run 1": {"m": 1.5}, "run 2": {"m": 2.5}},
        uncertainty=known(np.diag([0.01, 0.04])),
    )


def test_a_trajectory_is_known_by_its_name_and_by_its_number() -> None:
    fit = loaded_fit()
    t = np.linspace(0.0, 1.0, 5)
    assert fit.model_of("run 2").values["m"] == 2.5
    assert fit.model_of(1) == fit.model_of(-1) == fit.model_of("run 2")
    assert fit.model_of("another run").values["m"] == 2.0
    by_name = fit.simulate(t, [1.0, 0.0], trajectory="run 1")
    np.testing.assert_array_equal(fit.simulate(t, [1.0, 0.0], trajectory=0), by_name)
    with pytest.raises(DataError, match="there is no trajectory 2; the fit has 2"):
        fit.model_of(2)
    with pytest.raises(DataError, match="'run 3' has no parameters of its own"):
        fit.simulate(t, [1.0, 0.0], trajectory="run 3")


def test_a_fit_of_shared_parameters_has_one_model_for_all_trajectories() -> None:
    fit = rich_fit()
    assert fit.model_of(7) == fit.model_of("run 1") == fit.model
    with pytest.raises(DataError, match="none: all parameters are shared"):
        fit.simulate(np.linspace(0.0, 1.0, 5), [1.0, 0.0], trajectory=0)


# ---- picture -------------------------------------------------------------------------


def test_the_picture_draws_every_estimate_relative_to_its_size() -> None:
    fit = loaded_fit()
    _, ax = plt.subplots()
    assert fit.plot(ax) is ax
    labels = [text.get_text() for text in ax.get_yticklabels()]
    # Student's t with 318 degrees of freedom at 97.5 %: 1.967 standard errors.
    assert labels == ["m[run 1] = 1.5 ± 0.2 kg", "m[run 2] = 2.5 ± 0.39 kg"]
    assert ax.get_title() == "m[run 2] is known worst, to 16 % of its size"
    plt.close("all")


def test_the_picture_says_which_estimates_are_not_to_be_relied_on() -> None:
    fit = rich_fit()  # R_p ended at a bound, the last one has no standard error
    covariance = fit.covariance.copy()
    at_bound = fit.names.index("R_p")
    covariance[at_bound] = covariance[:, at_bound] = np.nan
    ax = replace(fit, uncertainty=known(covariance)).plot()
    labels = [text.get_text() for text in ax.get_yticklabels()]
    assert "R_p = 0.7 N s/m, at its bound" in labels
    assert labels[-1].endswith(", no standard error")
    title = ax.get_title().replace("\n", " ")
    assert "2 not told from zero (orange)" in title  # H[q] and eps
    assert "1 without standard error (circle)" in title
    assert "1 at a bound (square)" in title
    plt.close("all")


# ---- files ---------------------------------------------------------------------------


def first_order_fit() -> Fit:
    model = FirstOrder(
        states=("q", "v"),
        F={"q": formula("v"), "v": polynomials(["q", "v"], 3, constant=True)},
    )
    return fit_of(model, **{"F_v[q]": -4.0})


@pytest.mark.parametrize("make", [rich_fit, first_order_fit])
def test_a_saved_fit_comes_back_equal(make: Any, tmp_path: Path) -> None:
    fit = make()
    fit.save(tmp_path / "fit.json")
    again = Fit.load(tmp_path / "fit.json")
    assert again.model == fit.model
    assert type(again.model) is type(fit.model)
    np.testing.assert_array_equal(
        again.covariance, fit.covariance
    )  # exact: JSON keeps every digit of a float
    assert again.outcome == fit.outcome
    plain = (
        "loss",
        "loss_value",
        "noise",
        "n_values",
        "bic",
        "hold",
        "units",
        "removed",
        "warnings",
        "provenance",
    )
    for name in plain:
        assert getattr(again, name) == getattr(fit, name), name
    assert str(again) == str(fit)
    assert again.equations() == fit.equations()


def test_a_guess_survives_the_file(tmp_path: Path) -> None:
    rich_fit().save(tmp_path / "fit.json")
    entries = Fit.load(tmp_path / "fit.json").model.entries
    assert entries["F_p.omega_t"].parameter.guess == Scan("t")
    assert entries["eps"].parameter.guess == Share("dH_dp", 0.05)


@pytest.mark.parametrize("make", [rich_fit, first_order_fit])
def test_a_fit_can_be_sent_to_another_process(make: Any) -> None:
    fit = make()
    again = pickle.loads(pickle.dumps(fit))
    assert again.model == fit.model
    assert str(again) == str(fit)


def damaged(tmp_path: Path, change: Any) -> Path:
    content = json.loads(json.dumps(rich_fit().content()))
    change(content)
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(content))
    return path


def body(text: str) -> Any:
    return lambda content: content["model"]["H"][0].update(body=text, inner={})


@pytest.mark.parametrize(
    "attack",
    [
        "__import__('os').system('touch ran')",
        "().__class__.__bases__",
        'exec(\'open("ran", "w")\')',
        "q.real",
        "q[0]",
        "(lambda: q)()",
        "9**64**64**64",
        "((9**64)**64)**64",
        "2**(64*64*64*64*64)",
        "q" + "+q" * 3000,
        "sin(" * 150 + "q" + ")" * 150 + "+" + "-" * 900 + "q",
        "9" * 400 + "*q",
        "q if q else p",
        "f'{q}'",
    ],
)
def test_a_formula_that_is_not_a_formula_is_refused_and_never_run(
    attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="holds a model that is not valid"):
        Fit.load(damaged(tmp_path, body(attack)))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("covariance"),
        lambda c: c.update(covariance=[[1.0]]),
        lambda c: c.update(loss_value="a lot"),
        lambda c: c.update(noise={"q": "small"}),
        lambda c: c.update(noise=[1.0]),
        lambda c: c.update(hold="spline"),
        lambda c: c.update(outcome={}),
        lambda c: c["outcome"].update(seconds=None),
        lambda c: c["model"].update(kind="os"),
        lambda c: c["model"].update(states="qp"),
        lambda c: c["model"].update(S=[[0.0, 1.0], [1.0, 0.0]]),
        lambda c: c["model"]["H"][0].update(body=5),
        lambda c: c["model"]["H"][0]["inner"]["k"].update(value="x"),
        lambda c: c["model"]["H"][0]["inner"]["k"].update(value=10**400),
        lambda c: c["model"]["H"][0]["inner"]["k"].update(guess=["Popen", "ls"]),
        lambda c: c["model"]["H"][0]["inner"]["k"].update(extra=1),
        lambda c: c["model"].update(R={"x": []}),
    ],
)
def test_a_damaged_file_is_refused(change: Any, tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"fit\.json (is damaged|holds a model that is not valid)"
    ):
        Fit.load(damaged(tmp_path, change))


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", '{"format": "other"}', "\x00", "[" * 100_000, "9" * 5000],
)
def test_a_file_that_is_not_a_fit_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "fit.json").write_text(text)
    with pytest.raises(
        DataError,
        match=r"fit\.json (cannot be read as a fit|is not a file of the format)",
    ):
        Fit.load(tmp_path / "fit.json")


def test_a_file_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read as a fit"):
        Fit.load(tmp_path / "none.json")
