"""Models, terms and parameters: what they compute, that a change makes a new one, and
what they refuse.
"""

import pickle
from dataclasses import FrozenInstanceError, replace
from math import comb
from typing import Any

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import phsi_opt as ph
from phsi_opt.model.expressions import FUNCTIONS, NUMPY, TWO_ARGUMENTS, evaluate, parse
from phsi_opt.model.parameters import Scan, with_value
from phsi_opt.model.sympy_backend import SYMPY
from phsi_opt.model.terms import Dictionary


def spring(**changes: Any) -> ph.PseudoHamiltonian:
    k, c = ph.Parameter(40.0, lower=0.0), ph.Parameter(0.3)
    parts: dict[str, Any] = {
        **{"states": ("q", "p"), "inputs": ("u",), "S": ph.canonical(1)},
        "H": ph.formula("k*q**2/2 + p**2/(2*m)", k=k, m=2.5),
        "R": ph.damping("p"),
        "F": {"p": ph.formula("b*u*cos(t) - c*tanh(dH_dp)", b=1.5, c=c)},
    }
    return ph.PseudoHamiltonian(**(parts | changes))


def rate(model: ph.Model, x: Any, u: Any = (), t: float = 0.0) -> np.ndarray:
    theta = model.theta
    return np.array(model.rhs()(np.array(x), np.array(u), t, theta)).ravel()


# ---- values --------------------------------------------------------------------------


def test_the_right_hand_side_is_that_of_the_textbook_spring() -> None:
    found = rate(spring().with_values({"R_p": 0.8}), [0.3, -1.2], [0.7], 2.0)
    v = -1.2 / 2.5
    force = -40 * 0.3 - 0.8 * v + 1.5 * 0.7 * np.cos(2.0) - 0.3 * np.tanh(v)
    # Rounding of a few operations.
    np.testing.assert_allclose(found, [v, force], rtol=1e-14)


def test_without_loss_and_force_the_energy_does_not_change() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(4, 4))
    names = ["q1", "q2", "p1", "p2"]
    model = ph.PseudoHamiltonian(states=names, S=a - a.T, H=ph.polynomials(names, 3))
    model = model.with_values({name: float(rng.normal()) for name in model.free})
    theta = model.theta
    for _ in range(5):
        x = rng.normal(size=4)
        gradient = np.array(model.function(*model.efforts)(x, [], 0.0, theta)).ravel()
        flow = gradient @ rate(model, x)
        # x' S x = 0 up to the rounding of sums of about 100 terms near one.
        assert abs(flow) < 1e-12 * np.linalg.norm(gradient) ** 2


def test_a_first_order_model_takes_its_states_as_efforts() -> None:
    rates = {"a": ph.formula("dH_db"), "b": ph.formula("2*a")}
    model = ph.FirstOrder(["a", "b"], rates, R={"b": ph.formula("d", d=0.5)})
    np.testing.assert_allclose(rate(model, [3.0, 4.0]), [4.0, 6.0 - 2.0], rtol=1e-15)


# ---- parameters ----------------------------------------------------------------------


def test_a_parameter_of_formulas_may_stand_in_several_places() -> None:
    k = {"k": ph.Parameter(2.0)}
    energy, force = ph.formula("k*q**2/2 + p**2/2", **k), ph.formula("k*u", **k)
    model = spring(H=energy, F={"p": force})
    assert model.free.count("k") == 1
    _, dp = rate(model.with_values({"k": 3.0}), [1.0, 0.0], [1.0])
    assert dp == pytest.approx(-3 + 3, abs=1e-15)


def test_setting_values_makes_a_new_model() -> None:
    model = spring()
    assert model.with_values({"k": 1.0}).values["k"] == 1.0
    assert model.values["k"] == 40.0
    with pytest.raises(ph.ModelError, match=r"'R_pp' is not in .* Did you mean 'R_p'"):
        model.with_values({"R_pp": 1.0})


