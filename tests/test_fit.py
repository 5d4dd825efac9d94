"""What a Fit promises: its forms agree with each other, its file gives it back, and no
file is ever run.
"""

import json
import pickle
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import phsi_opt as ph
from phsi_opt.estimation.fit import FitUncertainty
from phsi_opt.later import Later
from phsi_opt.model.expressions import NUMPY, evaluate
from phsi_opt.model.parameters import Share
from phsi_opt.optimization.ipopt import Outcome

FOUND = "a local optimum was found"
OUTCOME = Outcome(True, "Solve_Succeeded", FOUND, "", 7, 0.25, 1.5, 1e-12, ("R_p",))
T = np.linspace(0.0, 1.0, 5)


def known(covariance: np.ndarray, *warnings: str) -> Later[FitUncertainty]:
    return Later.known(FitUncertainty(covariance=covariance, warnings=warnings))


def fit_of(model: ph.Model, **values: float) -> ph.Fit:
    model = model.with_values(values)
    covariance = np.diag(np.linspace(0.01, 0.1, len(model.free)) ** 2)
    covariance[-1, -1] = np.nan
    return ph.Fit(
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


def hamiltonian(H: Any, **slots: Any) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(states=("q", "p"), S=ph.canonical(1), H=H, **slots)


def rich_fit() -> ph.Fit:
    """Every kind of part: formula, dictionary, damping, trigonometric, efforts, an
    input, guesses and bounds.
    """
    k = ph.Parameter(2.0, lower=0.0, unit="N/m^2")
    energy = ph.formula("k*abs(q)**3 + p**2/(2*m)", k=k, m=2.5)
    width = ph.Parameter(guess=Share("dH_dp", 0.05))
    force = ph.formula("b*u - c*tanh(dH_dp/eps)", b=1.5, c=ph.Parameter(0.3), eps=width)
    model = hamiltonian(
        energy + ph.polynomials(["q"], 2),
        inputs=("u",),
        R=ph.damping("p"),
        F={"p": force + ph.trigonometric("t")},
    )
    waves = {"F_p[sin(omega_t*t)]": 0.9, "F_p[cos(omega_t*t)]": -0.4}
    values = {"k": 1.875, "R_p": 0.7, "c": 0.3, "eps": 0.1, "F_p.omega_t": 3.1}
    return fit_of(model, **waves, **values, **{"H[q]": 1e-9, "H[q**2]": -0.2})


def first_order_fit() -> ph.Fit:
    terms = {"q": ph.formula("v"), "v": ph.polynomials(["q", "v"], 3, constant=True)}
    return fit_of(ph.FirstOrder(states=("q", "v"), F=terms), **{"F_v[q]": -4.0})


def loaded_fit() -> ph.Fit:
    """A mass that differs between two runs."""
    mass = ph.Parameter(2.0, lower=0.0, unit="kg", per_trajectory=True)
    fit = fit_of(hamiltonian(ph.formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=mass)))
    return replace(
        fit,
        names=("m[run 1]", "m[run 2]"),
        by_trajectory={"run 1": {"m": 1.5}, "run 2": {"m": 2.5}},
        uncertainty=known(np.diag([0.01, 0.04])),
    )


def rate(fit: ph.Fit, x: Any, u: Any = (), t: float = 0.0) -> np.ndarray:
    theta = [fit.values[name] for name in fit.model.free]
    return np.array(fit.model.rhs()(x, u, t, theta)).ravel()


# ---- forms ---------------------------------------------------------------------------


def test_sympy_and_casadi_give_the_right_hand_side_of_the_model() -> None:
    fit = rich_fit()
    exact, function = fit.sympy(), fit.casadi()
    symbols = sp.symbols(["q", "p", "u", "t"])
    numeric = sp.lambdify(symbols, [exact["dq/dt"], exact["dp/dt"]])
    for x in np.random.default_rng(0).normal(size=(20, 4)):
        expected = rate(fit, x[:2], x[2], x[3])
        # The same formula in another order of operations: rounding only.
        np.testing.assert_allclose(numeric(*x), expected, rtol=1e-12, atol=1e-13)
        found = np.array(function(x[:2], x[2], x[3])).ravel()
        np.testing.assert_allclose(found, expected, rtol=1e-14)
    q, p = sp.symbols("q p")
    effort = exact["H"].subs(sp.Abs(q), sp.Symbol("a")).diff(p)
    assert sp.simplify(exact["dq/dt"] - effort) == 0
    assert (exact["R_q"], exact["F_q"], exact["R_p"]) == (0, 0, sp.Float(0.7))