def test_removing_a_term_leaves_the_others_as_they_are() -> None:
    wave = {"p": ph.trigonometric("t")}
    model = spring(H=ph.polynomials(["q", "p"], 2), F=wave, inputs=())
    gone = {"H[q]", "F_p[cos(omega_t*t)]", "R_p"}
    smaller = model.without(gone)
    assert set(model.entries) - set(smaller.entries) == gone
    assert not smaller.R
    without = model.without({"F_p[cos(omega_t*t)]", "F_p[sin(omega_t*t)]"})
    assert "F_p.omega_t" not in without.entries


def test_an_effect_of_the_catalogue_can_be_added_by_its_name() -> None:
    model = spring()
    (friction,) = [e for e in ph.catalogue(model) if e.name == "coulomb friction"]
    assert model.add("coulomb friction", "p") == model.add(friction)
    assert model.add("coulomb friction") == model.add(friction)  # of p alone
    assert model.add(friction, "p") == model.add(friction)


@pytest.mark.parametrize(("arguments", "message"), [
    (("coulom friction", "p"), r"'coulom friction' on p .* Did you mean 'coulomb friction'\?"),
    (("coulom friction",), r"Did you mean 'coulomb friction'\?"),
    (("sensor offset",), r"can act in several equations: q, p; say which"),
    (("coulomb friction", "v"), "'coulomb friction': 'v' is not a state"),
    ((ph.Effect("extra", "F", "p", ph.formula("1")), "q"), "acts on 'p', not on 'q'"),
    ((ph.formula("1"),), "expected Effect | str"),
])  # fmt: skip
def test_an_effect_that_cannot_be_added_is_refused(arguments, message) -> None:
    with pytest.raises(ph.ModelError, match=message):
        spring().add(*arguments)


def test_a_model_cannot_be_changed_and_can_be_pickled() -> None:
    model = spring()
    with pytest.raises(FrozenInstanceError):
        model.states = ("a", "b")  # type: ignore[misc]
    with pytest.raises(TypeError):
        model.F["q"] = ph.formula("1")  # type: ignore[index]
    again = pickle.loads(pickle.dumps(model))
    assert again == model
    with pytest.raises(TypeError):
        again.F["q"] = ph.formula("1")


# ---- refusals ------------------------------------------------------------------------


@pytest.mark.parametrize(("changes", "message"), [
    ({"S": None}, "S is missing"),
    ({"S": [[0, 1], [1, 0]]}, r"S is not skew-symmetric: S\[0, 1\]=1 but S\[1, 0\]=1"),
    ({"S": np.zeros((3, 3))}, r"S has shape \(3, 3\); expected \(2, 2\)"),
    ({"S": [[0, np.nan], [np.nan, 0]]}, "S is not skew-symmetric"),
    ({"S": "canonical"}, "is not a matrix of numbers"),
    ({"states": "qp"}, r"states='qp' .* Write a list, such as \['a', 'b'\]"),
    ({"states": ("q", "q")}, "the name 'q' is used 2 times"),
    ({"states": ("q", "t")}, "states: the name 't' is reserved"),
    ({"states": ("q", "pi")}, "states: the name 'pi' is reserved"),
    ({"inputs": ("q",)}, "the name 'q' is used 2 times"),
    ({"H": Dictionary()}, "H has no term"),
    ({"H": 2}, r"H=2 .* Write formula\('...'\)"),
    ({"H": "q*u"}, "uses 'u', but an energy depends on the states alone"),
    ({"H": ph.formula("q*u")}, "uses 'u', but an energy depends on the states alone"),
    ({"H": ph.formula("k*q**2")}, "name 'k' in 'k\\*q\\*\\*2' .* If it is a parameter"),
    ({"R": {"x": ph.formula("1")}}, "equation of R 'x' is not a state"),
    ({"H": ph.formula("k*q**2", k=1.0, m=2.0)}, r"parameter 'm' does not occur in 'k\*q\*\*2'"),
    ({"F": [ph.formula("u")]}, "F=.* Write a mapping, such as {'p': ...}"),
    ({"F": {"p": ph.formula("dH_dx")}}, r"name 'dH_dx' .* Did you mean"),
    ({"F": {"p": ph.formula("u*q", u=ph.Parameter(1.0))}}, "parameter name 'u' is also a state, an input"),
    ({"F": {"p": ph.formula("k*u", k=ph.Parameter(1.0))}}, "parameter 'k' is defined twice and differently"),
])  # fmt: skip
def test_a_model_that_contradicts_itself_is_refused(changes, message) -> None:
    with pytest.raises(ph.ModelError, match=message):
        spring(**changes)