def test_equations_keep_every_term_however_small() -> None:
    model = hamiltonian(ph.polynomials(["q", "p"], 4))
    values = {name: 10.0 ** -(k + 1) for k, name in enumerate(model.free)}
    fit = fit_of(model, **values)
    for row, (name, text) in enumerate(zip("qp", fit.equations(), strict=True)):
        left, right = text.split(" = ")
        assert left == f"d{name}/dt"
        # One monomial per coefficient whose derivative does not vanish: 10 of the 14.
        assert len(re.findall(r" [+-] ", right)) + 1 == 10
        for at in ([0.7, 0.4], [-1.3, 0.9]):
            found = float(evaluate(right, dict(zip("qp", at, strict=True)), NUMPY))
            # Six digits are printed.
            assert found == pytest.approx(rate(fit, at)[row], rel=2e-6)


def test_latex_says_what_the_equations_say() -> None:
    energy = ph.formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=2.5)
    fit = fit_of(hamiltonian(energy, R=ph.damping("p")), R_p=0.0)
    rows = dict(re.findall(r"\\dot\{(\w)\} &= (.*?)(?: \\\\)?\n", fit.latex()))
    assert rows == {"q": r"\frac{p}{m}", "p": "- k q"}
    assert fit.equations() == ["dq/dt = p/m", "dp/dt = -k*q"]


def test_equations_have_the_names_of_formulas_and_the_numbers_of_other_terms() -> None:
    fit = rich_fit()
    x, u, t = [0.4, -0.9], [0.3], 1.7
    known = {"q": x[0], "p": x[1], "u": u[0], "t": t}
    known |= {name: fit.values[name] for name in fit.model.names_in_formulas}
    assert "k" in fit.model.names_in_formulas
    assert "R_p" not in fit.model.names_in_formulas
    for row, text in enumerate(fit.equations()):
        found = float(evaluate(text.split(" = ")[1], known, NUMPY))
        assert found == pytest.approx(rate(fit, x, u, t)[row], rel=1e-5)
    assert all(name in fit.equations()[1] for name in ("k*", "b*u", "tanh", "eps"))
    text = str(fit)
    assert "k*abs(q)**3 + p**2/(2*m) + (" in text
    assert "b*u - c*tanh(dH_dp/eps)" in text and "m = 2.5 kg" in text


def test_a_trajectory_is_known_by_its_name_and_by_its_number() -> None:
    fit, x0 = loaded_fit(), [1.0, 0.0]
    assert fit.model_of("run 2").values["m"] == 2.5
    assert fit.model_of(1) == fit.model_of(-1) == fit.model_of("run 2")
    assert fit.model_of("another run").values["m"] == 2.0
    by_name = fit.simulate(T, x0, trajectory="run 1")
    np.testing.assert_array_equal(fit.simulate(T, x0, trajectory=0), by_name)
    with pytest.raises(ph.DataError, match="there is no trajectory 2; the fit has 2"):
        fit.model_of(2)
    with pytest.raises(ph.DataError, match="'run 3' has no parameters of its own"):
        fit.simulate(T, x0, trajectory="run 3")
    shared = rich_fit()
    assert shared.model_of(7) == shared.model_of("run 1") == shared.model
    with pytest.raises(ph.DataError, match="none: all parameters are shared"):
        shared.simulate(T, x0, trajectory=0)


# ---- files ---------------------------------------------------------------------------

KEPT_AS_THEY_ARE = (
    *("loss", "loss_value", "noise", "n_values", "bic", "hold", "units", "removed"),
    *("warnings", "provenance", "names", "by_trajectory", "outcome", "model"),
)


@pytest.mark.parametrize("make", [rich_fit, first_order_fit, loaded_fit])
def test_a_fit_comes_back_equal_from_a_file_and_from_another_process(
    make: Callable[[], ph.Fit], tmp_path: Path
) -> None:
    fit = make()
    fit.save(tmp_path / "fit.json")
    from_process: ph.Fit = pickle.loads(pickle.dumps(fit))
    for again in (ph.Fit.load(tmp_path / "fit.json"), from_process):
        assert type(again.model) is type(fit.model)
        # Exact: JSON keeps every digit of a float.
        np.testing.assert_array_equal(again.covariance, fit.covariance)
        for name in KEPT_AS_THEY_ARE:
            assert getattr(again, name) == getattr(fit, name), name
        assert str(again) == str(fit)
        assert again.equations() == fit.equations()