def test_a_text_is_a_formula_whose_other_names_are_free_parameters() -> None:
    known = ph.Parameter(3.0, lower=1.0)
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H="k*q**2/2 + p**2/(2*m)",
        R={"p": "c"},
        F={"p": "b*u - c*g*dH_dp**3", "q": ph.formula("e*t", e=known)},
        sensor={"q": "e*q"},
    )
    table = {name: entry.parameter for name, entry in model.entries.items()}
    assert list(table) == ["k", "m", "c", "e", "b", "g"]
    from_data = ph.Parameter()
    assert (table["k"], table["b"]) == (from_data, from_data)
    assert table["c"] == ph.Parameter(lower=0), "R >= 0"
    assert table["m"] == ph.Parameter(1.0), "at 0 the energy has no value"
    assert table["g"] == ph.Parameter(1.0), "c is zero, too"
    assert table["e"] == known
    assert replace(model, sensor={}).free == model.free
    outflow = ph.FirstOrder(["h"], {"h": "u - a*sqrt(h)"}, inputs=["u"])
    assert outflow.free == ("a",)


def test_a_first_order_model_refuses_an_energy_and_a_structure() -> None:
    force = {"q": ph.formula("-a*q", a=ph.Parameter(1.0))}
    with pytest.raises(ph.ModelError, match="has no S and no H"):
        ph.FirstOrder(states=["q"], F=force, H="q**2")
    model = ph.FirstOrder(states=["q"], F=force)
    with pytest.raises(ph.ModelError, match="a FirstOrder model has none"):
        model.add(ph.Effect("gravity", "H", "", ph.formula("q")))
    assert model.with_values({"a": 2.0}).values["a"] == 2.0


# ---- terms and parameters


def test_a_parameter_starts_at_its_value_or_where_its_bounds_are_nearest_to_zero() -> (
    None
):
    assert ph.Parameter(2.0).start == 2.0
    assert ph.Parameter().start == 0.0
    assert ph.Parameter(lower=0.5).start == 0.5
    assert ph.Parameter(upper=-0.5).start == -0.5


@pytest.mark.parametrize(("arguments", "message"), [
    ({"value": np.nan}, "value=nan is not finite"),
    ({"value": np.inf}, "value=inf is not finite"),
    ({"value": "two"}, "value='two' is not possible"),
    ({"value": 10**400}, "value=a number beyond"),
    ({"lower": np.nan}, "lower=nan is not finite"),
    ({"lower": 2.0, "upper": 1.0}, "bounds are crossed: lower=2 is above upper=1"),
    ({"value": 3.0, "upper": 1.0}, r"value 3 lies outside its bounds \[-inf, 1\]"),
    ({"fixed": True}, "a fixed parameter needs a value"),
])  # fmt: skip
def test_a_parameter_that_contradicts_itself_is_refused(arguments, message) -> None:
    with pytest.raises(ph.ModelError, match=message):
        ph.Parameter(**arguments)


@pytest.mark.parametrize(("n", "degree"), [(1, 1), (1, 4), (2, 3), (3, 2)])
def test_polynomials_are_all_monomials_up_to_the_degree_and_each_once(
    n: int, degree: int
) -> None:
    names = [f"x{i}" for i in range(n)]
    bodies = [term.body for term in ph.polynomials(names, degree, constant=True)]
    assert len(bodies) == len(set(bodies)) == comb(n + degree, degree)
    assert bodies[0] == "1"
    assert [t.body for t in ph.polynomials(names, degree)] == bodies[1:]


def test_a_trigonometric_pair_shares_one_frequency_that_is_scanned() -> None:
    sine, cosine = ph.trigonometric("t")
    assert (sine.body, cosine.body) == ("sin(omega_t*t)", "cos(omega_t*t)")
    assert dict(sine.inner) == dict(cosine.inner)
    assert sine.inner["omega_t"].guess == Scan("t")
    assert [t.body for t in ph.trigonometric("q", n=2)][2] == "sin(omega_q2*q)"
    assert ph.trigonometric("t", frequency=2.0).terms[0].inner["omega_t"].value == 2.0


def test_one_name_and_a_list_of_names_are_the_same() -> None:
    assert ph.damping("q", "p") == ph.damping(["q", "p"])
    assert ph.damping("p") == ph.damping(["p"])
    assert ph.polynomials("q", 2) == ph.polynomials(["q"], 2)
    assert ph.trigonometric("t") == ph.trigonometric(["t"])
    both = ph.trigonometric(["t", "q"], n=2)
    assert both == ph.trigonometric("t", n=2) + ph.trigonometric("q", n=2)


def test_setting_a_value_keeps_the_bounds() -> None:
    (term,) = ph.damping("p")["p"]
    assert term.coefficient is not None
    assert with_value(term.coefficient, -1e-9) == ph.Parameter(0.0, lower=0.0)


@pytest.mark.parametrize(("make", "message"), [
    (lambda: ph.polynomials(["q", "q"], 2), "and none twice"),
    (lambda: ph.polynomials([], 2), "at least one name"),
    (lambda: ph.polynomials(["sin"], 2), "variable 'sin' is not a usable name"),
    (lambda: ph.polynomials(["q q"], 2), "variable 'q q' is not a usable name"),
    (lambda: ph.polynomials(["q"], 0), "polynomials: degree=0 is not possible"),
    (lambda: ph.polynomials(["q"], 1.5), "degree=1.5 is not possible"),  # type: ignore[arg-type]
    (lambda: ph.polynomials(["q"], 10**9), "degree=1000000000 .* exceeds 64"),
    (lambda: ph.polynomials(["q"], 10**5000), "degree=a number beyond 10"),
    (lambda: ph.FirstOrder(["q", "p"], dict.fromkeys("qp", ph.polynomials(["q", "p"], 23))), "a model would have 598 terms; at most 500"),
    (lambda: ph.polynomials(["q", "p"], 60), "degree=60 in 2 variables would have 1891 terms; at most 500"),
    (lambda: ph.polynomials([f"x{i}" for i in range(20)], 5), "degree=5 in 20 variables would have 53130 terms; at most 500"),
    (lambda: ph.polynomials(["q"], True), "degree=True is not possible"),
    (lambda: ph.trigonometric(["t", "q"], n=10**9), "n=1000000000 for 2 variables would have 4000000000 terms"),
    (lambda: ph.trigonometric("t", n=10**5000), "n=a number beyond 10"),
    (lambda: Dictionary(5001 * tuple(ph.formula("q"))), "would have 5001 terms"),
    (lambda: ph.canonical(10**9), r"canonical: n=1000000000 .* from 1 to 1000"),
    (lambda: ph.MaximumLikelihood(steps=10**9), "steps=1000000000 .* from 1 to 1000"),
    (lambda: ph.damping("q", ["q", "p"]), "and none twice"),
    (lambda: ph.trigonometric("t", n=0), "trigonometric: n=0 is not possible"),
    (lambda: ph.polynomials(["q"], 2) + ph.polynomials(["q"], 1), "term 'q' is in the dictionary twice"),
    (lambda: ph.polynomials(["q"], 2) + 3, "=3 is not possible; expected Dictionary"),  # type: ignore[operator]
])  # fmt: skip
def test_a_dictionary_that_makes_no_sense_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        make()


# ---- formulas: read through a whitelist, never run

FORMULAS = [
    *(f"{name}(0.3 + q**2)" for name in FUNCTIONS if name not in TWO_ARGUMENTS),
    "min(q, p) + max(q, 2*p)",
    "-q**2/2 + 3*p*q - (+p)",
    "q**-2 + 2**q",
    "pi*q/4 - 1e-3",
    "q**0.5*p",
    "exp(-q**2)*sin(3*p)",
]