def damaged(tmp_path: Path, change: Callable[[Any], object]) -> Path:
    content = json.loads(json.dumps(rich_fit().content()))
    change(content)
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("attack", [
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
])  # fmt: skip
def test_a_formula_that_is_not_a_formula_is_refused_and_never_run(
    attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = damaged(tmp_path, lambda c: first(c).update(body=attack, inner={}))
    with pytest.raises(ph.DataError, match="contains a model that is not valid"):
        ph.Fit.load(path)
    assert not (tmp_path / "ran").exists()


def first(content: Any) -> Any:
    """The first term of H."""
    return content["model"]["H"][0]


def k_of(content: Any) -> Any:
    return first(content)["inner"]["k"]


@pytest.mark.parametrize("change", [
    lambda c: c["uncertainty"].pop("covariance"),
    lambda c: c["uncertainty"].update(covariance=[[1.0]]),
    lambda c: c.update(loss_value="a lot"),
    lambda c: c.update(noise={"q": "small"}),
    lambda c: c.update(noise=[1.0]),
    lambda c: c.update(noise={"q": -1.0}),
    lambda c: c.update(noise={"z": 1.0}),
    lambda c: c["uncertainty"].update(freedom=[1.0]),
    lambda c: c.update(hold="spline"),
    lambda c: c.update(outcome={}),
    lambda c: c["outcome"].update(seconds=None),
    lambda c: c["model"].update(kind="os"),
    lambda c: c["model"].update(states="qp"),
    lambda c: c["model"].update(S=[[0.0, 1.0], [1.0, 0.0]]),
    lambda c: first(c).update(body=5),
    lambda c: k_of(c).update(value="x"),
    lambda c: k_of(c).update(value=10**400),
    lambda c: k_of(c).update(guess=["Popen", "ls"]),
    lambda c: k_of(c).update(extra=1),
    lambda c: c["model"].update(R={"x": []}),
    lambda c: c.update(steps=[["one"]]),
])  # fmt: skip
def test_a_damaged_file_is_refused(change: Any, tmp_path: Path) -> None:
    said = r"fit\.json (is damaged|contains a model that is not valid)"
    with pytest.raises(ph.DataError, match=said):
        ph.Fit.load(damaged(tmp_path, change))


OPEN_MAPPINGS = (
    "provenance",
    "noise",
    "units",
    "inner",
    "kinds",
    "R",
    "F",
    "sensor",
    "l1",
)


def mappings_of(content: Any, name: str = "") -> Iterator[dict[str, Any]]:
    """The mappings of a content whose keys are told in advance."""
    if isinstance(content, dict):
        if name not in OPEN_MAPPINGS:
            yield content
        for key, one in content.items():
            yield from mappings_of(one, key)
    for one in content if isinstance(content, list) else ():
        yield from mappings_of(one)


def test_a_file_that_lacks_a_key_or_has_another_is_refused(tmp_path: Path) -> None:
    content = json.loads(json.dumps(loaded_fit().content()))
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(content))
    assert "m[run 1]" in ph.Fit.load(path).std_errors
    for mapping in list(mappings_of(content)):
        for key in list(mapping):
            for further in ({}, {f"{key}_": mapping[key]}):
                known = dict(mapping)
                del mapping[key]
                mapping.update(further)
                path.write_text(json.dumps(content))
                with pytest.raises(ph.DataError, match=r"fit\.json (is|contains)"):
                    ph.Fit.load(path)
                mapping.clear()
                mapping.update(known)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", '{"format": "other"}', "\x00", "[" * 100_000, "9" * 5000],
)
def test_a_file_that_is_not_a_fit_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "fit.json").write_text(text)
    said = r"fit\.json (cannot be read as a fit|is not a file of the format)"
    with pytest.raises(ph.DataError, match=said):
        ph.Fit.load(tmp_path / "fit.json")
    with pytest.raises(ph.DataError, match="cannot be read as a fit"):
        ph.Fit.load(tmp_path / "none.json")


# ---- a value that is computed when it is asked for


def test_the_work_is_done_once_and_begins_anew_where_it_was_interrupted() -> None:
    calls: list[int] = []

    def work() -> int:
        calls.append(1)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return 7

    later = Later(work)
    assert calls == []
    with pytest.raises(KeyboardInterrupt):
        _ = later.value
    assert (later.value, later.value) == (7, 7)
    assert calls == [1, 1]


def test_what_would_be_endless_multiplied_out_is_left_as_it_is() -> None:
    nested = "q"
    for _ in range(6):  # 2**6 - 1 powers of q, with as many of p each
        nested = f"({nested} + p)**2"
    fit = fit_of(hamiltonian(ph.formula(f"c*{nested}", c=ph.Parameter(0.1))), c=0.1)
    _, dp = fit.equations()
    assert len(dp) < 2_000
    known = {"q": 0.3, "p": 0.2, "c": 0.1}
    found = float(evaluate(dp.split(" = ")[1], known, NUMPY))
    assert found == pytest.approx(rate(fit, [0.3, 0.2])[1], rel=1e-5)