@pytest.mark.parametrize("text", FORMULAS)
def test_casadi_sympy_and_numpy_agree(text: str) -> None:
    at = {"q": 0.7, "p": -0.4}
    by_numpy = evaluate(text, at, NUMPY)
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [evaluate(text, {"q": x[0], "p": x[1]})])
    exact = evaluate(text, {name: sp.Symbol(name) for name in at}, SYMPY)
    # The same few operations in three libraries: rounding only.
    assert float(function([0.7, -0.4])) == pytest.approx(by_numpy, rel=1e-14)
    assert float(exact.subs(at)) == pytest.approx(by_numpy, rel=1e-14)


@pytest.mark.parametrize(("text", "message"), [
    ("", "is not text"),
    ("   ", "is not text"),
    ("q^2", r"Write a power as \*\*"),
    ("q +", "cannot be read"),
    ("q; p", "cannot be read"),
    ("sinn(q)", r"function 'sinn'.*Did you mean 'sin'\?"),
    ("sin(q, p)", r"sin takes 1 argument\(s\)"),
    ("min(q)", r"min takes 2 argument\(s\)"),
    ("sin(x=q)", "takes 1 argument"),
    ("sin(*q)", "not allowed"),
    ("q.real", "not allowed"),
    ("q[0]", "not allowed"),
    ("q < p", "not allowed"),
    ("not q", "not allowed"),
    ("~q", "not allowed"),
    ("q // 2", "operator"),
    ("q @ p", "operator"),
    ("'q'", "not a finite number"),
    ("True*q", "not a finite number"),
    ("1j*q", "not a finite number"),
    ("1e999*q", "not a finite number"),
    ("9" * 400, "not a finite number"),
    ("q**65", "exceeds 64"),
    ("q**(8*9)", "exceeds 64"),
    ("q**-65", "exceeds 64"),
    ("q**(2**7)", "exceeds 64"),
    ("((9**64)**64)**64", "no finite value"),
    ("q + 1/0", "no finite value"),
    ("(-1)**0.5*q", "no finite value"),
    ("log(0 - 1)*2 + q", "no finite value"),
    ("-" * 300 + "q", "nested too deeply"),
    ("+".join(["q"] * 300), "nested too deeply"),
    ("q" * 10_001, "too long"),
    ("(" * 9_000, r"^formula '\({60}\.\.\.' cannot be read"),
    ("\ud800*q", "a character that is not valid"),
    ("9**9**9", "exceeds 64"),
    ("((((10/9)**16)**16)**16)*q", "too many digits"),
    ("(((1/9)**64)**64)**64*q", "too many digits"),
    ("((((2*q)**64)**64)**64)**64", "too many digits"),
    ("sqrt(((9*q)**64)**64)", "too many digits"),
    ("__import__('os')", "is not known"),
    ("(lambda: 1)()", "is not known"),
    ("[q for q in p]", "not allowed"),
])  # fmt: skip
def test_what_is_not_a_formula_is_refused(text: str, message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        parse(text)


def test_an_exponent_of_at_most_64_is_allowed() -> None:
    assert evaluate("q**(2**3)", {"q": 2.0}, NUMPY) == 256.0
    assert evaluate("q**-64", {"q": 1.0}, NUMPY) == 1.0


def test_a_sum_times_its_coefficient_is_printed_in_brackets() -> None:
    room = ph.FirstOrder(["T"], {"T": "0"}, ["Ta"], kind="thermal")
    room = room.add(ph.catalogue(room, called="ambient")[0])
    assert "heat_exchange_Ta_T*(Ta - T)" in str(room)
    spring = ph.FirstOrder(["x", "v"], {"x": "v", "v": "-x"})
    spring = spring.add(ph.catalogue(spring, called="duffing spring")[0])
    assert "cubic_stiffness_x*(-x**3)" in str(spring)
